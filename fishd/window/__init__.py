"""Web pages of a fish and its camera, for people at the tank (extra: window)."""
