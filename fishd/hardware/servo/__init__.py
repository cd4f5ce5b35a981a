"""Servo: drivers that send pulses, and the conversion of angles into pulses."""
