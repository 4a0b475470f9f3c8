"""Attacks on stored avatars of all methods: damaged bytes never pass in silence, hostile values
never crash."""

import copy
import io
import json
import math
import random
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.loading import METHODS, load_avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.methods.flashavatar import FlashAvatarConfig
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatarsConfig
from rgbavatar_ns.avatar.methods.gaussianblendshapes import GaussianBlendshapesConfig
from rgbavatar_ns.avatar.methods.monogaussianavatar import MonoGaussianAvatarConfig
from rgbavatar_ns.avatar.methods.splattingavatar import SplattingAvatarConfig
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from tests.avatar.small_head import (
    front_camera,
    random_theta,
    randomize,
    small_head,
    small_identity,
)

NAME = "stored avatars"
Attack = Callable[[Path, str, random.Random], object]
"""In a folder, on an avatar of a method."""

_SIZE = 16
_SMALL: dict[str, MethodConfig] = {
    "rgbavatar": AvatarConfig(num_bases=3, uv_resolution=10, hidden_width=16, initial_scale_m=5e-3),
    "gaussianavatars-style": GaussianAvatarsConfig(),
    "splattingavatar-style": SplattingAvatarConfig(initial_count=40),
    "flashavatar-style": FlashAvatarConfig(uv_resolution=10, hidden_width=8, hidden_layers=2),
    "gaussianblendshapes-style": GaussianBlendshapesConfig(num_points=40, num_bases=3),
    "monogaussianavatar-style": MonoGaussianAvatarConfig(
        max_points=80, deformer_width=8, attribute_width=8, offset_width=6, octaves=2
    ),
}
_MANIFEST, _TENSORS = "avatar.json", "avatar.safetensors"
_DEEP: list[Any] = []
for _ in range(200):
    _DEEP = [_DEEP]
_VALUES: list[Any] = [
    *(None, True, -1, 0, 1, 3, 10**9, 10**18, 10**400, -(10**9), 0.5, 1e300, math.nan, math.inf),
    *("", "mlp", "none", "x" * 5000, "\x1b[2J", "state/head/faces"),
    *([], {}, [1, 2, 3], ["a"], _DEEP, {"$tensor": "nowhere"}, {"$tensor": [1]}),
    {"reference": {"name": "makehuman", "sha256": "0"}},
    {"reference": {"name": "FLAME 2020", "sha256": 7, "num_identity": 10**9}},
]


def cases(seed: int, count: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """Each raises UserError, or checks what was loaded and returns."""
    attacks = (_flipped_checkpoint, _flipped_bundle, _cut, _manifest, _bundle_tensor, _checkpoint)
    for number in range(count):
        attack = attacks[number % len(attacks)]
        # Of RGBAvatar's files every second one.
        turn = number // len(attacks)
        method = list(METHODS)[0 if turn % 2 == 0 else 1 + turn // 2 % (len(METHODS) - 1)]
        name = attack.__name__.strip("_").replace("_", " ")
        rng = random.Random(f"{seed} {number}")

        def carried_out(
            attack: Attack = attack, method: str = method, rng: random.Random = rng
        ) -> None:
            with tempfile.TemporaryDirectory() as folder:
                attack(Path(folder), method, rng)

        yield f"{name} {number}, {method}", carried_out


def checkpoint_of(avatar: AvatarMethod) -> dict[str, Any]:
    """What nerfstudio's trainer saves of a pipeline whose model holds `avatar`."""
    pipeline = {f"_model.avatar.{name}": value for name, value in avatar.state_dict().items()}
    pipeline["_model.device_indicator_param"] = torch.empty(0)
    extra = {"avatar": avatar.to_state(), "layout": avatar.layout.to_json()}
    pipeline["_model._extra_state"] = extra
    return {"step": 12, "pipeline": pipeline, "optimizers": {}, "schedulers": {}, "scalers": {}}


@cache
def _avatar(method: str) -> AvatarMethod:
    avatar = METHODS[method](small_head(), small_identity(), _SMALL[method])
    if isinstance(avatar, Avatar):
        randomize(avatar)
    return avatar


@cache
def _statistics(method: str) -> TrainingStatistics:
    avatar = _avatar(method)
    theta = random_theta(avatar.layout, 5)
    return TrainingStatistics.of(theta, avatar.weights(theta).detach(), avatar.layout)


@cache
def _bundle_parts(method: str) -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        _avatar(method).save(Path(folder) / "me", statistics=_statistics(method))
        return {path.name: path.read_bytes() for path in (Path(folder) / "me").iterdir()}


@cache
def _checkpoint_bytes(method: str) -> bytes:
    file = io.BytesIO()
    torch.save(checkpoint_of(_avatar(method)), file)
    return file.getvalue()


def _save_bundle(folder: Path, method: str) -> Path:
    (folder / "me").mkdir()
    for name, content in _bundle_parts(method).items():
        (folder / "me" / name).write_bytes(content)
    return folder / "me"


def _save_checkpoint(folder: Path, method: str) -> Path:
    path = folder / "step-000000012.ckpt"
    path.write_bytes(_checkpoint_bytes(method))
    return path


def _flipped_checkpoint(folder: Path, method: str, rng: random.Random) -> None:
    path = _save_checkpoint(folder, method)
    _flip(path, rng)
    _require_same(load_avatar(path), method)


def _flipped_bundle(folder: Path, method: str, rng: random.Random) -> None:
    path = _save_bundle(folder, method)
    _flip(path / rng.choice((_MANIFEST, _TENSORS)), rng)
    seen, wanted = load_avatar(path).training_statistics, _statistics(method)
    _require_same(load_avatar(path), method)
    assert seen is not None, "the statistics are gone"
    for name, value in wanted.to_state().items():
        assert _equal(getattr(seen, name), value), f"{name} has changed"


def _cut(folder: Path, method: str, rng: random.Random) -> None:
    bundle, checkpoint = _save_bundle(folder, method), _save_checkpoint(folder, method)
    path = rng.choice((bundle / _MANIFEST, bundle / _TENSORS, checkpoint))
    content = path.read_bytes()
    start = rng.choice((0, 0, rng.randrange(len(content))))
    end = rng.randrange(start, len(content) + 1)
    path.write_bytes(content[start:end] + rng.randbytes(rng.choice((0, 0, 100))))
    _require_same(load_avatar(path if path == checkpoint else bundle), method)


def _manifest(folder: Path, method: str, rng: random.Random) -> None:
    path = _save_bundle(folder, method) / _MANIFEST
    manifest = json.loads(path.read_text())
    # As one does who wants it to be read.
    del manifest["sha256"]
    for _ in range(rng.choice((1, 1, 2, 4))):
        _spoil(manifest if rng.random() < 0.2 else manifest["state"], rng)
        if not isinstance(manifest.get("state"), dict):
            break
    path.write_text(json.dumps(manifest))
    _use(path.parent)


def _bundle_tensor(folder: Path, method: str, rng: random.Random) -> None:
    path = _save_bundle(folder, method)
    manifest = json.loads((path / _MANIFEST).read_text())
    del manifest["sha256"]
    (path / _MANIFEST).write_text(json.dumps(manifest))
    tensors = load_file(path / _TENSORS)
    for name in rng.sample(sorted(tensors), rng.choice((1, 1, 2, 5))):
        spoiled = _spoiled(tensors[name], rng)
        if spoiled.numel() < 10**7:
            tensors[name] = spoiled.contiguous().clone()
    save_file(tensors, path / _TENSORS)
    _use(path)


def _checkpoint(folder: Path, method: str, rng: random.Random) -> None:
    state = copy.deepcopy(checkpoint_of(_avatar(method)))
    for _ in range(rng.choice((1, 1, 2, 4))):
        _spoil(state if rng.random() < 0.3 else state["pipeline"], rng)
        if not isinstance(state.get("pipeline"), dict):
            break
    torch.save(state, folder / "step-000000012.ckpt")
    _use(folder)


def _flip(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 2, 50))):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def _spoil(value: Any, rng: random.Random) -> None:
    """Change one thing within."""
    while True:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        if not keys:
            return
        key = rng.choice(keys)
        inner = value[key]
        if not isinstance(inner, dict | list) or not inner or rng.random() < 0.15:
            break
        value = inner
    if isinstance(inner, Tensor):
        value[key] = _spoiled(inner, rng)
    elif rng.random() < 0.15:
        del value[key]
    elif isinstance(value, dict) and rng.random() < 0.1:
        value[rng.choice(("", "group_x", "eyelid_dirs", "unknown"))] = inner
    else:
        value[key] = copy.deepcopy(rng.choice(_VALUES))


