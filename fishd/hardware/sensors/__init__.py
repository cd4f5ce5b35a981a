"""Sensors besides the force sensor; each declares its readings, which every consumer shows."""
