"""ns-train looks at the data before its first step."""

import json
from pathlib import Path

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.datamanager import RGBAvatarDataManagerConfig

from .tiny import tiny_dataset


@pytest.fixture(scope="module")
def shrunk(tmp_path_factory) -> Path:
    """The tiny dataset with a quarter of its focal length."""
    data = tiny_dataset(tmp_path_factory.mktemp("shrunk"))
    index = json.loads((data.root / "dataset.json").read_text())
    index["camera"]["focal_px"] = [focal_px / 4 for focal_px in index["camera"]["focal_px"]]
    (data.root / "dataset.json").write_text(json.dumps(index))
    return data.root


def test_data_that_cannot_fit_is_refused_before_training(shrunk):
    with pytest.raises(UserError, match="focal length") as refused:
        RGBAvatarDataManagerConfig(data=shrunk).setup(test_mode="val")
    assert "focal length" in refused.value.remedy


def test_the_check_can_be_left_out_and_evaluation_needs_none(shrunk):
    RGBAvatarDataManagerConfig(data=shrunk, check_data=False).setup(test_mode="val")
    RGBAvatarDataManagerConfig(data=shrunk).setup(test_mode="inference")
