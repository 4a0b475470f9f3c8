"""Landmarks, and how they lie on a head."""
