"""The five joints of a head: their numbers, and what turns them."""

JOINT_FIELDS = ("rotation", "neck", "jaw", "left_eye", "right_eye")
"""Theta's field that turns each joint, in the order of the joints."""
ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(5)
"""The root carries the body where there is one, the neck the skull, which carries the others."""
EYES = [LEFT_EYE, RIGHT_EYE]
