import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.storage import bundle
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, neutral_frame
from rgbavatar_ns.driving.transfer import reference_of
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel, ThetaLayout
from rgbavatar_ns.head.flame import load_flame
from tests.avatar.small_head import front_camera, random_theta
from tests.fuzz.avatars import checkpoint_of


@pytest.fixture(autouse=True)
def no_heads_named(monkeypatch):
    for name in ("RGBAVATAR_HEAD", "RGBAVATAR_FLAME"):
        monkeypatch.delenv(name, raising=False)


def assert_renders_the_same(first: Avatar, second: Avatar) -> None:
    theta, background = random_theta(first.layout, 2), torch.rand(2, 3)
    one, other = (a.render(theta, front_camera(24), background) for a in (first, second))
    assert torch.equal(one.image, other.image)
    assert torch.equal(one.alpha, other.alpha)


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"num_bases": 0},
        {"weight_network": "linear", "pose_input": False, "tangent_variant": "raw"},
        {"scale_with_triangle": True, "translation_input": True},
    ],
)
def test_a_bundle_renders_the_same_bits(make_avatar, tmp_path, changes):
    avatar = make_avatar(random=True, **changes)
    avatar.color_initialized[3] = True
    avatar.save(tmp_path / "me")
    loaded = Avatar.load(tmp_path / "me")
    assert loaded.config == avatar.config
    assert loaded.layout == avatar.layout
    assert torch.equal(loaded.color_initialized, avatar.color_initialized)
    assert_renders_the_same(avatar, loaded)
    assert names_in(tmp_path / "me") == {"avatar.safetensors", "avatar.json"}


def test_saving_again_replaces_the_bundle_unless_it_fails(make_avatar, tmp_path, monkeypatch):
    make_avatar().save(tmp_path / "me")
    avatar = make_avatar(random=True)
    avatar.save(tmp_path / "me")
    assert_renders_the_same(avatar, Avatar.load(tmp_path / "me"))
    assert names_in(tmp_path) == {"me"}

    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(bundle, "save_file", full)
    with pytest.raises(UserError, match=r"no space left.*Free some space"):
        make_avatar().save(tmp_path / "me")
    assert_renders_the_same(avatar, Avatar.load(tmp_path / "me"))
    assert names_in(tmp_path) == {"me"}


