"""Whether tracking can be trusted."""
