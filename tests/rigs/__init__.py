"""What the tests share: rigs, stand-ins for parts, and processes."""
