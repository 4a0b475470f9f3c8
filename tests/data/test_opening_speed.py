"""Opening a long dataset again is quick and decodes nothing."""

import json
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.head import HeadModel
from tests.data.small_dataset import odd_camera

FRAMES, SIZE = 5000, 512
SECONDS, BYTES = 5.0, 100 * 2**20
"""The images alone would take 5 GB decoded."""


@pytest.fixture(scope="module")
def long_dataset(tmp_path_factory) -> Path:
    """5,000 frames with cameras of their own; the images are links to one."""
    folder = tmp_path_factory.mktemp("long")
    head = HeadModel.embedded()
    (folder / "images").mkdir()
    (folder / "images/00000.png").write_bytes(
        encode_png_rgba(np.full((SIZE, SIZE, 4), 200, np.uint8))
    )
    index = {
        "format": "rgbavatar native",
        "version": 2,
        "head": "makehuman",
        "identity": [0.0] * head.num_identity,
        "layout": head.layout.to_json(),
        "width": SIZE,
        "height": SIZE,
        "test": list(range(FRAMES - 350, FRAMES)),
    }
    camera = {
        "world_to_camera": odd_camera().world_to_camera[0].tolist(),
        "focal_px": [700.1, 700.2],
        "principal_point_px": [256.3, 255.9],
    }
    frames = []
    for number in range(FRAMES):
        path = folder / f"images/{number:05d}.png"
        if number:
            path.hardlink_to(folder / "images/00000.png")
        frames.append({"index": number, "image": f"images/{number:05d}.png", "camera": camera})
    (folder / "dataset.json").write_text(json.dumps({**index, "frames": frames}))
    np.save(folder / "theta.npy", np.zeros((FRAMES, head.layout.size), np.float32))
    return folder


def test_five_thousand_frames_open_quickly_without_being_decoded(long_dataset, monkeypatch):
    def refuse(*_):
        raise AssertionError("decoded")

    monkeypatch.setattr("rgbavatar_ns.data.native.dataset.read_png_rgba", refuse)
    # Processor time: what else runs on the machine is not ours to measure.
    began = time.process_time()
    dataset = load_dataset(long_dataset)
    seconds = time.process_time() - began
    assert len(dataset) == FRAMES
    assert len(dataset.test) == 350
    assert seconds < SECONDS
    tracemalloc.start()
    load_dataset(long_dataset)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < BYTES
