"""The tethered robotic fish as equations, for the simulated hardware and the theory.

Nothing is imported here, so reading the parameters costs no numpy.
"""
