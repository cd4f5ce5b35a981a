"""The force sensor: drivers that deliver samples, and what turns samples into forces."""
