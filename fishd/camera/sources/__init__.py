"""Where frames come from: a camera of this machine, a stream, or a simulation."""
