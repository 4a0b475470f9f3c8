"""What happens before the first step: sources by their flags, and waiting for a subject."""

import contextlib
import dataclasses
import shutil
import socket
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import TrackedFrame, load_dataset
from rgbavatar_ns.data.importers import ImportOptions
from rgbavatar_ns.data.streams import ReplayStream, SocketStream, StreamClient, StreamSubject
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel
from rgbavatar_ns.plugin.online.datamanager import is_recorded
from rgbavatar_ns.plugin.online.sources import SourceConfig, await_subject, open_source
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from tests.data.streaming import HEAD, Clock, GivenStream, streamed, subject, until
from tests.plugin.online_run import online_config, online_trainer


def test_flags_name_the_source(tiny_data: Path):
    replay = open_source(SourceConfig(), tiny_data)
    assert isinstance(replay, ReplayStream)
    listening = open_source(SourceConfig("socket", listen="127.0.0.1:0"), None)
    assert isinstance(listening, SocketStream)
    listening.close()
    with pytest.raises(UserError, match="Other machines"):
        open_source(SourceConfig("socket", listen="0.0.0.0:0"), None)
    with pytest.raises(UserError, match="kind socket"):
        open_source(SourceConfig("folder"), tiny_data)


def test_a_run_that_goes_on_keeps_its_recording(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    who = ReplayStream(load_dataset(tiny_data)).subject(0.0)
    config = online_config(tmp_path, recorded=tiny_data).pipeline.datamanager
    assert is_recorded(config, who)
    assert not capsys.readouterr().out
    otherwise = dataclasses.replace(who, identity=who.identity + 0.1)
    assert is_recorded(config, otherwise)
    assert "measured anew" in capsys.readouterr().out
    with pytest.raises(UserError, match="begin a new run"):
        is_recorded(config, dataclasses.replace(who, width=who.width + 1))
    config.recorded = tmp_path / "nothing"
    assert not is_recorded(config, who)


def test_a_recording_of_an_earlier_run_in_the_folder_is_not_gone_on_with(
    tiny_data: Path, tmp_path: Path
):
    first = online_trainer(online_config(tmp_path, tiny_data))
    old = first.base_dir / "stream" / "dataset.json"
    old.parent.mkdir()
    old.touch()
    online_trainer(online_config(tmp_path, tiny_data))
    assert not old.exists()


def test_a_source_that_cannot_be_opened_costs_no_recording_of_an_earlier_run(
    tiny_data: Path, tmp_path: Path
):
    config = online_config(tmp_path, source=SourceConfig("video", video=str(tmp_path / "no.mp4")))
    recorded = config.get_base_dir() / "stream"
    shutil.copytree(tiny_data, recorded)
    with pytest.raises(UserError, match=r"no\.mp4"):
        online_trainer(config)
    assert torch.equal(load_dataset(recorded).theta, load_dataset(tiny_data).theta)


def test_a_run_refused_after_its_first_frame_leaves_what_an_earlier_one_recorded(
    tiny_data: Path, tmp_path: Path
):
    """The model refuses it; the next one, which nothing refuses, begins its own recording."""
    before = load_dataset(tiny_data)
    who = ReplayStream(before).subject(0.0)
    image = np.array(before.read_image(3))
    frame = TrackedFrame(0, before.theta[3], before.cameras.select([3]), image)
    recorded = online_config(tmp_path / "out").get_base_dir() / "stream"
    shutil.copytree(tiny_data, recorded)
    files = {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()}

    def begin(**fields: Any) -> OnlineTrainer:
        with socket.create_server(("127.0.0.1", 0)) as free:
            address = f"127.0.0.1:{free.getsockname()[1]}"

        def send() -> None:
            with contextlib.suppress(UserError), StreamClient(who, address) as client:
                client.send(frame)

        threading.Thread(target=send, daemon=True).start()
        source = SourceConfig("socket", listen=address)
        return online_trainer(online_config(tmp_path / "out", source=source, **fields))

    with pytest.raises(UserError, match="hide-unseen"):
        begin(hide_unseen=True, initialize_colors=False)
    left = {path: path.read_bytes() for path in recorded.rglob("*") if path.is_file()}
    assert left == files
    trainer = begin()
    now = load_dataset(recorded)
    assert torch.equal(now.theta, before.theta[3:4])
    shown = trainer.stream.train_dataset.get_numpy_image(0)
    assert np.array_equal(shown, image)
    trainer.stream.close()


@pytest.mark.parametrize("other", ["size", "head"])
def test_a_resumed_run_with_another_camera_or_head_keeps_its_recording(
    tiny_data: Path, tmp_path: Path, other: str
):
    before = load_dataset(tiny_data)
    head = HeadModel(HeadArrays.embedded(EMBEDDED_BUST)) if other == "head" else HEAD
    width, height = before.width + (other == "size"), before.height
    identity = torch.zeros(head.num_identity)
    who = StreamSubject(head.arrays, identity, head.layout, width, height)
    camera = dataclasses.replace(before.cameras.select([0]), width=width, height=height)
    image = np.full((height, width, 4), 255, np.uint8)
    frame = TrackedFrame(0, torch.zeros(head.layout.size), camera, image)
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    config = online_config(
        tmp_path / "out",
        source=SourceConfig("socket", listen=address),
        load_dir=tmp_path / "checkpoints",
    )
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "step-000000009.ckpt").touch()
    recorded = config.get_base_dir() / "stream"
    shutil.copytree(tiny_data, recorded)

    def send() -> None:
        with contextlib.suppress(UserError), StreamClient(who, address) as client:
            client.send(frame)

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    with pytest.raises(UserError, match="run has recorded"):
        online_trainer(config)
    assert torch.equal(load_dataset(recorded).theta, before.theta)


