"""The head model and the camera that landmarks fit."""
