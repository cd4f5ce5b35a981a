"""Controller `ppo`: learned policies, their files, and the search for named ones."""
