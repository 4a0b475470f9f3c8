"""The procedural person: surface, paint, performance."""
