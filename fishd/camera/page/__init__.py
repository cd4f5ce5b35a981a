"""Web page that shows the camera's pictures live; it loads nothing from the internet."""
