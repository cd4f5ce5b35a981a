"""The servo: drivers that send pulses, and what turns angles into pulses."""
