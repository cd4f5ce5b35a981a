"""Learned policies on the robot: their files, where they are found, and the controller `ppo`."""
