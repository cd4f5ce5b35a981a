"""What stands in for the world: simulated fish, on a rod or free, and a virtual Raspberry Pi."""
