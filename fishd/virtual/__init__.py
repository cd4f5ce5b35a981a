"""Simulated fish, on a rod or swimming freely, and a virtual Raspberry Pi."""
