"""`rgbavatar drive`: what is performed is shown, every mistake is told."""

import json
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from websockets.sync.client import connect

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.cli import drive
from rgbavatar_ns.cli.drive import ShowOptions, SourceOptions
from rgbavatar_ns.cli.main import main
from rgbavatar_ns.data import DatasetWriter, TrackedFrame
from rgbavatar_ns.driving.live_transfer import LiveTransfer
from rgbavatar_ns.driving.source import PerformanceFrame
from rgbavatar_ns.export import front_camera, pictures, write_video
from rgbavatar_ns.export.live_pictures import PictureOutput
from rgbavatar_ns.export.subject import load_subject
from rgbavatar_ns.tracking.face.detector import INSTALL_MEDIAPIPE
from tests.avatar.small_head import small_head_arrays
from tests.driving.packets import packet
from tests.export.avatar_of_page import avatar_of_page
from tests.export.subject import avatar_of, lively_theta

_SIZE, _FRAMES = 32, 20


@pytest.fixture(scope="module")
def avatar(tmp_path_factory) -> Path:
    """A bundle that knows its film."""
    folder, made = tmp_path_factory.mktemp("avatar") / "me", avatar_of()
    theta = lively_theta(made, 30)
    views = front_camera(made, _SIZE, _SIZE).world_to_camera.expand(30, 4, 4)
    seen = TrainingStatistics.of(theta, torch.zeros(30, 4), made.layout, views)
    made.save(folder, statistics=seen)
    return folder


@pytest.fixture(scope="module")
def performer(tmp_path_factory) -> Path:
    """Another person's dataset."""
    other, folder = avatar_of(3), tmp_path_factory.mktemp("data") / "other"
    theta, camera = lively_theta(other, _FRAMES, 3), front_camera(other, _SIZE, _SIZE)
    writer = DatasetWriter(folder, "makehuman", other.identity, other.layout, _SIZE, _SIZE)
    for index, image in enumerate(pictures(other, theta, camera, None)):
        writer.add(TrackedFrame(index, theta[index], camera, image))
    writer.finish(3)
    return folder


def _drive(*words: object) -> None:
    main(["drive", *map(str, words)])