def test_a_replay_opens_other_systems_data_as_the_dataparser_does(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    asked: list[ImportOptions | None] = []

    def opened(data: Path, options: ImportOptions | None = None):
        asked.append(options)
        return load_dataset(data)

    for module in ("online.sources", "dataparser"):
        monkeypatch.setattr(f"rgbavatar_ns.plugin.{module}.load_dataset", opened)
    config = online_config(tmp_path / "out", tiny_data)
    options = ImportOptions(head_pose="camera", allow_partial=True)
    config.pipeline.datamanager.dataparser.importing = options
    online_trainer(config).stream.close()
    # Before the config is written, and for dataparser and stream.
    assert asked == [options] * 3


def test_the_first_usable_frame_is_waited_for():
    nan = dataclasses.replace(streamed(0), theta=torch.full_like(streamed(0).theta, torch.nan))
    broken = dataclasses.replace(streamed(1), png=b"no picture")
    who, first = await_subject(GivenStream([nan, broken, streamed(2), streamed(3)]), print)
    assert who.width == subject().width
    assert first.index == 2


def test_a_stream_without_a_usable_frame_is_an_error():
    broken = dataclasses.replace(streamed(1), png=(streamed(1).png or b"")[:-20])
    large = np.zeros((16, 24, 4), np.uint8)
    with pytest.raises(UserError, match="ended before a frame"):
        await_subject(GivenStream([broken, streamed(2, image=large)]), print)


def test_every_frame_before_the_first_usable_one_is_counted_and_the_first_of_a_kind_told():
    short = dataclasses.replace(streamed(0), theta=torch.zeros(3))
    broken = [dataclasses.replace(streamed(k), png=b"no picture") for k in (1, 2)]
    large = streamed(3, image=np.zeros((16, 24, 4), np.uint8))
    told: list[str] = []
    left_out = Counter[str]()
    frames = [short, *broken, large, large]
    await_subject(GivenStream([*frames, streamed(4)]), told.append, left_out=left_out)
    kinds = {"theta of another size": 1, "unreadable": 2, "another resolution": 2}
    assert left_out == kinds
    assert [line.split(":")[0] for line in told] == [
        f"Frame {index} is left out" for index in (0, 1, 3)
    ]
    with pytest.raises(UserError) as ended:
        await_subject(GivenStream(frames), told.append)
    assert all(f"{name}: {count}" in ended.value.cause for name, count in kinds.items())


def test_frames_that_were_of_no_use_while_waiting_are_in_the_runs_counts(
    tiny_data: Path, tmp_path: Path
):
    """Of a sender whose first frames are broken, also where the run goes on from a checkpoint."""
    data = load_dataset(tiny_data)
    who = StreamSubject(data.arrays, data.identity, data.layout, data.width, data.height)
    image = np.array(data.read_image(0))
    frame = TrackedFrame(5, data.theta[0], data.cameras.select([0]), image)
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"

    def send() -> None:
        with contextlib.suppress(UserError), StreamClient(who, address) as client:
            for index in range(2):
                absurd = torch.full_like(frame.theta, 1e6)
                client.send(dataclasses.replace(frame, index=index, theta=absurd))
            client.send(frame)

    threading.Thread(target=send, daemon=True).start()
    config = online_config(tmp_path / "out", source=SourceConfig("socket", listen=address))
    trainer = online_trainer(config)
    ingest = trainer.stream.ingest
    until(lambda: ingest.counts()["arrived"] == 3)
    assert ingest.counts()["theta absurd"] == 2
    ingest.load_state_dict(ingest.state_dict() | {"counts": {"arrived": 9, "taken in": 9}})
    assert ingest.counts()["arrived"] == 12
    assert ingest.counts()["theta absurd"] == 2
    trainer.stream.close()


def test_what_is_waited_for_is_told_once_with_what_went_wrong():
    clock = Clock()

    class Slow(GivenStream):
        def subject(self, timeout_s: float) -> StreamSubject | None:
            clock.sleep(timeout_s)
            return subject() if clock.now_s > 1003.0 else None

    stream = Slow([streamed(0)])
    stream.counts["failed openings"] = 2
    told: list[str] = []
    await_subject(stream, told.append, clock)
    assert len(told) == 1
    assert "Waiting for frames" in told[0]
    assert "failed openings: 2" in told[0]


def test_ctrl_c_while_waiting_ends_with_exit_code_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(*_: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rgbavatar_ns.plugin.online.datamanager.await_subject", interrupted)
    source = SourceConfig("socket", listen="127.0.0.1:0")
    config = online_config(tmp_path / "out", tmp_path / "live", source=source)
    with pytest.raises(SystemExit) as ended:
        online_trainer(config)
    assert ended.value.code == 0
    assert "nothing to save" in capsys.readouterr().out
