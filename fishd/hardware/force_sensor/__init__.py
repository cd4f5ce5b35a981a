"""Force sensor: drivers that deliver samples, and the conversion of samples into forces."""
