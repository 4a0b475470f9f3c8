"""Threads that wait between calls: forked processes, many callers, the end of a process."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from rgbavatar_ns.kernels import available_backends, rasterize
from rgbavatar_ns.threads import using_threads
from tests.kernels.scenes import random_scene, to

pytestmark = pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled")

_FORKS = """
import os, sys
import torch
from rgbavatar_ns.kernels import rasterize
from tests.kernels.scenes import random_scene, to

torch.set_num_threads(3)
scene = to(random_scene(0, batch=2, count=300, width=80, height=70), torch.float32)
draw = lambda: rasterize(scene.gaussians, scene.cameras, backend="cpu").image.numpy()
expected = draw()
for _ in range(5):
    child = os.fork()
    if child == 0:  # which has none of the threads that wait here
        os._exit(0 if (draw() == expected).all() and (draw() == expected).all() else 1)
    if os.waitpid(child, 0)[1]:
        sys.exit("a forked process drew something else")
    assert (draw() == expected).all()
print("drawn")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_draws_with_threads_of_its_own():
    command = [sys.executable, "-c", _FORKS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, "drawn"), done.stderr


def test_a_thread_that_begins_while_another_draws_with_one_gets_the_usual_number():
    def after_one_block(_: int) -> int:
        with using_threads(1):
            assert torch.get_num_threads() == 1
        return torch.get_num_threads()

    def of_its_own(_: int) -> int:
        torch.set_num_threads(2)
        return after_one_block(0)

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with using_threads(1), ThreadPoolExecutor(1) as newcomer:
            first, second = newcomer.map(after_one_block, range(2))
        with using_threads(1), ThreadPoolExecutor(1) as newcomer:
            (own,) = newcomer.map(of_its_own, range(1))
        with ThreadPoolExecutor(1) as newcomer:
            with using_threads(1):
                asked_within = newcomer.submit(torch.get_num_threads).result()
            late = newcomer.submit(after_one_block, 0).result()
        after = torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
    assert (first, second, own, after) == (3, 3, 2, 3)
    assert (asked_within, late) == (1, 3)


def _scene(seed: int):
    return to(random_scene(seed, batch=2, count=200, width=70, height=50), torch.float32)


@torch.no_grad()
def test_callers_at_the_same_time_draw_what_each_would_alone():
    scenes = [_scene(seed) for seed in range(4)]

    def draw(place: int):
        scene = scenes[place % len(scenes)]
        return rasterize(scene.gaussians, scene.cameras, backend="cpu").image

    expected = [draw(place) for place in range(len(scenes))]
    with using_threads(3), ThreadPoolExecutor(6) as callers:
        for place, image in enumerate(callers.map(draw, range(60))):
            assert torch.equal(image, expected[place % len(scenes)])


@torch.no_grad()
def test_any_number_of_threads_draws_the_same_one_after_another():
    scene = _scene(1)
    pictures = []
    for threads in (1, 4, 2, 1, 3, 4, 8):
        with using_threads(threads):
            pictures.append(rasterize(scene.gaussians, scene.cameras, backend="cpu").image)
    assert all(torch.equal(picture, pictures[0]) for picture in pictures)
