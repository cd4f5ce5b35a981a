"""What is shown and measured of a free swimmer: its wake, its midlines, its speed."""
