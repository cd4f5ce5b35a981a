"""The command line: `fishctl`, with a module for each family of verbs, and `fishd-release`."""
