"""Sweeps: the thrust of controllers over a grid of their parameters and of the fish's own keys."""
