"""The controllers: each chooses the next instruction angle from an observation, and does no I/O."""
