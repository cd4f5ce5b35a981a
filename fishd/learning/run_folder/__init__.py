"""Files of a training on disk: settings, checkpoints, tables, provenance."""
