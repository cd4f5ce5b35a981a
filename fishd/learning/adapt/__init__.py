"""From a fish that nobody has seen to its best gait: excite, fit, search, train, compare."""
