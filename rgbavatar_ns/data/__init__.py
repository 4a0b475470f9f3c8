"""Tracked frames: the dataset on disk, decoded images, and the order they are trained in."""

from rgbavatar_ns.data.cache import ImageCache
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.native.writer import DatasetWriter
from rgbavatar_ns.data.opening import is_dataset, load_dataset
from rgbavatar_ns.data.sampling import LocalGlobalPools, OfflineOrder

__all__ = [
    "DatasetWriter",
    "ImageCache",
    "LocalGlobalPools",
    "OfflineOrder",
    "TrackedDataset",
    "TrackedFrame",
    "is_dataset",
    "load_dataset",
]
