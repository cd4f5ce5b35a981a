"""Measures what fishd and its servo do when something dies, hangs, misbehaves or attacks."""
