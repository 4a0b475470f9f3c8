"""Who moves an avatar: another's performance as its theta, at once or film by film."""

from rgbavatar_ns.driving.one_euro import OneEuroOptions, one_euro
from rgbavatar_ns.driving.theta_map import ThetaNames, map_by_name, theta_map
from rgbavatar_ns.driving.transfer import DrivingOptions, drive

__all__ = [
    "DrivingOptions",
    "OneEuroOptions",
    "ThetaNames",
    "drive",
    "map_by_name",
    "one_euro",
    "theta_map",
]
