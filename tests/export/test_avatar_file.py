"""The avatar's file: what is in it, in which order, and what is said where it is not whole."""

import gzip
import json
import struct

import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.avatar_file import (
    FIRST_BYTES,
    MAGIC,
    avatar_parts,
    film_range_theta,
    read_avatar_file,
)
from rgbavatar_ns.export.seen_order import seen_order
from rgbavatar_ns.export.stored_array import exact, unpacked
from rgbavatar_ns.export.views import front_camera
from rgbavatar_ns.export.web_head import head_arrays

from .subject import avatar_of, lively_theta


@pytest.fixture(scope="module")
def subject():
    avatar = avatar_of(uv_resolution=48)
    return avatar, lively_theta(avatar, 3)


@pytest.fixture
def read(tmp_path):
    def read(content: bytes):
        path = tmp_path / "me.rgbavatar"
        path.write_bytes(content)
        return read_avatar_file(path)

    return read


def test_the_file_holds_the_avatar_to_half_a_unit(subject, read):
    avatar, theta = subject
    more = {"mine": exact(np.arange(5), "uint16")}
    parts = avatar_parts(avatar, {"title": "é"}, theta, more)
    manifest, arrays = read(b"".join(parts))
    assert manifest["title"] == "é"
    assert np.array_equal(arrays["mine"][:, 0], range(5))
    assert np.allclose(arrays["theta"], theta, atol=1e-4)
    camera = front_camera(avatar, 256, 256)
    order = seen_order(avatar, film_range_theta(avatar, theta), camera).order
    shapes = avatar.blendshapes
    scale = shapes.log_scale.detach().exp().numpy()
    for name, ours in (
        ("position", shapes.position),
        ("rotation", shapes.rotation_wxyz),
        ("color", shapes.color_feature),
        ("opacity", shapes.opacity_logit.sigmoid()[:, None]),
    ):
        half = 0.501 * np.array(manifest["arrays"][name]["unit"]) + 1e-6
        assert (np.abs(arrays[name] - ours.detach()[order].numpy()) <= half).all(), name
    assert np.abs(np.log(arrays["scale"] / scale[order])).max() < 0.02
    unit = np.array(manifest["arrays"]["basis_position"]["unit"])
    bases = (unit * arrays["basis_position"]).reshape(len(order), -1, 3).transpose(1, 0, 2)
    ours = shapes.basis_position.detach()[:, order].numpy()
    assert (np.abs(bases - ours) <= 0.501 * unit.reshape(-1, 1, 3)).all()


def test_the_same_avatar_gives_the_same_bytes(subject):
    assert avatar_parts(*subject[:1], {}, subject[1], {}) == avatar_parts(
        *subject[:1], {}, subject[1], {}
    )


def test_parts_bring_every_item_once_and_the_first_is_short(read):
    avatar = avatar_of(uv_resolution=160)
    parts = avatar_parts(avatar, {}, torch.zeros(0, avatar.layout.size), {})
    assert 0.8 * FIRST_BYTES < len(parts[0]) <= FIRST_BYTES
    manifest, arrays = read(b"".join(parts))
    counts = {name: np.zeros(len(values), int) for name, values in arrays.items()}
    for part in manifest["parts"]:
        for name, first, last in part["slices"]:
            counts[name][first:last] += 1
    assert all((count == 1).all() for count in counts.values())
    there = [part["available"] for part in manifest["parts"]]
    assert there == sorted(there)
    assert there[-1] == avatar.num_gaussians
    # Whatever is drawn has arrived: base at once, bases with the next part at the latest.
    assert ["position", 0, there[0]] in manifest["parts"][0]["slices"]
    assert ["basis_position", 0, there[0]] in manifest["parts"][1]["slices"]


def test_what_is_no_whole_avatar_of_this_version_is_told(subject, read):
    avatar, theta = subject
    parts = avatar_parts(avatar, {}, theta, {})
    whole = b"".join(parts)
    for end in (9, 40, len(parts[0]) - 1, len(parts[0]) + 5, len(whole) - 1):
        with pytest.raises(UserError, match="cut off"):
            read(whole[:end])
    for content in (b"", b"PK\3\4 and more", b"<!doctype html>"):
        with pytest.raises(UserError, match="no avatar"):
            read(content)
    newer = whole[:8] + struct.pack("<I", 3) + whole[12:]
    with pytest.raises(UserError, match="version 3, and 2"):
        read(newer)
    for place in (60, 200, len(parts[0]) + 30, len(whole) - 6):
        broken = bytearray(whole)
        broken[place] ^= 0x10
        with pytest.raises(UserError, match="damaged"):
            read(bytes(broken))
    bomb = gzip.compress(bytes(1 << 25))
    with pytest.raises(UserError, match="damaged"):
        read(MAGIC + struct.pack("<II", 2, len(bomb)) + bomb)


