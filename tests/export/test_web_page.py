"""What is inside the exported page, without a browser."""

import base64
import gzip
import html
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import PageOptions, calm_theta, front_camera, write_web_page
from rgbavatar_ns.export.web_arrays import head_arrays, pack, quantize
from rgbavatar_ns.head import HeadArrays

from .subject import avatar_of

_NAMES = HeadArrays.embedded().expression_names


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([np.int8, np.int16]), st.floats(1e-6, 1e3))
def test_a_rounded_value_is_off_by_half_a_unit_at_most(seed, dtype, size):
    values = size * np.random.default_rng(seed).standard_normal((3, 2, 40))
    values[1, 0] = 0
    rounded = quantize(values, dtype)
    back = rounded.values * rounded.unit[..., None].astype(np.float64)
    assert (np.abs(back - values) <= 0.501 * rounded.unit[..., None]).all()
    assert rounded.values.dtype == dtype
    np.testing.assert_allclose(
        rounded.unit * np.iinfo(dtype).max, np.abs(values).max(-1), rtol=1e-6
    )


def test_arrays_come_back_from_the_block():
    arrays = {
        "bytes": np.arange(-3, 4, dtype=np.int8),
        "none": np.zeros((0, 3), np.float32),
        "table": np.random.default_rng(0).random((5, 3), dtype=np.float32).T,
        "count": np.array([7, 8], np.uint32),
    }
    directory, block = pack(arrays)
    for name, values in arrays.items():
        entry = directory[name]
        assert entry["offset"] % values.itemsize == 0, "typed arrays want aligned places"
        read = np.frombuffer(block, entry["dtype"], entry["length"], entry["offset"])
        assert np.array_equal(read.reshape(values.shape), values)


def test_sparse_columns_hold_every_offset_of_the_head():
    avatar = avatar_of()
    arrays = head_arrays(avatar)
    head = avatar.head.arrays
    full = head.shapedirs[..., head.num_identity :]
    start, vertex = arrays["offset_start"], arrays["offset_vertex"]
    assert len(start) == full.shape[-1] + 1
    for column in (0, 24, full.shape[-1] - 1):
        rebuilt = np.zeros_like(full[..., 0])
        places = slice(start[column], start[column + 1])
        rebuilt[vertex[places]] = arrays["offset_value"][places] * arrays["offset_unit"][column]
        # A micrometre is far below what is seen.
        assert np.abs(rebuilt - full[..., column]).max() < 1e-6
    with torch.no_grad():
        rest = avatar.head(torch.zeros(1, avatar.layout.size), avatar.identity)[0]
    np.testing.assert_allclose(arrays["neutral_vertices"], rest.numpy(), atol=1e-6)


def test_the_page_is_one_file_that_names_no_other_place(tmp_path):
    avatar = avatar_of()
    path = tmp_path / "page.html"
    theta = torch.zeros(3, avatar.layout.size)
    title = "</title><script>alert(1)</script>"
    size = write_web_page(avatar, path, front_camera(avatar, 64, 48), theta, PageOptions(title))
    page = path.read_text()
    assert path.stat().st_size == size
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
    assert title not in page
    assert "{{" not in page
    payload = re.search(r'id="payload">([^<]*)</script>', page)
    manifest = re.search(r'id="manifest">(.*?)</script>', page, re.DOTALL)
    assert payload
    assert manifest
    rest = page.replace(payload[1], "")
    assert not re.search(r"https?://|//cdn|src=|import\s*\(|<link", rest)
    # RGBAvatar.load takes an address, which a page of its own never gives it.
    assert re.findall(r"fetch\s*\(\w*", rest) == ["fetch(source"]
    assert "default-src 'none'" in rest
    loopback = [
        f"{kind}://{host}:*" for kind in ("ws", "wss") for host in ("127.0.0.1", "localhost")
    ]
    assert f'connect-src {" ".join(loopback)}"' in rest
    described = json.loads(manifest[1])
    block = gzip.decompress(base64.b64decode(payload[1]))
    entry = described["arrays"]["theta"]
    assert entry["length"] == theta.numel()
    assert max(e["offset"] for e in described["arrays"].values()) <= len(block)


def test_no_name_or_title_can_break_the_page(tmp_path):
    hostile = "<!--<script>{{style}}</script> & \"'"
    arrays = replace(HeadArrays.embedded(), expression_names=(hostile, *_NAMES[1:]))
    avatar = avatar_of(arrays=arrays)
    theta = torch.zeros(1, avatar.layout.size)
    options = PageOptions(title=hostile)
    write_web_page(avatar, tmp_path / "a.html", front_camera(avatar, 8, 8), theta, options)
    page = (tmp_path / "a.html").read_text()
    body = page.split("<body>")[1]
    assert "<!--" not in body
    described = re.search(r'id="manifest">(.*?)</script>', body, re.DOTALL)
    assert described is not None
    assert json.loads(described[1])["expression_names"][0] == hostile
    assert f"<title>{html.escape(hostile)}</title>" in page
    assert page.count("</style>") == 1


def test_the_calm_face_is_the_films_expression_in_another_frames_pose():
    layout = avatar_of().layout
    theta = torch.zeros(2, layout.size)
    expression, turn = layout.slice("expression").start, layout.slice("rotation").start
    theta[:, expression] = torch.tensor([0.2, 0.9])
    theta[:, turn] = torch.tensor([0.4, 0.1])
    seen = TrainingStatistics.of(theta, torch.zeros(2, 1), layout)
    calm = calm_theta(seen, theta[1])
    assert (calm[expression], calm[turn]) == (theta[0, expression], theta[1, turn])
    assert torch.equal(calm_theta(None, theta[1]), theta[1])


@pytest.mark.parametrize(
    "text",
    [
        "null",
        "*",
        "https://",
        "https://Example.org",
        "https://a.b/",
        "https://a.b:443",
        "ftp://a.b",
        "https://a.b c",
        "https://a.b;script-src",
        "https://*.a.b",
        "http://a:b",
        "ws://a.b",
        "",
    ],
)
def test_what_is_no_origin_is_refused_before_anything_is_written(text):
    with pytest.raises(UserError, match="is no origin"):
        PageOptions(origins=(text,))
    with pytest.raises(UserError, match="is no server"):
        PageOptions(servers=(text.replace("ws:", "http:"),))


def test_a_page_that_cannot_be_written_is_told(tmp_path):
    avatar = avatar_of()
    (tmp_path / "file").write_text("")
    theta = torch.zeros(0, avatar.layout.size)
    with pytest.raises(UserError, match="Cannot write"):
        write_web_page(avatar, tmp_path / "file" / "page.html", front_camera(avatar, 8, 8), theta)
