"""ns-train looks at the data before its first step."""

from pathlib import Path

import pytest

from rgbavatar_ns.data import DatasetWriter, TrackedDataset, TrackedFrame
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.datamanager import RGBAvatarDataManagerConfig

from .tiny import tiny_dataset


@pytest.fixture(scope="module")
def shrunk(tmp_path_factory) -> Path:
    """The tiny dataset with a quarter of its focal length."""
    good = tiny_dataset(tmp_path_factory.mktemp("good"))
    return _with_focal(good, tmp_path_factory.mktemp("shrunk"), 0.25)


def _with_focal(good: TrackedDataset, folder: Path, factor: float) -> Path:
    writer = DatasetWriter(folder, good.arrays, good.identity, good.layout, good.width, good.height)
    for position, index in enumerate(good.frame_index):
        view = good.cameras.select([position])
        view.focal_px.mul_(factor)
        writer.add(TrackedFrame(index, good.theta[position], view, good.read_image(position)))
    return writer.finish(2).root


def test_data_that_cannot_fit_is_refused_before_training(shrunk):
    with pytest.raises(UserError, match="focal length") as refused:
        RGBAvatarDataManagerConfig(data=shrunk).setup(test_mode="val")
    assert "focal length" in refused.value.remedy


def test_the_check_can_be_left_out_and_evaluation_needs_none(shrunk):
    RGBAvatarDataManagerConfig(data=shrunk, check_data=False).setup(test_mode="val")
    RGBAvatarDataManagerConfig(data=shrunk).setup(test_mode="inference")
