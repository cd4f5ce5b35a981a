"""A web page that shows what the camera sees, live; it needs nothing from the internet."""
