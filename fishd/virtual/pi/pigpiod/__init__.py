"""The pigpiod of the virtual Pi: the protocol of the real one, its pins and its scripts."""