def test_a_folder_of_something_else_is_not_overwritten(make_avatar, tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(UserError, match="not an avatar bundle"):
        make_avatar().save(tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_a_checkpoint_loads_without_its_trainer(make_avatar, tmp_path):
    avatar = make_avatar(random=True)
    torch.save(checkpoint_of(avatar), tmp_path / "step-000000012.ckpt")
    assert_renders_the_same(avatar, Avatar.load(tmp_path / "step-000000012.ckpt"))


def test_a_run_gives_its_newest_readable_checkpoint(make_avatar, tmp_path, caplog):
    models = tmp_path / "nerfstudio_models"
    models.mkdir()
    old, middle = make_avatar(), make_avatar(random=True)
    torch.save(checkpoint_of(old), models / "step-000000009.ckpt")
    torch.save(checkpoint_of(middle), models / "step-000000100.ckpt")
    whole = (models / "step-000000100.ckpt").read_bytes()
    (models / "step-000000200.ckpt").write_bytes(whole[: len(whole) // 2])
    for folder in (tmp_path, models):
        with caplog.at_level("WARNING"):
            assert_renders_the_same(middle, Avatar.load(folder))
        assert "step-000000200.ckpt cannot be read" in caplog.text


def test_a_checkpoint_holds_nothing_that_runs(make_avatar, tmp_path):
    class Malice:
        def __reduce__(self):
            return print, ("run",)

    path = tmp_path / "step-000000001.ckpt"
    torch.save({"pipeline": Malice()}, path)
    with pytest.raises(UserError, match="cannot be read"):
        Avatar.load(path)
    path.write_bytes(pickle.dumps(Malice()))
    with pytest.raises(UserError, match="cannot be read"):
        Avatar.load(path)


def test_what_is_no_avatar_is_refused(make_avatar, tmp_path):
    with pytest.raises(UserError, match="There is no"):
        Avatar.load(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(UserError, match="neither an avatar bundle nor a checkpoint"):
        Avatar.load(tmp_path / "notes.txt")
    with pytest.raises(UserError, match=r"holds neither avatar\.json"):
        Avatar.load(tmp_path)
    torch.save({"pipeline": {"_model.means": torch.zeros(3)}}, tmp_path / "other.ckpt")
    with pytest.raises(UserError, match="holds no avatar"):
        Avatar.load(tmp_path / "other.ckpt")


def test_another_version_is_refused(make_avatar, tmp_path):
    make_avatar().save(tmp_path / "me")
    manifest = tmp_path / "me" / "avatar.json"
    values = json.loads(manifest.read_text())
    for change, message in (
        ({"version": 99}, "version 99.*version 1"),
        ({"format": "something"}, "does not describe an avatar bundle"),
    ):
        manifest.write_text(json.dumps(values | change))
        with pytest.raises(UserError, match=message):
            Avatar.load(tmp_path / "me")


@pytest.mark.parametrize("name", ["avatar.safetensors", "avatar.json"])
def test_a_damaged_bundle_is_refused(make_avatar, tmp_path, name):
    make_avatar().save(tmp_path / "me")
    path = tmp_path / "me" / name
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match=rf"damaged.*{name}"):
        Avatar.load(tmp_path / "me")
    path.unlink()
    with pytest.raises(UserError):
        Avatar.load(tmp_path / "me")


def test_a_missing_part_is_named(make_avatar, tmp_path):
    checkpoint = checkpoint_of(make_avatar())
    del checkpoint["pipeline"]["_model.avatar.blendshapes.position"]
    torch.save(checkpoint, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match=r"lacks.*blendshapes\.position"):
        Avatar.load(tmp_path / "a.ckpt")


def _picture(avatar: Avatar) -> torch.Tensor:
    with torch.no_grad():
        return avatar.render(random_theta(avatar.layout, 1), front_camera(24)).image


def test_a_bundle_without_its_head_wants_the_very_file(make_avatar, tmp_path, monkeypatch):
    avatar = make_avatar(random=True)
    avatar.save(tmp_path / "me", with_head=False)
    held = (tmp_path / "me" / "avatar.safetensors").stat().st_size
    avatar.save(tmp_path / "whole")
    assert held < (tmp_path / "whole" / "avatar.safetensors").stat().st_size
    with pytest.raises(UserError, match=r"does not hold its head model 'small'.*RGBAVATAR_HEAD"):
        Avatar.load(tmp_path / "me")

    avatar.head.arrays.save(tmp_path / "head.npz")
    monkeypatch.setenv("RGBAVATAR_HEAD", str(tmp_path / "head.npz"))
    assert torch.equal(_picture(Avatar.load(tmp_path / "me")), _picture(avatar))

    monkeypatch.setenv("RGBAVATAR_HEAD", str(tmp_path / "gone.npz"))
    with pytest.raises(UserError, match=r"gone\.npz"):
        Avatar.load(tmp_path / "me")
    HeadArrays.embedded().save(tmp_path / "other.npz")
    monkeypatch.setenv("RGBAVATAR_HEAD", str(tmp_path / "other.npz"))
    with pytest.raises(UserError, match="'makehuman' found here is not the 'small'"):
        Avatar.load(tmp_path / "me")


def _avatar(head: HeadModel) -> Avatar:
    config = AvatarConfig(num_bases=0, uv_resolution=12)
    return Avatar(head, torch.zeros(head.num_identity), config)


def test_the_embedded_head_is_always_there(tmp_path):
    avatar = _avatar(HeadModel.embedded())
    avatar.save(tmp_path / "me", with_head=False)
    assert torch.equal(_picture(Avatar.load(tmp_path / "me")), _picture(avatar))


def test_flame_is_found_by_its_version_and_form(tmp_path, monkeypatch, flame_2020_pickle):
    sizes = {"num_identity": 3, "num_expressions": 5}
    avatar = _avatar(HeadModel(load_flame(flame_2020_pickle, teeth_form="blocks", **sizes)))
    avatar.save(tmp_path / "me", with_head=False)
    with pytest.raises(UserError, match=r"FLAME 2020.*RGBAVATAR_FLAME"):
        Avatar.load(tmp_path / "me")
    monkeypatch.setenv("RGBAVATAR_FLAME", str(flame_2020_pickle.parent.parent))
    avatar.save(tmp_path / "whole")
    found, held = Avatar.load(tmp_path / "me"), Avatar.load(tmp_path / "whole")
    assert torch.equal(_picture(found), _picture(held))
    assert torch.allclose(_picture(found), _picture(avatar), atol=1e-4)
    monkeypatch.setenv("RGBAVATAR_FLAME", str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="nowhere"):
        Avatar.load(tmp_path / "me")


def test_a_digest_knows_every_number_and_survives_the_file(make_avatar, tmp_path):
    arrays = make_avatar().head.arrays
    arrays.save(tmp_path / "head.npz")
    assert HeadArrays.load(tmp_path / "head.npz").digest() == arrays.digest()
    changed = replace(arrays, v_template=arrays.v_template + 1e-6)
    assert changed.digest() != arrays.digest()


def test_a_head_has_the_digest_that_bundles_of_before_name():
    assert HeadArrays.embedded().digest().startswith("e051afbf4dfe7848")


def _statistics(avatar: Avatar, count: int = 12) -> TrainingStatistics:
    theta = random_theta(avatar.layout, count)
    with torch.no_grad():
        views = front_camera(24).world_to_camera
        return TrainingStatistics.of(theta, avatar.weights(theta), avatar.layout, views)


def test_statistics_and_layout_are_inside_the_bundle(make_avatar, tmp_path):
    avatar = make_avatar(random=True)
    written = _statistics(avatar)
    avatar.save(tmp_path / "me", statistics=written)
    read = load_avatar(tmp_path / "me").training_statistics
    assert read is not None
    for name, value in vars(written).items():
        same = getattr(read, name)
        assert torch.equal(same, value) if isinstance(value, torch.Tensor) else same == value
    manifest = json.loads((tmp_path / "me" / "avatar.json").read_text())
    assert ThetaLayout.from_json(manifest["layout"]) == avatar.layout
    assert Avatar.load(tmp_path / "me").layout == avatar.layout


def _same_statistics(first: TrainingStatistics | None, second: TrainingStatistics) -> bool:
    assert first is not None
    return all(
        torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other
        for value, other in zip(vars(first).values(), vars(second).values())
    )


def test_what_was_seen_goes_from_file_to_file(make_avatar, tmp_path):
    avatar = make_avatar(random=True)
    assert avatar.training_statistics is None
    written, others = _statistics(avatar), _statistics(avatar, 5)
    avatar.save(tmp_path / "first", statistics=written)
    loaded = Avatar.load(tmp_path / "first")
    loaded.save(tmp_path / "second")
    assert _same_statistics(load_avatar(tmp_path / "second").training_statistics, written)
    loaded.without_undrawn().save(tmp_path / "third")
    assert _same_statistics(load_avatar(tmp_path / "third").training_statistics, written)
    loaded.save(tmp_path / "fourth", statistics=others)
    assert _same_statistics(load_avatar(tmp_path / "fourth").training_statistics, others)
    checkpoint = checkpoint_of(avatar)
    checkpoint["pipeline"]["_model._extra_state"]["statistics"] = written.to_state()
    torch.save(checkpoint, tmp_path / "step-000000012.ckpt")
    Avatar.load(tmp_path / "step-000000012.ckpt").save(tmp_path / "fifth")
    assert _same_statistics(load_avatar(tmp_path / "fifth").training_statistics, written)


def test_a_bundle_and_an_earlier_run_may_have_none(make_avatar, tmp_path):
    make_avatar().save(tmp_path / "me")
    assert load_avatar(tmp_path / "me").training_statistics is None
    earlier = Path(__file__).parents[2] / "golden" / "step-000000007.ckpt"
    assert load_avatar(earlier).training_statistics is None
    with pytest.raises(UserError, match="There is no"):
        load_avatar(tmp_path / "nobody")


def test_statistics_of_before_have_the_views_of_most_films(make_avatar):
    avatar = make_avatar()
    state, layout = _statistics(avatar).to_state(), avatar.layout
    for name in ("turn_low", "turn_high"):
        del state[name]
    seen = TrainingStatistics.from_state(state, layout)
    assert seen.turn_low.tolist() == [-15] * 3
    assert seen.turn_high.tolist() == [15] * 3
    assert [end.tolist() for end in seen.turn_reach()] == [[-45] * 2, [45] * 2]
    with pytest.raises(UserError, match="turn_low does not fit"):
        TrainingStatistics.from_state(state | {"turn_low": torch.zeros(2)}, layout)


def test_the_reach_is_thirty_degrees_at_least_even_of_a_film_from_one_side(make_avatar):
    layout = make_avatar().layout
    theta = torch.zeros(60, layout.size)
    theta[:, layout.slice("neck").start + 1] = torch.linspace(-0.6, -0.4, 60)
    views = front_camera(24).world_to_camera
    seen = TrainingStatistics.of(theta, torch.zeros(60, 1), layout, views)
    low, high = seen.turn_reach()
    assert low.tolist() == pytest.approx([-30, -30], abs=0.1)
    assert high.tolist() == pytest.approx([math.degrees(0.6) + 30, 30], abs=0.3)


def test_what_is_beyond_is_told_by_number_and_by_view(make_avatar):
    layout = make_avatar().layout
    theta = torch.zeros(10, layout.size)
    theta[:, 0] = torch.linspace(0, 1, 10)
    views = front_camera(24).world_to_camera
    seen = TrainingStatistics.of(theta, torch.zeros(10, 1), layout, views)
    asked = torch.zeros(3, layout.size)
    asked[1, 0], asked[2, layout.slice("translation")] = 1.2, 5.0
    turns = torch.tensor([[0.0, 4, 0], [9, 0, 0], [0, 0, 90]])
    numbers, view = seen.beyond(asked, turns)
    # A tenth of the range, five degrees, and where the head is or how it lies do not count.
    assert numbers.nonzero().tolist() == [[1, 0]]
    assert view.tolist() == [False, True, False]
    assert not seen.beyond(theta, torch.zeros(1, 3))[0].any()


def test_statistics_that_lack_a_part_are_refused(make_avatar, tmp_path):
    avatar = make_avatar()
    avatar.save(tmp_path / "me", statistics=_statistics(avatar))
    path = tmp_path / "me" / "avatar.json"
    manifest = json.loads(path.read_text())
    del manifest["sha256"]
    del manifest["statistics"]["psi_max"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(UserError, match="lack psi_max"):
        load_avatar(tmp_path / "me")
    del manifest["state"]["anchors"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=r"damaged.*lacks anchors"):
        Avatar.load(tmp_path / "me")


def test_of_the_calm_frames_the_one_with_the_mouth_closed_is_neutral(make_avatar):
    layout = make_avatar().layout
    theta = torch.zeros(3, layout.size)
    theta[:, 0] = torch.tensor([1.0, 1.15, 3.0])
    theta[:, layout.slice("jaw").start] = torch.tensor([0.1, 0.01, 0.0])
    # Sums 1.1, 1.16 and 3.0: the last one's jaw is closed, but its face is not calm.
    assert torch.equal(neutral_frame(theta, layout), theta[1])


def test_where_a_head_lies_upon_its_body_does_not_decide_which_frame_is_calm():
    bust = HeadModel.embedded(name=EMBEDDED_BUST)
    layout, names = bust.layout, bust.arrays.expression_names
    theta = torch.zeros(2, layout.size)
    first = layout.slice("expression").start
    smile, neck_up = (first + names.index(name) for name in ("mouthSmileLeft", "neckUp"))
    theta[0, neck_up], theta[1, smile] = 2.0, 0.9  # two centimetres; nearly all of a smile
    theta[:, layout.slice("jaw").start] = torch.tensor([0.01, 0.0])
    assert torch.equal(neutral_frame(theta, layout, names), theta[0])
    seen = TrainingStatistics.of(theta, torch.zeros(2, 1), layout, expression_names=names)
    assert torch.equal(seen.theta_neutral, theta[0])
    assert torch.equal(reference_of(theta, layout, names).neutral, theta[0])


def test_values_worked_by_hand(make_avatar):
    avatar = make_avatar()
    layout = avatar.layout
    theta = torch.zeros(3, layout.size)
    theta[:, 0] = torch.tensor([0.3, 0.9, 0.6])
    theta[:, layout.slice("neck").start] = torch.tensor([9.0, 0.0, 3.0])
    psi = torch.tensor([[1.0], [-2.0], [0.5]])
    seen = TrainingStatistics.of(theta, psi, layout)
    assert seen.num_frames == 3
    assert seen.theta_mean[0].item() == pytest.approx(0.6)
    assert seen.theta_std[0].item() == pytest.approx(0.06**0.5)
    assert (seen.psi_min.item(), seen.psi_max.item()) == (-2.0, 1.0)
    # The pose does not decide which frame is at rest, nor is it a component.
    assert torch.equal(seen.theta_neutral, theta[0])
    expected = torch.zeros(layout.size)
    expected[0] = 1
    assert len(seen.components) == 1
    assert torch.allclose(seen.components[0].abs(), expected)
    assert seen.component_max.item() == pytest.approx(0.3)


def test_a_single_frame_and_none(make_avatar):
    avatar = make_avatar()
    theta = random_theta(avatar.layout, 1)
    seen = TrainingStatistics.of(theta, torch.zeros(1, 2), avatar.layout)
    other = random_theta(avatar.layout, 4, seed=1)
    held = seen.project(other)
    assert torch.allclose(held[:, seen.expressive], theta[:, seen.expressive].expand(4, -1))
    with pytest.raises(UserError, match="no training frames"):
        TrainingStatistics.of(theta[:0], torch.zeros(0, 2), avatar.layout)
