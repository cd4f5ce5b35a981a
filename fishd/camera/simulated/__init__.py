"""A simulated camera: draws the tail as fin angle and light say."""
