import pytest

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.experiments.rendering_speed import frames_per_second
from rgbavatar_ns.head import HeadModel
from tests.plugin.run import SMALL
from tests.plugin.tiny import tiny_dataset


def test_the_median_counts_after_the_first_pictures(tmp_path):
    data = tiny_dataset(tmp_path / "data", frames=9, test=4)
    avatar = Avatar(HeadModel(data.arrays), data.identity, SMALL)
    # Five of warming up; then .1, .2, .3 and 9 seconds.
    lasts = iter([50.0] * 5 + [0.1, 0.2, 0.3, 9.0])
    times = (place for lasted in lasts for place in (0.0, lasted))
    assert frames_per_second(avatar, data, lambda: next(times)) == pytest.approx(1 / 0.25)
    assert next(times, None) is None
