"""The project's own dataset format."""
