"""The tethered robotic fish as equations: what the simulated hardware and the theory commands run.

Nothing is imported here, so reading the parameters costs no numpy.
"""
