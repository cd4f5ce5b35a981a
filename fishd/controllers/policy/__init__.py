"""The controller `ppo`: learned policies, their files, and where named ones are found."""
