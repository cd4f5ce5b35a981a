"""Controller `remote`: an agent in another process chooses the instruction angle."""
