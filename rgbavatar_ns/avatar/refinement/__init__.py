"""Corrections of tracked theta, learnt together with the avatar."""
