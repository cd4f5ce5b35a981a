"""The verbs about recordings, loaded when they are called; they need the extra `record`."""
