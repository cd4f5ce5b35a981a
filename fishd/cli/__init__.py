"""`fishctl`, the command line of fishd: one module per family of verbs."""
