import json
import pickle
from pathlib import Path

import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.storage import bundle
from rgbavatar_ns.errors import UserError
from tests.avatar.small_head import front_camera, random_theta


def assert_renders_the_same(first: Avatar, second: Avatar) -> None:
    theta, background = random_theta(first.layout, 2), torch.rand(2, 3)
    one, other = (a.render(theta, front_camera(24), background) for a in (first, second))
    assert torch.equal(one.image, other.image)
    assert torch.equal(one.alpha, other.alpha)


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def checkpoint_of(avatar: Avatar) -> dict:
    """What nerfstudio's trainer saves of a pipeline whose model holds `avatar`."""
    pipeline = {f"_model.avatar.{name}": value for name, value in avatar.state_dict().items()}
    pipeline["_model.device_indicator_param"] = torch.empty(0)
    pipeline["_model._extra_state"] = {"avatar": avatar.to_state()}
    return {"step": 12, "pipeline": pipeline, "optimizers": {}, "schedulers": {}, "scalers": {}}


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
