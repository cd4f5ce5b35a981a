"""A virtual Raspberry Pi: chips and daemons that the real driver libraries run on unchanged."""
