"""The power meters: what the servo takes from its supply."""
