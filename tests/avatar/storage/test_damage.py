"""What is damaged, or written to do harm, is told before anything large is made of it."""

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints, read_checkpoint
from rgbavatar_ns.errors import UserError
from tests.fuzz.avatars import checkpoint_of

_NEWEST = "step-000000012.ckpt"


@pytest.fixture
def bundle(make_avatar, tmp_path: Path) -> Path:
    make_avatar(random=True).save(tmp_path / "me")
    return tmp_path / "me"


@pytest.fixture
def checkpoint(make_avatar, tmp_path: Path) -> Path:
    torch.save(checkpoint_of(make_avatar(random=True)), tmp_path / _NEWEST)
    return tmp_path / _NEWEST


def _change(bundle: Path, *keys: str, to: Any) -> None:
    """A value of the manifest, as one does who wants it to be read."""
    path = bundle / "avatar.json"
    manifest = json.loads(path.read_text())
    del manifest["sha256"]
    place = manifest
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = to
    path.write_text(json.dumps(manifest))


def test_a_manifest_has_the_checksums_that_others_compute(bundle: Path):
    manifest = json.loads((bundle / "avatar.json").read_text())
    sums = manifest.pop("sha256")
    tensors = (bundle / "avatar.safetensors").read_bytes()
    text = json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()
    assert sums["avatar.safetensors"] == hashlib.sha256(tensors).hexdigest()
    assert sums["avatar.json"] == hashlib.sha256(text).hexdigest()


def test_one_bit_of_a_tensor_is_told(bundle: Path, checkpoint: Path):
    for path in (bundle / "avatar.safetensors", checkpoint):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"avatar\.safetensors: it is not as it was written"):
        Avatar.load(bundle)
    with pytest.raises(UserError, match="is damaged"):
        Avatar.load(checkpoint)


def test_a_changed_value_of_a_manifest_is_told(bundle: Path):
    path = bundle / "avatar.json"
    path.write_text(path.read_text().replace('"initial_opacity": 0.5', '"initial_opacity": 0.7'))
    with pytest.raises(UserError, match=r"avatar\.json: it is not as it was written"):
        Avatar.load(bundle)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        *((("state", "config", "num_bases"), n) for n in (10**9, -1, 2, True, 2.5, None, "3")),
        *((("state", "config", "hidden_width"), n) for n in (10**9, 10**18, 0, [])),
        *((("state", "config", "initial_scale_m"), x) for x in (math.nan, math.inf, 10**18, "")),
        (("state", "config", "weight_network"), ["mlp"]),
        (("state", "config", "initial_color"), "white"),
        (("state", "config"), []),
        *((("state", "anchors", "resolution"), n) for n in (10**18, 0, "", None)),
        (("state", "anchors", "triangle_index"), {"$tensor": "state/head/faces"}),
        (("state", "anchors", "triangle_index"), {"$tensor": "nowhere"}),
        (("state", "anchors", "barycentric"), [[1, 0, 0]]),
        *((("state", "head", "num_identity"), n) for n in (10**9, -3, 1.0, None)),
        (("state", "head", "expression_names"), 7),
        (("state", "head", "faces"), {"$tensor": "state/head/v_template"}),
        (("state", "head"), {"reference": {"name": 3}}),
        (("state", "head"), {"reference": 3}),
        (("state", "identity"), None),
        (("state",), []),
        (("layout",), []),
        (("layout",), [{"name": "expression", "size": 10**9, "form": "linear"}]),
        (("version",), 10**30),
    ],
)
def test_a_hostile_manifest_is_refused(bundle: Path, keys: tuple[str, ...], value: Any):
    _change(bundle, *keys, to=value)
    with pytest.raises(UserError):
        Avatar.load(bundle)


@pytest.mark.parametrize("place", ["pipeline", "state"])
@pytest.mark.parametrize("index", [128, -1, 2**31 - 1])
def test_a_gaussian_off_the_head_is_refused(checkpoint: Path, place: str, index: int):
    state = torch.load(checkpoint, weights_only=True)
    anchors = state["pipeline"]["_model._extra_state"]["avatar"]["anchors"]["triangle_index"]
    if place == "pipeline":
        anchors = state["pipeline"]["_model.avatar.anchors.triangle_index"]
    anchors[5] = index
    torch.save(state, checkpoint)
    with pytest.raises(UserError, match="outside of the head's triangles"):
        Avatar.load(checkpoint)


def _repacked(path: Path, change: Callable[[str, bytes], bytes], how: int) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(packed, "w", how) as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    path.write_bytes(packed.getvalue())


