"""The robot's parts: force sensor, servo and operator's panel, behind small protocols."""
