"""Measurement of the fin angle in pictures of the tail."""
