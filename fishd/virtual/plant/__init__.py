"""Equations of the tethered robotic fish, for the simulated hardware and the theory.

Nothing is imported here, so that parameters can be read without NumPy.
"""
