"""The camera above the tail: frames with their times, real or simulated (extra: camera)."""
