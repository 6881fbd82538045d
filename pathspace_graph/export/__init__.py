"""What planners and other tools read: a map in their formats (FORMATS)."""
