"""Training while frames arrive."""
