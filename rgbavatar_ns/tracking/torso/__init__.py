"""The body under the head: where it is, and how the neck carries the head upon it."""
