"""An agent in another process, on another machine perhaps, that chooses the instruction angle."""
