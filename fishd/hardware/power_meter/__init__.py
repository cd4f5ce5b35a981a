"""Power meters: the electrical power that the servo takes from its supply."""
