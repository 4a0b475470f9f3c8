"""Keys of a terminal while a command runs."""

import io
import os
import pty
import sys
import termios
import threading
from types import SimpleNamespace

from rgbavatar_ns.cli.keys import on_keys


def test_a_key_is_heard_at_once_and_the_terminal_is_as_before_afterwards(monkeypatch):
    ours, theirs = pty.openpty()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(fileno=lambda: theirs))
    before = termios.tcgetattr(theirs)
    heard, others = threading.Event(), threading.Event()
    with on_keys({"c": heard.set, "q": others.set}) as listening:
        assert listening
        os.write(ours, b"xc")  # without a line's end
        assert heard.wait(3)
    assert not others.is_set()
    assert termios.tcgetattr(theirs) == before


def test_where_there_is_no_terminal_nothing_is_heard(monkeypatch):
    read, write = os.pipe()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(fileno=lambda: read))
    with on_keys({}) as listening:
        assert not listening
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    with on_keys({}) as listening:
        assert not listening
    os.close(read)
    os.close(write)


_IN_BACKGROUND = """
import os, sys
from rgbavatar_ns.cli.keys import on_keys
if os.fork() == 0:
    os.setpgid(0, 0)  # as a shell does for a job with &
    with on_keys({}) as listening:
        os._exit(7 if listening else 3)
_, status = os.waitpid(-1, os.WUNTRACED)
print("stopped" if os.WIFSTOPPED(status) else os.WEXITSTATUS(status), flush=True)
"""


def test_in_the_background_nothing_is_heard_and_nothing_stops():
    child, ours = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", _IN_BACKGROUND])
    told = b""
    try:
        while not told.strip():
            told += os.read(ours, 1000)
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)
        os.close(ours)
    assert told.strip() == b"3"
