"""Opening a long dataset again is quick and decodes nothing."""

import json
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import DatasetWriter, TrackedFrame, load_dataset
from rgbavatar_ns.head import HeadModel
from tests.data.small_dataset import odd_camera

FRAMES, SIZE = 5000, 512
SECONDS, BYTES = 5.0, 100 * 2**20
"""The images alone would take 5 GB decoded."""


@pytest.fixture(scope="module")
def long_dataset(tmp_path_factory) -> Path:
    """5,000 frames with cameras of their own; the images are links to one."""
    folder, head = tmp_path_factory.mktemp("long"), HeadModel.embedded()
    identity = torch.zeros(head.num_identity)
    writer = DatasetWriter(folder, "makehuman", identity, head.layout, SIZE, SIZE)
    camera = replace(odd_camera(), width=SIZE, height=SIZE)
    image = np.full((SIZE, SIZE, 4), 200, np.uint8)
    writer.add(TrackedFrame(0, torch.zeros(head.layout.size), camera, image))
    writer.finish(0)
    index = json.loads((folder / "dataset.json").read_text())
    camera, first = index.pop("camera"), folder / index["frames"][0]["image"]
    frames = []
    for number in range(FRAMES):
        path = folder / f"images/{number:05d}.png"
        if number:
            path.hardlink_to(first)
        frames.append({"index": number, "image": f"images/{number:05d}.png", "camera": camera})
    index |= {"version": 2, "frames": frames, "test": list(range(FRAMES - 350, FRAMES))}
    del index["test_frames"]
    (folder / "dataset.json").write_text(json.dumps(index))
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
