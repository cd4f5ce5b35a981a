"""Simulated camera, which draws the tail for a fin angle and a light."""
