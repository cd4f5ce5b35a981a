"""Emulated pigpiod of the virtual Pi: its protocol, pins and scripts."""
