"""The procedural person's pictures."""
