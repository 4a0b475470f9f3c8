"""A picture never waits for more than the step that is being taken."""

import threading
import time

import pytest

from rgbavatar_ns.plugin.training.turns import TurnsLock


def test_who_waits_comes_before_who_has_just_had_it():
    lock, order = TurnsLock(), []

    def picture() -> None:
        with lock:
            order.append("picture")

    thread = threading.Thread(target=picture)
    with lock:
        thread.start()
        while len(lock._queue) < 2:
            time.sleep(0.001)
    with lock:
        order.append("step")
    thread.join(5.0)
    assert order == ["picture", "step"]


def test_one_at_a_time():
    lock, inside, most = TurnsLock(), [], []

    def work() -> None:
        for _ in range(50):
            with lock:
                inside.append(1)
                most.append(len(inside))
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10.0)
    assert most == [1] * 200


def test_who_is_interrupted_while_waiting_leaves_the_queue(monkeypatch: pytest.MonkeyPatch):
    lock = TurnsLock()

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    with lock, monkeypatch.context() as patch:
        patch.setattr(lock._changed, "wait_for", interrupted)
        with pytest.raises(KeyboardInterrupt), lock:
            pass
    with lock:
        assert len(lock._queue) == 1
