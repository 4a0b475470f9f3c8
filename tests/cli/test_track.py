"""`rgbavatar track` takes its paths and options in any order, and says which path is missing."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rgbavatar_ns.cli import track
from rgbavatar_ns.cli.main import main
from rgbavatar_ns.errors import UserError

ASKED = {"videos": ["a.mp4", "b.mp4"], "dst": "set", "image_size": 96, "overwrite": True}


@pytest.mark.parametrize(
    "arguments",
    [
        "a.mp4 b.mp4 set --image-size 96 --overwrite",
        "--overwrite --image-size 96 a.mp4 b.mp4 set",
        "--image-size 96 a.mp4 b.mp4 set --overwrite",
    ],
)
def test_options_may_come_before_and_after_the_paths(
    arguments: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = {}

    def note(videos, dst, config, progress) -> None:
        asked.update(videos=[str(video) for video in videos], dst=str(dst))
        asked.update(image_size=config.image_size, overwrite=config.overwrite)
        raise UserError("Enough.", "Stop.")

    monkeypatch.setattr(track, "track_video", note)
    with pytest.raises(SystemExit):
        main(["track", *arguments.split()])
    assert asked == ASKED


def test_a_head_model_that_is_not_there_is_told_before_the_video_is_read(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    nowhere = tmp_path / "flame2023.pkl"
    told = refused("track", "a.mp4", tmp_path / "set", "--flame", nowhere)
    assert f"no FLAME model at {nowhere}" in " ".join(told.split())
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("paths", [(), (Path("me.mp4"),)])
def test_a_video_without_a_place_for_its_dataset_is_refused(paths: tuple[Path, ...]) -> None:
    with pytest.raises(UserError, match="place for the dataset are needed"):
        track.run(paths)