def test_a_checkpoint_that_unpacks_is_refused(checkpoint: Path):
    _repacked(checkpoint, lambda name, content: content, zipfile.ZIP_STORED)
    Avatar.load(checkpoint)
    _repacked(checkpoint, lambda name, content: content, zipfile.ZIP_DEFLATED)
    with pytest.raises(UserError, match="compressed"):
        Avatar.load(checkpoint)


def test_a_storage_is_as_long_as_it_claims(checkpoint: Path):
    def cut(name: str, content: bytes) -> bytes:
        return content[:-4] if name.endswith("/data/7") else content

    _repacked(checkpoint, cut, zipfile.ZIP_STORED)
    with pytest.raises(UserError, match="as long as it claims"):
        Avatar.load(checkpoint)


@pytest.mark.parametrize(
    "value",
    [
        torch.zeros(1).expand(10**12),
        torch.zeros(3).to_sparse(),
        torch.zeros(3, device="meta"),
        bytearray(10),
        b"bytes",
        {1, 2},
    ],
)
def test_what_no_trainer_writes_is_refused(checkpoint: Path, value: Any):
    state = torch.load(checkpoint, weights_only=True)
    torch.save(state | {"more": value}, checkpoint)
    with pytest.raises(UserError, match="cannot be read"):
        read_checkpoint(checkpoint)


def test_values_shared_a_thousandfold_are_read_once(tmp_path: Path):
    shared: Any = [1.0]
    for _ in range(60):
        shared = [shared, shared]
    torch.save({"shared": shared}, tmp_path / _NEWEST)
    assert read_checkpoint(tmp_path / _NEWEST)["shared"][0][1][0] is not None


def test_what_is_no_file_does_not_hang(bundle: Path, tmp_path: Path):
    for name in ("avatar.json", "avatar.safetensors"):
        content = (bundle / name).read_bytes()
        for make in (os.mkfifo, os.mkdir):
            (bundle / name).unlink()
            make(bundle / name)
            with pytest.raises(UserError, match="damaged"):
                Avatar.load(bundle)
            (bundle / name).unlink() if make is os.mkfifo else (bundle / name).rmdir()
            (bundle / name).write_bytes(content)
    os.mkfifo(tmp_path / _NEWEST)
    with pytest.raises(UserError, match="no regular file"):
        Avatar.load(tmp_path / _NEWEST)
    for path in ("x" * 5000, "x" * 5000 + ".ckpt", "a\0b"):
        with pytest.raises(UserError, match="There is no"):
            Avatar.load(path)


def test_only_names_that_a_trainer_gives_are_checkpoints(tmp_path: Path):
    for name in ("step-7.ckpt", "step-000000007.ckpt.partial", "notes.txt", "step-x.ckpt"):
        (tmp_path / name).write_text("")
    (tmp_path / "step-000000003.ckpt").mkdir()
    assert [step for step, _ in list_checkpoints(tmp_path)] == [3]
    with pytest.raises(UserError, match=r"None of the 1 checkpoints.*a directory"):
        Avatar.load(tmp_path)


@pytest.mark.parametrize(("name", "size"), [("num_bases", 999), ("hidden_width", 8000)])
def test_nothing_is_built_of_a_size_that_is_not_there(
    bundle: Path, name: str, size: int, monkeypatch: pytest.MonkeyPatch
):
    _change(bundle, "state", "config", name, to=size)
    monkeypatch.setattr(Avatar, "from_state", lambda state: pytest.fail("it is built"))
    with pytest.raises(UserError, match="has the shape"):
        Avatar.load(bundle)


def test_of_an_experiments_folder_the_run_saved_last_counts(make_avatar, tmp_path: Path):
    made = {name: make_avatar(random=True, seed=seed) for seed, name in enumerate("ab")}
    for age, name in enumerate("ba"):
        models = tmp_path / "me" / "rgbavatar-tiny" / name / "nerfstudio_models"
        models.mkdir(parents=True)
        torch.save(checkpoint_of(made[name]), models / _NEWEST)
        os.utime(models / _NEWEST, ns=(0, 10**18 - age))
    (tmp_path / "me" / "rgbavatar-tiny" / "latest").symlink_to("a")
    for folder in (tmp_path / "me", tmp_path / "me" / "rgbavatar-tiny"):
        loaded = Avatar.load(folder).state_dict()
        assert all(torch.equal(loaded[k], v) for k, v in made["b"].state_dict().items())
    with pytest.raises(UserError, match="neither"):
        Avatar.load(tmp_path)


def test_a_bundle_with_files_of_others_in_it_is_not_replaced(make_avatar, bundle: Path):
    make_avatar(random=True).save(bundle)
    (bundle / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="holds other files too"):
        make_avatar(random=True).save(bundle)
    assert (bundle / "notes.txt").read_text() == "mine"
