"""Adaptation to an unknown fish, up to its best gait: excite, fit, search, train, compare."""
