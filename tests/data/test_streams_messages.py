"""Messages: what goes in comes out, and whatever else comes is refused and no more."""

import contextlib
import dataclasses
import json
import struct
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.data.streams import StreamedFrame
from rgbavatar_ns.data.streams import message_format as messages
from rgbavatar_ns.errors import UserError
from tests.data.streaming import HEAD, same, subject, tracked

FRAME, PNG = messages.decode(messages.frame_message(tracked(0)))
SUBJECT, _ = messages.decode(messages.subject_message(subject("mine")))
OTHER_HEAD = dataclasses.replace(HEAD.arrays, name="mine", v_template=HEAD.arrays.v_template * 1.5)
OTHER, PACKED = messages.decode(
    messages.subject_message(dataclasses.replace(subject(), arrays=OTHER_HEAD))
)


def parsed(header: dict[str, Any], png: bytes = PNG) -> StreamedFrame | str:
    return messages.parse_message(messages.encode(header, png), subject("mine"), 5.0)


def with_arrays(**changed: np.ndarray | None) -> bytes:
    """The other head's arrays with some in place of its own, or without them."""
    arrays = {**safetensors.numpy.load(PACKED), **changed}
    return safetensors.numpy.save({k: v for k, v in arrays.items() if v is not None})


def test_subject_and_frames_come_through_bit_for_bit():
    who = messages.parse_subject(messages.subject_message(subject("mine")))
    assert torch.equal(who.identity, subject().identity)
    assert (who.width, who.height, who.layout, who.session) == (12, 8, HEAD.layout, "mine")
    assert who.arrays is HEAD.arrays
    for index in (0, 1):
        frame = parsed(*messages.decode(messages.frame_message(tracked(index))))
        assert isinstance(frame, StreamedFrame)
        assert same(tracked(index), frame)
        assert (frame.session, frame.arrived_s) == ("mine", 5.0)
    assert parsed({"type": "end"}) == "end"


def test_a_message_is_a_size_json_and_a_png():
    message = messages.frame_message(tracked(0))
    (size,) = struct.unpack_from("<I", message)
    header = json.loads(message[4 : 4 + size])
    assert set(header) == {"type", "index", "theta", "camera"}
    assert header["theta"] == tracked(0).theta.tolist()
    assert message[4 + size :].startswith(b"\x89PNG")


def test_another_head_travels_with_its_subject():
    got = messages.parse_subject(messages.encode(OTHER, PACKED)).arrays
    assert got.name == "mine"
    assert np.array_equal(got.v_template, OTHER_HEAD.v_template)
    assert np.array_equal(got.shapedirs, OTHER_HEAD.shapedirs)
    assert got.expression_names == OTHER_HEAD.expression_names
    assert got.num_identity == OTHER_HEAD.num_identity


def test_answers_are_read_or_refused():
    assert messages.parse_answer("accepted 7") == 7
    with pytest.raises(UserError, match=r"refuses this client\. Another"):
        messages.parse_answer("refused Another client is connected.")
    for other in ("Hello", b"\xff", "", "accepted", "accepted -1", "accepted all"):
        with pytest.raises(UserError, match="Something else"):
            messages.parse_answer(other)


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\x01",
        "text",
        b"GET / HTTP/1.1\r\n\r\n",
        struct.pack("<I", 2**32 - 1) + b"{}",
        struct.pack("<I", messages.LARGEST_HEADER + 1) + b" " * (messages.LARGEST_HEADER + 1),
        struct.pack("<I", 3) + b"{}",
        messages.encode({})[:-1] + b"?",
        struct.pack("<I", 2) + b"[]",
        struct.pack("<I", 2) + b"\xff\xff",
        struct.pack("<I", 200_000) + b"[" * 200_000,
    ],
)
def test_what_is_no_message_is_refused(message: bytes | str):
    with pytest.raises(UserError, match="no message"):
        messages.decode(message)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"type": "picture"}, "type"),
        ({"type": None}, "type"),
        *(({"index": bad}, "whole number") for bad in (-1, True, "3", 1 << 62, 1.5)),
        ({"index": float("inf")}, "whole number"),
        *(({name: 10**400}, "too many digits") for name in ("index", "theta", "camera", "more")),
        *(({"theta": bad}, "incomplete") for bad in ("me", [[1.0]], ["1"], [1e30], [True])),
        ({"theta": {"0": 1}}, "incomplete"),
        ({"camera": None}, "streamed frame 0"),
        ({"camera": []}, "streamed frame 0"),
        *(
            ({"camera": {**FRAME["camera"], name: bad}}, name)
            for name in FRAME["camera"]
            for bad in (
                "me",
                [True] * 2,
                [float("nan")] * 2,
                [1e300, 1e300],
                [[[1]]],
                {},
                ["1"] * 2,
            )
        ),
        ({"camera": {**FRAME["camera"], "focal_px": [-1.0, 1.0]}}, "positive focal"),
    ],
)
def test_an_unfit_frame_is_refused_with_the_reason(fields: dict[str, Any], told: str):
    with pytest.raises(UserError, match=told):
        parsed({**FRAME, **fields})


