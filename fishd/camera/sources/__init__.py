"""Sources of frames: a camera of this machine, a stream, or a simulation."""
