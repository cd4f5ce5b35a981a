"""What stands in for the world: the simulated fish, and a virtual Raspberry Pi."""
