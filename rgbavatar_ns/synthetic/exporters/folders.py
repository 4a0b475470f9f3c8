"""A take written as each system would have left it on disk."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.native.writer import DatasetWriter
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.files import disk_errors, write_json
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.joints import JOINT_FIELDS, ROOT
from rgbavatar_ns.head.layout import RIGID_FIELDS
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_6d_rows
from rgbavatar_ns.head.teeth import with_teeth
from rgbavatar_ns.synthetic.exporters.take import Take, TakeFrame

_OPENGL_ROWS = np.diag([1.0, -1.0, -1.0, 1.0])
_IMAVATAR_SCALE = 4.0
_VALIDATION = 20
_VHAP_VERTICES = 5023 + 120
_TEXTURE = 140
_JPEG_QUALITY = 98


class TakeWriter:
    """Writes frame after frame, then what tells of them all."""

    def __init__(self, dst: Path, take: Take) -> None:
        self._dst, self._take = dst, take
        self._frames: list[dict[str, Any]] = []

    def add(self, frame: TakeFrame) -> None:
        """Write one frame's files, and note its entry of the index."""
        raise NotImplementedError

    def finish(self) -> None:
        """Write the index, where the format has one."""


class NativeWriter(TakeWriter):
    """The project's own format, to measure others against: FLAME with teeth, theta as it is."""

    def __init__(self, dst: Path, take: Take) -> None:
        super().__init__(dst, take)
        arrays = with_teeth(take.arrays)
        self._layout = HeadModel(arrays).layout
        identity = torch.from_numpy(take.identity).float()
        self._writer = DatasetWriter(dst, arrays, identity, self._layout, take.width, take.height)

    def add(self, frame: TakeFrame) -> None:
        """One frame's image, theta and camera."""
        parts = {name: torch.from_numpy(part).float() for name, part in frame.theta.items()}
        theta = self._layout.join(parts)
        self._writer.add(TrackedFrame(frame.index, theta, frame.camera, frame.image_rgba))

    def finish(self) -> None:
        """dataset.json."""
        self._writer.finish(self._take.num_test_frames)


class MetricalWriter(TakeWriter):
    """metrical-tracker's output; mattes lie beside it in `alpha`, since it has none."""

    def add(self, frame: TakeFrame) -> None:
        """One frame's files."""
        _write_checkpoint(self._dst, self._take, frame)
        _write_color(self._dst / f"input/{frame.index:05d}.png", frame)
        _write_image(self._dst / f"alpha/{frame.index:05d}.png", frame.image_rgba[..., 3])


