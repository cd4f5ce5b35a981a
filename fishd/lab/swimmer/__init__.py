"""Pictures and measurements of a free swimmer: its wake, its midlines, its speed."""
