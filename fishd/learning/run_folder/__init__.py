"""What a training leaves on disk: settings, checkpoints, tables, provenance."""
