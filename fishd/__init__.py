"""fishd: the daemon that runs a robotic fish, on the robot and on a simulated one."""

__version__ = "0.1.0.dev0"
"""Version of the checkout; a wheel has that of its tag."""
