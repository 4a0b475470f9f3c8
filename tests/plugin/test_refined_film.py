"""What renders and exports a run with refined tracking shows the theta that it was trained on."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig
from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints, read_checkpoint
from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.cli.demo import _film
from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import as_trained_on, comparison
from rgbavatar_ns.export.subject import load_subject
from tests.export.avatar_of_page import avatar_of_page
from tests.plugin.run import small_config, trained
from tests.plugin.tiny import NUM_FRAMES, tiny_dataset


@dataclasses.dataclass(frozen=True)
class _Run:
    folder: Path
    data: Path
    driving: torch.Tensor
    """What ns-eval and the viewer draw its frames with."""


def _run_of(folder: Path, *, refine: bool) -> _Run:
    data = folder / "data"
    tiny_dataset(data)
    refinement = RefinementConfig(start_step=0, bases_start=0.0)
    trainer = trained(
        small_config(
            data, folder, max_num_iterations=6, refine_tracking=refine, refinement=refinement
        )
    )
    driving = trainer.pipeline.model.eval().driving_theta(list(range(NUM_FRAMES)))
    return _Run(trainer.base_dir, data, driving)


@pytest.fixture(scope="module")
def refined(tmp_path_factory) -> _Run:
    run = _run_of(tmp_path_factory.mktemp("refined"), refine=True)
    assert not run.driving.equal(load_dataset(run.data).theta)
    return run


def test_the_own_film_has_the_theta_that_ns_eval_draws(refined):
    for place in (refined.folder, *(path for _, path in _checkpoints(refined.folder))):
        subject = load_subject(place, None)
        assert subject.dataset is not None
        assert subject.dataset.theta.equal(refined.driving)
    named = load_subject(refined.folder, refined.data).dataset
    assert named is not None
    assert named.theta.equal(refined.driving)


def _checkpoints(run_folder: Path) -> list[tuple[int, Path]]:
    return list_checkpoints(run_folder / "nerfstudio_models")


def test_a_run_without_refined_tracking_keeps_its_tracked_theta(tmp_path):
    plain = _run_of(tmp_path, refine=False)
    dataset = load_subject(plain.folder, None).dataset
    assert dataset is not None
    assert dataset.theta.equal(load_dataset(plain.data).theta)


@pytest.fixture
def drawn(monkeypatch) -> list[torch.Tensor]:
    """The theta of each picture of a comparison."""
    seen: list[torch.Tensor] = []
    draw = comparison.draw

    def keep(avatar: Any, theta: torch.Tensor, *rest: Any) -> Any:
        seen.append(theta[0])
        return draw(avatar, theta, *rest)

    monkeypatch.setattr(comparison, "draw", keep)
    return seen


def test_render_compares_with_it_and_so_does_the_demo(refined, tmp_path, drawn):
    held_out = refined.driving[list(load_dataset(refined.data).test)]
    cli.main(["render", str(refined.folder), str(tmp_path)])
    assert torch.stack(drawn).equal(held_out)
    drawn.clear()
    _film(refined.folder, refined.data, tmp_path)
    assert torch.stack(drawn).equal(held_out)


def test_exports_of_frames_have_it(refined, tmp_path):
    cli.main(["export", str(refined.folder), str(tmp_path / "a.ply"), "--frame", "2"])
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    avatar = Avatar.load(refined.folder).without_undrawn()
    with torch.no_grad():
        expected = avatar.gaussians(refined.driving[2:3]).means[0].numpy()
    np.testing.assert_allclose(np.stack([vertex[a] for a in "xyz"], 1), expected)

    cli.main(["export", str(refined.folder), str(tmp_path / "a.html")])
    played = np.asarray(avatar_of_page(tmp_path / "a.html")[1]["theta"])
    np.testing.assert_allclose(played, refined.driving.numpy(), atol=2e-3)
    tracked = load_dataset(refined.data).theta.numpy()
    assert np.abs(played - refined.driving.numpy()).max() < np.abs(played - tracked).max()


def test_a_bundle_knows_the_corrected_frames_ranges(refined, tmp_path):
    cli.main(["export", str(refined.folder), str(tmp_path / "me")])
    stored = load_avatar(refined.folder).training_statistics
    written = load_avatar(tmp_path / "me").training_statistics
    assert stored is not None
    assert written is not None
    torch.testing.assert_close(written.theta_max, stored.theta_max)
    torch.testing.assert_close(written.psi_mean, stored.psi_mean)


def test_frames_are_matched_by_their_numbers(refined):
    dataset = load_dataset(refined.data)
    fewer = dataclasses.replace(
        dataset,
        theta=dataset.theta[[5, 2]],
        frame_index=tuple(dataset.frame_index[k] for k in (5, 2)),
    )
    matched = as_trained_on(Avatar.load(refined.folder), refined.folder, fewer, refined.data)
    assert matched.theta.equal(refined.driving[[5, 2]])


def _renumbered(dataset: TrackedDataset) -> TrackedDataset:
    index = tuple(number + 100 for number in dataset.frame_index)
    return dataclasses.replace(dataset, frame_index=index)


def _another_person(dataset: TrackedDataset) -> TrackedDataset:
    return dataclasses.replace(dataset, identity=dataset.identity + 1)


@pytest.mark.parametrize(
    ("change", "told"),
    [(_renumbered, "14 of its frames are not the run's"), (_another_person, "person was measured")],
)
def test_other_data_stays_as_tracked_and_changed_own_data_is_told(refined, tmp_path, change, told):
    avatar, other = Avatar.load(refined.folder), change(load_dataset(refined.data))
    (tmp_path / "dataset.json").touch()
    given = as_trained_on(avatar, refined.folder, other, tmp_path)
    assert given.theta.equal(other.theta)
    with pytest.raises(UserError, match=told) as raised:
        as_trained_on(avatar, refined.folder, other, refined.data)
    assert "--data" in raised.value.remedy


def test_another_systems_data_stays_as_imported_though_it_fits(refined, tmp_path) -> None:
    """Its import may put the head's motion into the camera where the run's did not."""
    avatar, same = Avatar.load(refined.folder), load_dataset(refined.data)
    assert not as_trained_on(avatar, refined.folder, same, refined.data).theta.equal(same.theta)
    assert as_trained_on(avatar, refined.folder, same, tmp_path).theta.equal(same.theta)


def _without_frames(extra: dict[str, Any]) -> None:
    del extra["frames"]


def _nan(extra: dict[str, Any]) -> None:
    extra["frames"]["theta"][0, 0] = torch.nan


def _misnumbered(extra: dict[str, Any]) -> None:
    extra["frames"]["index"][1] = extra["frames"]["index"][0]


@pytest.mark.parametrize("spoil", [_without_frames, _nan, _misnumbered])
def test_damaged_frames_of_a_checkpoint_are_told(
    refined, tmp_path, spoil: Callable[[dict[str, Any]], None]
):
    run = tmp_path / "run"
    shutil.copytree(refined.folder, run)
    path = _checkpoints(run)[-1][1]
    state = read_checkpoint(path)
    spoil(state["pipeline"]["_model._extra_state"])
    torch.save(state, path)
    with pytest.raises(UserError, match="damaged"):
        load_subject(run, None)