def _with_manifest(whole: bytes, change) -> bytes:
    (length,) = struct.unpack_from("<I", whole, 12)
    manifest = json.loads(gzip.decompress(whole[16 : 16 + length]))
    change(manifest)
    described = gzip.compress(json.dumps(manifest).encode())
    return whole[:12] + struct.pack("<I", len(described)) + described + whole[16 + length :]


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest: manifest.pop("parts"),
        lambda manifest: manifest["parts"][0].update(bytes=-5),
        lambda manifest: manifest["parts"][0].update(bytes="many"),
        lambda manifest: manifest["parts"][1].update(slices=[["position", 10**15, 0]]),
        lambda manifest: manifest["parts"][1].update(slices=[["position", 0, 10**15]]),
        lambda manifest: manifest["parts"][1].update(slices=[["nothing", 0, 1]]),
        lambda manifest: manifest["arrays"]["position"].update(stored="object"),
        lambda manifest: manifest["arrays"]["position"].update(columns=0),
        lambda manifest: manifest["arrays"]["position"].update(columns=7),
        lambda manifest: manifest["arrays"]["position"].update(unit=[1.0, None]),
        lambda manifest: manifest["arrays"].update(position=None),
    ],
)
def test_a_manifest_that_cannot_be_is_told(subject, read, change):
    avatar, theta = subject
    whole = b"".join(avatar_parts(avatar, {}, theta, {}))
    assert read(_with_manifest(whole, lambda manifest: None))[0]["num_gaussians"] > 0
    with pytest.raises(UserError, match="cannot be used"):
        read(_with_manifest(whole, change))


def test_the_films_ends_are_looked_at_with_the_head_at_rest():
    avatar = avatar_of()
    theta = lively_theta(avatar, 5)
    assert len(film_range_theta(avatar, theta)) == 1 + 5, "no film is known"
    avatar.widen_film_range(theta)
    film = film_range_theta(avatar, theta)
    assert len(film) == 1 + 3 + 5
    still = torch.zeros(avatar.layout.size, dtype=torch.bool)
    for name in ("rotation", "neck", "translation"):
        still[avatar.layout.slice(name)] = True
    assert (film[:, still] == 0).all()
    assert torch.equal(film[1][~still], theta.amin(0)[~still])


def test_the_files_head_is_the_avatars_where_gaussians_are(subject):
    avatar, _ = subject
    arrays = {name: _unpack(array) for name, array in head_arrays(avatar).items()}
    triangles = avatar.anchors.triangles(with_rest_length=False)["triangle_vertices"].numpy()
    with torch.no_grad():
        rest = avatar.head(torch.zeros(1, avatar.layout.size), avatar.identity)[0].numpy()
    corners = arrays["triangle_vertices"]
    assert np.abs(arrays["neutral_vertices"][corners] - rest[triangles]).max() < 1e-5
    weights = avatar.head.arrays.skinning_weights
    assert np.abs(arrays["skinning_weights"][corners] - weights[triangles]).max() < 1e-4
    start, vertex = arrays["offset_start"][:, 0], arrays["offset_vertex"][:, 0]
    expressions = avatar.head.arrays.shapedirs[..., avatar.head.arrays.num_identity :]
    assert len(start) == expressions.shape[-1] + 1
    for column in (0, 24, expressions.shape[-1] - 1):
        places = slice(start[column], start[column + 1])
        rebuilt = np.zeros_like(arrays["neutral_vertices"])
        rebuilt[vertex[places]] = arrays["offset_value"][places] * arrays["offset_unit"][column]
        off = np.abs(rebuilt[corners] - expressions[triangles][..., column])
        assert off.max() < 2.6e-5, "half of a step of 50 micrometres"
    # The box that cameras turn about, from all sides.
    counted, kept = weights[:, 0] < 0.5, arrays["skinning_weights"][:, 0] < 0.5
    axes = np.linalg.qr(np.random.default_rng(0).standard_normal((20, 3, 3)))[0]
    for turn in axes:
        whole, ours = rest[counted] @ turn, arrays["neutral_vertices"][kept] @ turn
        assert np.abs(whole.max(0) - ours.max(0)).max() < 2e-4


def _unpack(array):
    return unpacked(array.described(), array.packed(0, array.items)).T
