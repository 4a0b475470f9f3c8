"""What an avatar is made of: bases, weight network, anchors, and the way to world space."""
