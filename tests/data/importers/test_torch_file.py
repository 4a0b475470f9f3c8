"""torch's files: what torch itself gives, or an error."""

import contextlib
import io
import os
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rgbavatar_ns.data.importers.torch_file import read_torch_file
from rgbavatar_ns.errors import UserError
from tests.head.test_safe_pickle import HOSTILE, same

_MB = 2**20


@pytest.fixture
def write(tmp_path: Path):
    def write(data: bytes) -> Path:
        path = tmp_path / "00001.frame"
        path.write_bytes(data)
        return path

    return write


FRAME = {
    "flame": {"exp": np.linspace(0, 1, 100, dtype=np.float32)[None], "jaw": np.eye(2, 3)[None]},
    "img_size": np.array([512, 512]),
    "frame_id": "00001",
    "tensor": torch.arange(6.0).reshape(2, 3).T,
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "expanded": torch.ones(2, dtype=torch.int64).expand(5, 2),
    "part": torch.arange(10, dtype=torch.uint8)[3:8:2],
    "empty": torch.zeros(0, 3),
    "size": torch.Size([2, 3]),
}


def saved(value: object, as_zip: bool = True) -> bytes:
    file = io.BytesIO()
    torch.save(value, file, _use_new_zipfile_serialization=as_zip)
    return file.getvalue()


@pytest.mark.parametrize("as_zip", [True, False])
def test_torch_files_give_what_torch_gives(write, as_zip):
    path = write(saved(FRAME, as_zip))
    assert zipfile.is_zipfile(path) == as_zip
    read = read_torch_file(path)
    assert list(read) == list(FRAME)
    for name, value in FRAME.items():
        wanted = value.detach().numpy() if isinstance(value, torch.Tensor) else value
        wanted = tuple(wanted) if name == "size" else wanted
        assert same(wanted, read[name]), name


def zipped(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused_in_torch_files_too(write, name):
    value, told = HOSTILE[name]
    with pytest.raises(UserError, match=told):
        read_torch_file(write(zipped({"a/data.pkl": pickle.dumps(value, 2)})))


def test_a_zip_bomb_is_refused_unopened(write):
    bomb = zipped({"a/data.pkl": b"N." + bytes(40 * _MB)}, zipfile.ZIP_DEFLATED)
    assert len(bomb) < _MB / 10
    path = write(bomb)
    tracemalloc.start()
    with pytest.raises(UserError, match="is compressed"):
        read_torch_file(path)
    assert tracemalloc.get_traced_memory()[1] < 10 * _MB
    tracemalloc.stop()


def _changed(tensor: torch.Tensor, **changes: int) -> bytes:
    """torch's own file, with numbers of the tensor's description replaced."""
    with zipfile.ZipFile(io.BytesIO(saved(tensor))) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = next(name for name in members if name.endswith("data.pkl"))
    for old, new in changes.items():
        old_code = b"K" + bytes([int(old.removeprefix("n"))])
        assert old_code in members[name]
        members[name] = members[name].replace(old_code, b"K" + bytes([new]))
    return zipped(members)


def test_tensors_cannot_reach_beyond_their_storage(write):
    tensor = torch.arange(77.0)
    assert np.array_equal(read_torch_file(write(_changed(tensor))), tensor.numpy())
    with pytest.raises(UserError, match="not as long as it claims"):
        read_torch_file(write(_changed(tensor, n77=99)))
    with pytest.raises(UserError, match="reaches beyond"):
        read_torch_file(write(_changed(tensor.reshape(7, 11), n7=8)))


def test_other_zips_and_other_bytes_are_no_torch_files(write):
    for data in (zipped({"x.txt": b"x"}), b"PK\x03\x04", b"", b"\x80\x02N.", os.urandom(50)):
        with pytest.raises(UserError):
            read_torch_file(write(data))


@settings(
    max_examples=120,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.booleans(), st.data())
def test_mutated_torch_files_end_in_a_value_or_an_error(write, as_zip, data):
    mutated = bytearray(saved({"exp": np.arange(3.0), "t": torch.ones(2, 2)}, as_zip))
    for _ in range(data.draw(st.integers(0, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.just(len(mutated)) | st.integers(0, len(mutated)))
    with contextlib.suppress(UserError):
        read_torch_file(write(bytes(mutated[:end])), max_bytes=_MB)
