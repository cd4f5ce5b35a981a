"""The verbs about recordings, loaded when they are called (extra: record)."""
