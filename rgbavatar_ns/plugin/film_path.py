"""Which moment of the film a camera shows that nerfstudio made without theta."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from rgbavatar_ns.errors import UserError


@dataclasses.dataclass(frozen=True)
class FilmMoment:
    """A place between two frames of the dataset, given by their positions."""

    before: int
    after: int
    share: float
    """Of `after`, in [0, 1]."""

    @property
    def nearest(self) -> int:
        """The frame that is nearer."""
        return self.before if self.share < 0.5 else self.after


class FilmPath:
    """Gives the cameras of `ns-render` their moments.

    In this order: the training frame that `--camera-idx` names; the camera's time in [0, 1] of the
    film; its place in a path through a split's frames (`FilmCameras`); else one frame a camera, in
    the film's order, after the last the first.

    A path's cameras are counted: with a still camera all their poses are one, and nerfstudio draws
    each of them once, in order.
    """

    def __init__(self, frames: int, train: Sequence[int]) -> None:
        self._frames, self._train = frames, train
        self._along: list[FilmMoment] = []
        self._drawn = 0

    def begin(self, moments: Sequence[FilmMoment]) -> None:
        """A path begins whose cameras show these moments."""
        self._along, self._drawn = list(moments), 0

    def moment(self, camera: Cameras) -> FilmMoment:
        """What the next camera shows; raises UserError where it names a frame that is not there."""
        chosen = (camera.metadata or {}).get("cam_idx")
        if chosen is not None:
            return _at(self._named(int(chosen)))
        if camera.times is not None:
            return _at(frame_at(float(camera.times.reshape(-1)[0]), self._frames))
        number, self._drawn = self._drawn, self._drawn + 1
        if number < len(self._along):
            return self._along[number]
        return _at((number - len(self._along)) % self._frames)

    def _named(self, index: int) -> int:
        if not 0 <= index < len(self._train):
            raise UserError(
                f"--camera-idx is {index}, and there are {len(self._train)} training frames.",
                f"Give a number from 0 to {len(self._train) - 1}.",
            )
        return self._train[index]


class FilmCameras(Cameras):
    """A split's cameras, which tell a `FilmPath` of a path that nerfstudio lays through them.

    nerfstudio interpolates poses and intrinsics and drops everything else, so theta cannot be
    carried by the cameras of the path. But intrinsics are interpolated as tensors: with those that
    these cameras give, the frames' positions go through the same operations (`_Accompanied`). So
    the path's length, steps and order are nerfstudio's own. Slices and copies are plain cameras.
    """

    def __init__(
        self, *, path: FilmPath | None = None, positions: Sequence[int] = (), **fields: Any
    ) -> None:
        super().__init__(**fields)
        self.path, self.positions = path, positions

    @classmethod
    def of(cls, cameras: Cameras, positions: Sequence[int], path: FilmPath) -> "FilmCameras":
        """The same cameras; positions: of their frames in the dataset."""
        fields = {f.name: getattr(cameras, f.name) for f in dataclasses.fields(cameras)}
        return cls(path=path, positions=positions, **fields)

    def get_intrinsics_matrices(self) -> Float[Tensor, "*num_cameras 3 3"]:
        """nerfstudio's, accompanied where there is a path; UserError for fewer than two frames."""
        matrices = super().get_intrinsics_matrices()
        if self.path is None:
            return matrices
        if len(self) < 2:
            raise UserError(
                f"A path leads from frame to frame, and this part of the dataset has {len(self)}.",
                "Take the other one: --pose-source train or eval.",
            )
        places = torch.tensor(self.positions, dtype=torch.float64)[:, None, None]
        accompanied = matrices.as_subclass(_Accompanied)
        accompanied.companion, accompanied.when_stacked = places.expand_as(matrices), self._begin
        return accompanied

    def _begin(self, places: Float[Tensor, "path 3 3"]) -> None:
        """places: positions of frames, interpolated from each frame to the next."""
        assert self.path is not None
        self.path.begin(_moments(places[:, 0, 0].reshape(len(self) - 1, -1)))


def frame_at(time: float, frames: int) -> int:
    """The frame that a time in [0, 1] of a film means."""
    last = frames - 1
    return min(max(round(time * last), 0), last)


def _at(frame: int) -> FilmMoment:
    return FilmMoment(frame, frame, 0.0)


def _moments(places: Float[Tensor, "pairs steps"]) -> list[FilmMoment]:
    """Each pair of frames with all its steps, the first and last of which are the frames."""
    shares = torch.linspace(0, 1, places.shape[1]).tolist()
    return [
        FilmMoment(round(pair[0]), round(pair[-1]), share)
        for pair in places.tolist()
        for share in shares
    ]


class _Accompanied(Tensor):
    """A tensor through whose operations a companion of the same shape goes as well."""

    companion: Tensor | None = None
    when_stacked: Callable[[Tensor], None]

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = super().__torch_function__(func, types, args, kwargs)
        lead = _accompanied_in(args)
        if lead is not None and isinstance(result, cls):
            result.companion = func(*_companions(args), **(kwargs or {}))
            result.when_stacked = lead.when_stacked
            if func is torch.stack:
                lead.when_stacked(result.companion)
        return result


def _accompanied_in(args: Any) -> _Accompanied | None:
    """The first one among arguments, or within their lists."""
    for item in args:
        found = _accompanied_in(item) if isinstance(item, list | tuple) else item
        if isinstance(found, _Accompanied) and found.companion is not None:
            return found
    return None


def _companions(args: Any) -> Any:
    """The arguments with companions in place of those that have one."""
    if isinstance(args, list | tuple):
        return type(args)(map(_companions, args))
    with_companion = isinstance(args, _Accompanied) and args.companion is not None
    return args.companion if with_companion else args