def _film(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as film:
        return [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]


def test_a_dataset_drives_a_film_frame_by_frame(avatar, performer, tmp_path, capsys):
    film = tmp_path / "film.mp4"
    size = ("--width", 48, "--height", 40)
    _drive(avatar, "--source", performer, "--out", film, "--beside", *size)
    frames = _film(film)
    assert [frame.shape for frame in frames] == [(40, 88, 3)] * _FRAMES
    moving = np.stack(frames)[:, :, 40:].astype(float)
    assert np.abs(np.diff(moving, axis=0)).mean() > 0.3, "the avatar moves"
    told = capsys.readouterr()
    assert f"{_FRAMES} frames" in told.err
    assert str(film) in told.err
    assert told.out == "", "standard output is for pictures"


def test_a_film_of_some_seconds_holds_as_many_of_the_recording(
    avatar, performer, tmp_path, monkeypatch
):
    film, size = tmp_path / "film.mp4", ("--width", 24, "--height", 24)
    _drive(avatar, "--source", performer, "--out", film, "--seconds", 0.4, *size)
    assert len(_film(film)) == 10, "of 20 at 25 a second, however soon they are drawn"
    slow = PictureOutput.show

    def slowly(self, frame):
        time.sleep(0.1)
        slow(self, frame)

    monkeypatch.setattr(PictureOutput, "show", slowly)
    _drive(avatar, "--source", performer, "--out", film, "--seconds", 0.4, *size)
    assert len(_film(film)) == 10, "however late"


@pytest.mark.parametrize(
    ("source", "kind"),
    [("camera", "camera"), ("0", "camera"), ("rtsp://there/1", "camera"), ("me.mp4", "film")],
)
def test_a_file_is_known_from_a_camera_by_its_name(source, kind):
    assert drive._kind(source) == kind


def test_curves_of_a_phone_drive_a_film(avatar, tmp_path):
    rows = [f"{k % 5 / 5},{k % 3 / 3}" for k in range(30)]
    (tmp_path / "take.csv").write_text("JawOpen,EyeBlinkLeft\n" + "\n".join(rows))
    film = tmp_path / "film.mp4"
    _drive(avatar, "--source", tmp_path / "take.csv", "--out", film, "--width", 32, "--height", 32)
    # Sixty frames a second in a film of 25.
    assert 12 <= len(_film(film)) <= 14


def _free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def test_packets_drive_raw_pictures_on_standard_output(avatar):
    """As a stranger does it: one program sends, the command draws, another one reads."""
    port = _free_port(socket.SOCK_DGRAM)
    words = ["--source", "arkit", "--listen", f"127.0.0.1:{port}", "--out", "-", "--seconds", "4"]
    command = [sys.executable, "-c", "from rgbavatar_ns.cli.main import main; main()", "drive"]
    driven = subprocess.Popen(
        [*command, str(avatar), *words, "--width", "24", "--height", "16"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    stop = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for k in range(100_000):
                if stop.wait(0.02):
                    return
                row = [0.0] * 52
                row[17] = k % 20 / 20
                sender.sendto(packet(row, frame=k), ("127.0.0.1", port))
                sender.sendto(b"garbage", ("127.0.0.1", port))

    sending = threading.Thread(target=send)
    sending.start()
    try:
        content, told = driven.communicate(timeout=120)
    finally:
        stop.set()
        sending.join()
    assert driven.returncode == 0, told.decode()
    assert len(content) % (24 * 16 * 3) == 0
    shown = np.frombuffer(content, np.uint8).reshape(-1, 16, 24, 3)
    assert len(shown) > 20
    assert np.ptp(shown.astype(int), axis=0).max() > 20, "the jaw opens"
    assert "unreadable" in told.decode() or "another version" in told.decode()
    assert "ms from picture to picture" in told.decode()


def test_the_page_is_served_and_driven(avatar, performer, capsys):
    port = _free_port(socket.SOCK_STREAM)
    words = ("--source", performer, "--show", "page", "--serve", f"127.0.0.1:{port}")
    words = (*words, "--source-frames-per-second", 5)
    driving = threading.Thread(target=_drive, args=(avatar, *words), daemon=True)
    driving.start()
    for _ in range(300):
        try:
            page = connect(f"ws://127.0.0.1:{port}", origin=f"http://127.0.0.1:{port}")  # type: ignore[arg-type]
            break
        except OSError:
            time.sleep(0.05)
    with page:
        assert json.loads(page.recv(timeout=5))["type"] == "hello"
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert b"<canvas" in answer.read()
        said = [json.loads(page.recv(timeout=5)) for _ in range(12)]
    frames = [message for message in said if message["type"] == "theta"]
    assert len(frames) > 5
    assert any("frames" in message.get("text", "") for message in said), "how it goes"
    assert frames[0]["theta"] != frames[-1]["theta"]
    driving.join(timeout=60)
    assert not driving.is_alive()
    told = capsys.readouterr().err
    assert f"http://127.0.0.1:{port}/?ws=ws://127.0.0.1:{port}\n" in told
    assert re.search(f"[?]ws=ws://127.0.0.1:{port}/[-_A-Za-z0-9]{{12}}\n", told), "for the disk's"


@pytest.mark.parametrize(("departs", "is_cut"), [(3e-6, True), (0.3, False)])
def test_a_page_is_cut_where_a_film_of_its_own_person_ends(avatar, tmp_path, departs, is_cut):
    made, film = avatar_of(), tmp_path / "film"
    camera = front_camera(made, 16, 12)
    # Nearer, so that what is beside the face is beyond the picture.
    camera = replace(camera, focal_px=3 * camera.focal_px)
    person = (made.identity + departs).detach()
    writer = DatasetWriter(film, made.head.arrays, person, made.layout, 16, 12)
    for index, theta in enumerate(lively_theta(made, 3, 5)):
        writer.add(TrackedFrame(index, theta, camera, np.zeros((12, 16, 4), np.uint8)))
    writer.finish(1)
    subject = load_subject(avatar, film, film=False)
    page = tmp_path / "page.html"
    page.write_bytes(drive._page_content(subject.avatar, subject, film, ShowOptions()))
    # Gaussians of no opacity are drawn by nobody, and stay out in any case.
    whole = subject.avatar.without_undrawn().num_gaussians
    shown = len(avatar_of_page(page)[1]["opacity"])
    assert (shown < whole) == is_cut


def test_the_key_for_pages_of_the_disk_is_told_in_the_terminal_once(avatar, capsys):
    where = ("--source", "websocket", "--listen", "127.0.0.1:0", "--serve", "127.0.0.1:0")
    _drive(avatar, *where, "--seconds", 4)
    lines = capsys.readouterr().err.splitlines()
    keyed = [
        line for line in lines if re.search("the disk: ws://127.0.0.1:[0-9]+/[-_\\w]{12}", line)
    ]
    assert len(keyed) == 1
    assert any(line.startswith("Waiting for messages") for line in lines)


@pytest.mark.parametrize("with_a_face", [True, False])
def test_what_arkit_takes_is_made_before_the_first_message(with_a_face, capsys):
    avatar = avatar_of(arrays=None if with_a_face else small_head_arrays())
    options = SourceOptions(source="websocket", listen="127.0.0.1:0")
    source = drive._performer(SimpleNamespace(avatar=avatar), options, True, None)
    source.close()
    assert ("arkit" in vars(avatar)) == with_a_face
    told = capsys.readouterr().err
    assert ('Only "theta" moves this avatar' in told) != with_a_face
    camera, theta = front_camera(avatar, _SIZE, _SIZE), torch.zeros(1, avatar.layout.size)
    views = camera.world_to_camera
    own = TrainingStatistics.of(theta, torch.zeros(1, 1), avatar.layout, views)
    transfer = LiveTransfer(avatar, own, source.head, camera)
    assert transfer(PerformanceFrame(0, 0.0, 0.0, theta=theta[0])).isfinite().all()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--show", "none"], "Nothing would be shown"),
        (["--source", "nothing.mp4", "--out", "f.mp4"], "There is no source nothing.mp4"),
        (["--source", "77", "--out", "f.mp4"], "Camera 77 cannot be opened"),
        (["--source", "arkit", "--listen", "0.0.0.0:0", "--out", "f.mp4"], "Other machines"),
        (["--source", "arkit", "--listen", "here", "--out", "f.mp4"], "'here' is no address"),
        (["--source", "websocket", "--listen", "0.0.0.0:0", "--out", "f.mp4"], "Other machines"),
        (["--source", "camera", "--listen", "127.0.0.1:1", "--out", "f.mp4"], "listens to nobody"),
        (["--beside"], "--beside changes nothing without --out"),
        (["--frames-per-second", 30], "--frames-per-second changes nothing without --out"),
        (["--out", "-", "--frames-per-second", 30], "changes nothing of raw pictures"),
        (["--serve", "127.0.0.1:0", "--out", "f.mp4"], "--serve changes nothing of --show none"),
        (["--serve", "127.0.0.1:0", "--show", "viewer"], "--serve changes nothing of --show view"),
        (["--background", 0, 0, 0, "--show", "viewer"], "--background changes nothing of --show"),
        (["--allow-remote", "--out", "f.mp4"], "--allow-remote changes nothing"),
        (["--head-angles", -1, 1, 1], "--head-angles changes nothing of the source camera"),
        (
            ["--source", "rtsp://me:secret@there/", "--source-frames-per-second", 50],
            "--source-frames-per-second changes nothing of the source rtsp://there/",
        ),
        (
            ["--source", "rtsp://there/", "--source-frames-per-second", 50],
            "it is for CSV files and datasets",
        ),
        (["--source", "no.mp4", "--source-frames-per-second", 50], "There is no source no.mp4"),
        (
            ["--source", "arkit", "--beside", "--out", "f.mp4"],
            "--beside changes nothing of the source arkit",
        ),
    ],
)
def test_mistakes_are_told(avatar, refused, words, told):
    assert told in refused("drive", avatar, *words)


def test_what_a_dataset_knows_nothing_of_is_told(avatar, performer, refused):
    told = refused("drive", avatar, "--source", performer, "--head-angles", 1, -1, 1)
    assert "--head-angles changes nothing of the source" in told


def test_a_film_without_mediapipe_is_told_with_the_line_that_installs_it(
    avatar, refused, tmp_path, monkeypatch
):
    film = tmp_path / "me.mp4"
    write_video(film, [np.zeros((_SIZE, _SIZE, 3), np.uint8)] * 2)
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    told = refused("drive", avatar, "--source", film, "--out", tmp_path / "f.mp4")
    assert f"Install it without its second OpenCV: {INSTALL_MEDIAPIPE}" in " ".join(told.split())


def test_a_damaged_dataset_is_told_as_one_and_is_no_folder_of_images(
    avatar, performer, refused, tmp_path
):
    damaged = tmp_path / "damaged"
    shutil.copytree(performer, damaged)
    (damaged / "dataset.json").write_text("{")
    told = refused("drive", avatar, "--source", damaged, "--out", tmp_path / "f.mp4")
    assert "dataset.json" in told
    assert not (tmp_path / "f.mp4").exists()


def test_what_cannot_be_written_is_told(avatar, performer, refused, tmp_path):
    drive = ["drive", avatar, "--source", performer]
    assert "Pictures cannot go to film.avi" in refused(*drive, "--out", "film.avi")
    assert "is no run of ns-train" in refused(*drive, "--show", "viewer")
    (tmp_path / "file").write_text("")
    assert "Cannot write" in refused(*drive, "--out", tmp_path / "file" / "film.mp4")


def test_a_bundle_that_knows_nothing_of_its_film_is_told(bundle, performer, refused):
    told = refused("drive", bundle, "--source", performer, "--out", "f.mp4")
    assert "does not name its dataset" in told


def test_options_out_of_range_are_told(avatar, refused):
    assert SourceOptions().source == "camera"
    for flag in ("--calibrate", "--calibrate-s"):
        assert "--calibrate-s is -1" in refused("drive", avatar, flag, "-1", "--out", "f.mp4")
    for seconds in ("-5", "0", "nan", "1e11"):
        told = refused("drive", avatar, "--out", "f.mp4", "--seconds", seconds)
        assert "Give a number from 0 to 1,000,000" in told
