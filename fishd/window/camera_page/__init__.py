"""The page of the camera: what it sees, live, with the axis of motion."""
