"""Debian package of fishd, with a virtual environment of its own."""
