"""Measurements of fishd and its servo under deaths, hangs, misbehaviour and attacks."""