class FlashAvatarWriter(TakeWriter):
    """FlashAvatar: JPEG files whose number is the frame's plus one."""

    def add(self, frame: TakeFrame) -> None:
        """One frame's files; the parsing masks are the matte's lower and upper half."""
        output = self._dst / "metrical-tracker" / "output" / self._take.name
        _write_checkpoint(output, self._take, frame)
        number = frame.index + 1
        alpha = frame.image_rgba[..., 3]
        _write_color(self._dst / f"imgs/{number:05d}.jpg", frame)
        _write_image(self._dst / f"alpha/{number:05d}.jpg", alpha)
        face = np.where(alpha > 127, 255, 0).astype(np.uint8)
        mouth = face.copy()
        mouth[: len(mouth) // 2] = 0
        _write_image(self._dst / f"parsing/{number:05d}_neckhead.png", face)
        _write_image(self._dst / f"parsing/{number:05d}_mouth.png", mouth)


class InstaWriter(TakeWriter):
    """INSTA: OpenCV cameras in transforms.json, `.frame` files, meshes and expressions."""

    def __init__(self, dst: Path, take: Take) -> None:
        super().__init__(dst, take)
        self._head = HeadModel(take.arrays, torch.float64)
        self._shared: dict[str, Any] = {}
        for name in ("images", "flame/exp", "meshes"):
            (dst / name).mkdir(parents=True, exist_ok=True)

    def add(self, frame: TakeFrame) -> None:
        """One frame's files and its entry."""
        number = f"{frame.index:05d}"
        _write_checkpoint(self._dst, self._take, frame)
        (self._dst / f"images/{number}.png").write_bytes(encode_png_rgba(frame.image_rgba))
        expression = "\n".join(f"{value:.9g}" for value in frame.theta["expression"])
        (self._dst / f"flame/exp/{number}.txt").write_text(expression + "\n")
        (self._dst / f"meshes/{number}.obj").write_text(self._mesh(frame))
        self._shared = _intrinsics(frame, self._take)
        self._frames.append(
            {
                "file_path": f"images/{number}.png",
                "mesh_path": f"meshes/{number}.obj",
                "exp_path": f"flame/exp/{number}.txt",
                "transform_matrix": np.linalg.inv(_rigid_camera(self._take, frame)).tolist(),
            }
        )

    def _mesh(self, frame: TakeFrame) -> str:
        parts = {name: value for name, value in frame.theta.items() if name not in RIGID_FIELDS}
        theta = self._head.layout.join({n: torch.from_numpy(v) for n, v in parts.items()})
        with torch.no_grad():
            vertices = self._head(theta, torch.from_numpy(self._take.identity))
        return "".join(f"v {x:.7f} {y:.7f} {z:.7f}\n" for x, y, z in vertices.tolist())

    def finish(self) -> None:
        """transforms.json and the three splits; the last 20 of train are val."""
        last = len(self._frames) - self._take.num_test_frames
        train = self._frames[:last]
        write_json(self._dst / "transforms.json", {**self._shared, "frames": self._frames})
        for split, frames in (
            ("train", train),
            ("val", train[-_VALIDATION:]),
            ("test", self._frames[last:]),
        ):
            path = self._dst / f"transforms_{split}.json"
            write_json(path, {**self._shared, "frames": frames})


class VhapWriter(TakeWriter):
    """VHAP's export of one camera: OpenGL, images over white beside masks, parameters as npz."""

    def __init__(self, dst: Path, take: Take) -> None:
        super().__init__(dst, take)
        (dst / "flame_param").mkdir(parents=True, exist_ok=True)

    def add(self, frame: TakeFrame) -> None:
        """One frame's files and its entry."""
        number, theta = f"{frame.index:05d}", frame.theta
        image = f"images/{number}_00.png"
        mask, parameters = f"fg_masks/{number}_00.png", f"flame_param/{number}.npz"
        _write_image(self._dst / image, _over_white(frame.image_rgba))
        _write_image(self._dst / mask, frame.image_rgba[..., 3])
        np.savez(self._dst / parameters, **self._parameters(theta))
        camera_to_world = np.linalg.inv(_OPENGL_ROWS @ frame.world_to_camera)
        self._frames.append(
            {
                "timestep_index": frame.index,
                "timestep_index_original": frame.index,
                "timestep_id": number,
                "camera_index": 0,
                "camera_id": "00",
                **_intrinsics(frame, self._take),
                "transform_matrix": camera_to_world.tolist(),
                "file_path": image,
                "fg_mask_path": mask,
                "flame_param_path": parameters,
            }
        )

    def _parameters(self, theta: dict[str, Float[np.ndarray, "_"]]) -> dict[str, np.ndarray]:
        eyes = np.concatenate([theta["left_eye"], theta["right_eye"]])
        values = {
            "translation": theta["translation"][None],
            "rotation": theta["rotation"][None],
            "neck_pose": theta["neck"][None],
            "jaw_pose": theta["jaw"][None],
            "eyes_pose": eyes[None],
            "shape": self._take.identity,
            "expr": theta["expression"][None],
            "static_offset": np.zeros((1, _VHAP_VERTICES, 3)),
        }
        return {name: value.astype(np.float32) for name, value in values.items()}

    def finish(self) -> None:
        """transforms.json, the splits and the canonical pose."""
        last = len(self._frames) - self._take.num_test_frames
        splits = {"": self._frames, "_train": self._frames[:last], "_val": self._frames[last:]}
        splits["_test"] = self._frames[last:]
        for split, frames in splits.items():
            index = {
                "frames": frames,
                "timestep_indices": [frame["timestep_index"] for frame in frames],
                "camera_indices": [0],
            }
            write_json(self._dst / f"transforms{split}.json", index)
        zero = {name: np.zeros(3) for name in RIGID_FIELDS}
        zero |= {"left_eye": np.zeros(3), "right_eye": np.zeros(3), "expression": np.zeros(100)}
        canonical = self._parameters({**zero, "jaw": np.array([0.3, 0, 0])})
        np.savez(self._dst / "canonical_flame_param.npz", **canonical)


class IMAvatarWriter(TakeWriter):
    """IMAvatar: one JSON of all frames, a world four times as large, OpenGL rows."""

    def __init__(self, dst: Path, take: Take) -> None:
        super().__init__(dst, take)
        self._intrinsics: list[float] = []

    def add(self, frame: TakeFrame) -> None:
        """One frame's files and its entry; the head's shift goes into the camera."""
        theta, name = frame.theta, f"{frame.index:05d}"
        _write_color(self._dst / f"image/{name}.png", frame)
        _write_image(self._dst / f"mask/{name}.png", frame.image_rgba[..., 3])
        matrix = frame.world_to_camera.copy()
        matrix[:3, 3] += matrix[:3, :3] @ theta["translation"]
        matrix[:3, 3] *= _IMAVATAR_SCALE
        pose = [theta[part] for part in JOINT_FIELDS]
        size = np.array([self._take.width, self._take.height])
        self._intrinsics = [
            *(frame.focal_px / size * [-1, 1]).tolist(),
            *(frame.principal_point_px / size).tolist(),
        ]
        self._frames.append(
            {
                "file_path": f"./image/{name}",
                "world_mat": (_OPENGL_ROWS @ matrix)[:3].tolist(),
                "expression": theta["expression"].tolist(),
                "pose": np.concatenate(pose).tolist(),
                "bbox": [-1, -1, 1, 1],
                "flame_keypoints": [],
            }
        )

    def finish(self) -> None:
        """flame_params.json."""
        write_json(
            self._dst / "flame_params.json",
            {
                "frames": self._frames,
                "intrinsics": self._intrinsics,
                "shape_params": self._take.identity[:100].tolist(),
            },
        )


def _intrinsics(frame: TakeFrame, take: Take) -> dict[str, Any]:
    """As transforms.json has them: pixels, and angles of view in radians."""
    (focal_x, focal_y), (cx, cy) = frame.focal_px.tolist(), frame.principal_point_px.tolist()
    return {
        "cx": cx,
        "cy": cy,
        "fl_x": focal_x,
        "fl_y": focal_y,
        "w": take.width,
        "h": take.height,
        "camera_angle_x": 2 * math.atan(0.5 * take.width / focal_x),
        "camera_angle_y": 2 * math.atan(0.5 * take.height / focal_y),
    }


def _write_checkpoint(folder: Path, take: Take, frame: TakeFrame) -> None:
    """metrical-tracker's `checkpoint/%05d.frame`: the head stands still and the camera moves."""
    theta, matrix = frame.theta, _rigid_camera(take, frame)
    intrinsics = np.diag([*frame.focal_px, 1.0])
    intrinsics[:2, 2] = frame.principal_point_px
    flame = {
        "exp": theta["expression"],
        "shape": take.identity,
        "tex": np.zeros(_TEXTURE),
        "eyes": np.concatenate([_rows(theta["left_eye"]), _rows(theta["right_eye"])]),
        "eyelids": theta["eyelids"],
        "jaw": _rows(theta["jaw"]),
    }
    content = {
        "flame": {
            **{name: value[None].astype(np.float32) for name, value in flame.items()},
            "sh": np.zeros((1, 9, 3), np.float32),
        },
        "opencv": {
            "R": matrix[None, :3, :3].astype(np.float32),
            "t": matrix[None, :3, 3].astype(np.float32),
            "K": intrinsics[None].astype(np.float32),
        },
        "img_size": np.array([take.height, take.width]),
        "frame_id": f"{frame.index:05d}",
        "global_step": frame.index,
    }
    path = folder / f"checkpoint/{frame.index:05d}.frame"
    path.parent.mkdir(parents=True, exist_ok=True)
    # torch tells a disk that refuses by an error of its own.
    with disk_errors(path, also=(RuntimeError,)):
        torch.save(content, path)


def _rows(axis_angle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6"]:
    return matrix_to_6d_rows(axis_angle_to_matrix(torch.from_numpy(axis_angle))).numpy()


def _rigid_camera(take: Take, frame: TakeFrame) -> Float[np.ndarray, "4 4"]:
    """World-to-camera of a head that neither turns nor moves: all motion is the camera's."""
    arrays = take.arrays
    coefficients = np.concatenate([take.identity, frame.theta["expression"]])
    vertices = arrays.v_template + arrays.shapedirs.astype(np.float64) @ coefficients
    root = arrays.joint_regressor[ROOT].astype(np.float64) @ vertices
    turn = axis_angle_to_matrix(torch.from_numpy(frame.theta["rotation"])).numpy()
    motion = np.eye(4)
    motion[:3, :3] = turn
    motion[:3, 3] = root - turn @ root + frame.theta["translation"]
    return frame.world_to_camera @ motion


def _write_color(path: Path, frame: TakeFrame) -> None:
    """Colour without alpha; PNG or JPEG after the name."""
    _write_image(path, cv2.cvtColor(frame.image_rgba, cv2.COLOR_RGBA2BGR))


def _over_white(rgba: UInt8[np.ndarray, "height width 4"]) -> UInt8[np.ndarray, "height width 3"]:
    """BGR over white, fractions cut off, as VHAP makes it."""
    share = rgba[..., 3:] / 255
    bgr = cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGR)
    return (share * bgr + (1 - share) * 255).astype(np.uint8)


def _write_image(path: Path, image: UInt8[np.ndarray, "height width *channels"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # OpenCV's own writing says nothing of a disk that refuses.
    _, encoded = cv2.imencode(path.suffix, image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    path.write_bytes(encoded.tobytes())
