"""nerfstudio's viewer: the avatar's controls, and the pictures that it shows."""
