"""Benchmarks of the punctuality, speed and size of fishd, and of learning and policies."""
