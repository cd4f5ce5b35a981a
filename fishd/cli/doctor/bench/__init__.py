"""`fishctl doctor --bench`: a measurement of the board with two wires and without the servo."""
