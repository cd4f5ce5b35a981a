"""Measures how punctual, quick and light fishd is, and what learning and policies come to."""