def _spoiled(value: Tensor, rng: random.Random) -> Tensor:
    """Other numbers, another shape, or another kind."""
    dtypes = (torch.float16, torch.float64, torch.int64, torch.int32, torch.bool, torch.uint8)
    numbers = (math.nan, math.inf, -1, 0, 1e38) if value.is_floating_point() else (-1, 0, 100, 127)
    if value.dtype in (torch.int32, torch.int64):
        numbers = (*numbers, -(2**31), 2**31 - 1)
    changed = value.detach().clone()
    how = rng.randrange(6)
    if how <= 1 and changed.numel():
        place = rng.randrange(changed.numel()) if how else slice(None)
        changed.view(-1)[place] = rng.choice(numbers)
    elif how == 2:
        changed = changed.to(rng.choice(dtypes))
    elif how == 3:
        shape = list(value.shape) or [1]
        shape[rng.randrange(len(shape))] = rng.choice((0, 1, 2, 10**4, 10**12))
        # One number that claims to be many; only a checkpoint can say that.
        changed = torch.zeros(1, dtype=value.dtype).expand(shape)
    elif how == 4:
        changed = changed.flatten()[: rng.randrange(changed.numel() + 1)]
    else:
        changed = changed[None] if rng.random() < 0.5 else changed.flatten()
    return changed


def _use(path: Path) -> None:
    avatar = load_avatar(path)
    theta = random_theta(avatar.layout, 2)
    for differentiable in (False, True):
        drawn = avatar.render(
            theta, front_camera(_SIZE), with_depth=True, differentiable=differentiable
        )
        assert drawn.image.shape == (2, _SIZE, _SIZE, 3)


def _require_same(avatar: AvatarMethod, method: str) -> None:
    wanted = _avatar(method)
    assert avatar.config == wanted.config, "the config has changed"
    assert avatar.head.arrays.digest() == wanted.head.arrays.digest(), "the head has changed"
    found = avatar.state_dict()
    for name, value in wanted.state_dict().items():
        assert _equal(found[name], value), f"{name} has changed"
    if isinstance(wanted, Avatar):
        assert isinstance(avatar, Avatar), "the method has changed"
        for name, value in wanted.anchors.to_state().items():
            assert _equal(avatar.anchors.to_state()[name], value), f"{name} has changed"


def _equal(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, Tensor):
        same_kind = isinstance(found, Tensor) and found.dtype == wanted.dtype
        return same_kind and torch.equal(found, wanted)
    return type(found) is type(wanted) and found == wanted
