"""Who moves an avatar: another's performance as its theta, at once or film by film."""

from rgbavatar_ns.driving.one_euro import OneEuroOptions, one_euro
from rgbavatar_ns.driving.theta_map import NamedMap, ThetaNames, theta_map
from rgbavatar_ns.driving.transfer import DrivingOptions, drive

__all__ = [
    "DrivingOptions",
    "NamedMap",
    "OneEuroOptions",
    "ThetaNames",
    "drive",
    "one_euro",
    "theta_map",
]
