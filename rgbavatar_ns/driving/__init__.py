"""Who moves an avatar: another's performance as its theta, at once or film by film."""

from rgbavatar_ns.driving.one_euro import OneEuroOptions, one_euro
from rgbavatar_ns.driving.transfer import DrivingOptions, ThetaNames, drive

__all__ = ["DrivingOptions", "OneEuroOptions", "ThetaNames", "drive", "one_euro"]
