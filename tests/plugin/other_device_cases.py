"""On a device that is not the host's, everything lies where it is asked for.

Its memory is the processor's and so are its operations, but a tensor there and one in main memory
do not meet: what would fail on a GPU for that fails here, where there is none. For a process of
their own: test_other_device.py.
"""

from dataclasses import replace
from typing import Any, get_args

import pytest
import torch

from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig
from rgbavatar_ns.avatar.training import step
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from rgbavatar_ns.plugin.viewer.viewer_state import PictureKind
from tests.plugin import elsewhere
from tests.plugin.desk import Desk
from tests.plugin.online_run import online_config
from tests.plugin.run import SMALL, make_trainer, small_config
from tests.plugin.test_rivals import RIVALS, rival_config


@pytest.fixture(scope="module", autouse=True)
def device(tmp_path_factory) -> None:
    elsewhere.begin(tmp_path_factory.mktemp("elsewhere"))


class EdgeMatrix:
    """A sparse matrix as the entries of its edges: the device has no sparse tensors."""

    def __init__(self, field: MeshField, entries: torch.Tensor) -> None:
        (self._rows, self._columns), self._entries = field.edges.T, entries

    def __matmul__(self, values: torch.Tensor) -> torch.Tensor:
        at_edges = self._entries[:, None] * values[self._columns]
        return torch.zeros_like(values).index_add(0, self._rows, at_edges)


@pytest.fixture(autouse=True)
def without_sparse_tensors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MeshField, "_matrix", lambda self, entries: EdgeMatrix(self, entries))


def trained_there(config: RGBAvatarTrainerConfig) -> RGBAvatarTrainer:
    """Train on the other device, to the end."""
    config.machine.device_type = elsewhere.NAME
    trainer = make_trainer(config)
    trainer.train()
    assert {p.device.type for p in trainer.pipeline.model.avatar.parameters()} == {elsewhere.NAME}
    return trainer


def test_the_other_device_does_not_meet_main_memory():
    there = torch.ones(2).to(elsewhere.NAME)
    assert (there + there).tolist() == [2, 2]
    assert torch.empty_like(there).isnan().all(), "what nobody wrote is no number"
    pairs = torch.zeros(2, 2).to(elsewhere.NAME)
    torch.add(there, 1, out=pairs[:, 1])
    assert pairs.tolist() == [[0, 2], [0, 2]]
    for mixed in (lambda: there + torch.ones(2), lambda: torch.stack([there, torch.ones(2)])):
        with pytest.raises(RuntimeError, match="same device"):
            mixed()
    with pytest.raises(TypeError, match="numpy"):
        there.numpy()


@pytest.mark.parametrize("refine_tracking", [False, True])
def test_a_run_trains_and_is_scored_and_looked_at(tiny_data, tmp_path, refine_tracking):
    options: dict[str, Any] = {"refine_tracking": refine_tracking, "max_num_iterations": 4}
    options |= {"refinement": RefinementConfig(start_step=1), "steps_per_eval_batch": 2}
    trainer = trained_there(small_config(tiny_data, tmp_path, **options))
    pipeline = trainer.pipeline.eval()
    assert pipeline.get_average_eval_image_metrics()["psnr"] > 0
    desk = Desk(pipeline)
    for picture in get_args(PictureKind):
        desk.set("Picture", picture)
        assert desk.picture().isfinite().all()
    for label, value in (
        *(("Mesh", True), ("Gaussian centres", True), ("Basis 2", 0.9), ("Bases used", 1)),
        *(("Show one alone", "2"), ("Jaw opens (°)", 20.0), ("Frame", 3), ("Play", True)),
    ):
        desk.set(label, value)
        assert desk.picture().isfinite().all()
        assert desk.told()
    # As `ns-eval`, `ns-render` and `ns-viewer` begin.
    config = small_config(tiny_data, tmp_path, **options, load_dir=trainer.checkpoint_dir)
    trained_there(replace(config, timestamp="more", max_num_iterations=6))


@pytest.mark.parametrize(
    "options",
    [
        {"orthogonality": "loss", "first_colors": "paper", "hide_unseen": True},
        {"orthogonality": "gram_schmidt", "surface_prior": False},
        {"batch_parallel": False, "avatar": replace(SMALL, carrier="joints", num_bases=0)},
        {"avatar": replace(SMALL, weight_network="none", scale_with_triangle=True)},
        {"refine_tracking": True, "refine_held_out": 2},
    ],
)
def test_options_of_training(tiny_data, tmp_path, monkeypatch, options):
    monkeypatch.setattr(step, "ORTHOGONALIZE_EVERY", 1)
    trainer = trained_there(small_config(tiny_data, tmp_path, max_num_iterations=2, **options))
    trainer.pipeline.test_mode = "test"
    found = trainer.pipeline.eval().get_average_eval_image_metrics()
    assert found["psnr"] > 0
    assert ("psnr_refined" in found) == ("refine_held_out" in options)


def test_a_stream_trains(tiny_data, tmp_path):
    trainer = trained_there(online_config(tmp_path, tiny_data, max_num_iterations=4, watch_every=1))
    assert isinstance(trainer, OnlineTrainer)
    recent = trainer.stream.pools.recent(1e6, 2)
    assert recent is not None
    score, picture = trainer.pipeline.look_at(recent)
    assert score > 0
    assert picture.device.type == "cpu"
    assert trainer.stream.least.by_frame


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_trains(name, tiny_data, tmp_path):
    trained_there(rival_config(name, tiny_data, tmp_path, max_num_iterations=2))