@pytest.mark.parametrize("missing", FRAME)
def test_an_incomplete_frame_is_refused(missing: str):
    with pytest.raises(UserError, match="incomplete"):
        parsed({name: value for name, value in FRAME.items() if name != missing})


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"type": "frame"}, "begins with its subject"),
        ({"identity": [1.0]}, "identity"),
        ({"identity": [101.0] * HEAD.num_identity}, "within 100"),
        ({"identity": [float("nan")] * HEAD.num_identity}, "finite numbers"),
        ({"identity": [1e300] * HEAD.num_identity}, "finite numbers"),
        ({"identity": [10**400] * HEAD.num_identity}, "too many digits"),
        ({"identity": "me"}, "cannot be used"),
        ({"width": 0}, "0 x 8"),
        *(({"width": bad}, "cannot be used") for bad in (-3, "12", True, float("inf"), 8193)),
        ({"layout": []}, "theta of 0"),
        ({"layout": 5}, "layout"),
        ({"layout": [{"name": "a", "size": float("inf"), "form": "linear"}]}, "layout"),
        ({"layout": [{"name": "a", "size": 10**18, "form": "linear"}]}, "theta of 1000"),
        ({"layout": [{"name": "a", "size": 3, "form": "round"}]}, "form"),
        ({"head": "flame"}, "not known here"),
        ({"head": None}, "not known here"),
        ({"session": 5}, "session"),
        ({"session": "x" * 1000}, "session"),
        ({"client": 5}, "client"),
        ({"client": "x" * 1000}, "client"),
    ],
)
def test_an_unfit_subject_is_refused_with_the_reason(fields: dict[str, Any], told: str):
    with pytest.raises(UserError, match=told):
        messages.parse_subject(messages.encode({**SUBJECT, **fields}))


@pytest.mark.parametrize(
    ("fields", "packed"),
    [
        ({}, b"no tensors"),
        ({}, b"PK\x03\x04" + bytes(50)),
        ({}, PACKED[:-1]),
        ({}, struct.pack("<Q", 2**63) + b"{}"),
        ({}, struct.pack("<Q", 81) + b'{"a":{"dtype":"F32","shape":[1e999],"data_offsets":[0,4]}}'),
        ({}, with_arrays(faces=None)),
        ({}, with_arrays(posters=np.zeros(3))),
        ({}, with_arrays(v_template=np.zeros((3, 3), np.float32))),
        ({}, with_arrays(v_template=np.array(3.0, np.float32))),
        ({}, with_arrays(v_template=HEAD.arrays.v_template * np.float32("nan"))),
        ({}, with_arrays(faces=HEAD.arrays.faces * 0 - 5)),
        ({}, with_arrays(faces=HEAD.arrays.faces[:0], uv_faces=HEAD.arrays.uv_faces[:0])),
        ({}, with_arrays(parents=np.full(5, 99))),
        ({"num_identity": 10**400}, PACKED),
        ({"num_identity": float("inf")}, PACKED),
        ({"num_identity": None}, PACKED),
        ({"expression_names": 5}, PACKED),
        ({"expression_names": ["smile"]}, PACKED),
    ],
)
def test_a_head_that_cannot_be_posed_is_refused(fields: dict[str, Any], packed: bytes):
    with pytest.raises(UserError):
        messages.parse_subject(messages.encode({**OTHER, **fields}, packed))


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(sorted({*SUBJECT, *FRAME})), ANY_JSON, st.binary(max_size=60))
def test_whatever_a_field_holds_nothing_but_a_refusal_comes_of_it(
    name: str, value: Any, payload: bytes
):
    with contextlib.suppress(UserError):
        parsed({**FRAME, name: value}, payload)
    with contextlib.suppress(UserError):
        messages.parse_subject(messages.encode({**SUBJECT, name: value}, payload))
