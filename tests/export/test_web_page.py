"""What is inside the exported page, without a browser."""

import base64
import html
import re
from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import PageOptions, front_camera, write_web_page
from rgbavatar_ns.export.avatar_file import read_avatar_file
from rgbavatar_ns.head import HeadArrays

from .subject import avatar_of

_NAMES = HeadArrays.embedded().expression_names


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
    parts = re.findall(r'class="part">([^<]*)</script>', page)
    rest = re.sub(r'class="part">[^<]*</script>', "", page)
    assert not re.search(r"https?://|//cdn|src=|import\s*\(|fetch\s*\(|<link", rest)
    assert "default-src 'none'" in rest
    (tmp_path / "me.rgbavatar").write_bytes(b"".join(map(base64.b64decode, parts)))
    manifest, arrays = read_avatar_file(tmp_path / "me.rgbavatar")
    assert len(parts) == len(manifest["parts"])
    assert arrays["theta"].shape == theta.shape


def test_no_name_or_title_can_break_the_page(tmp_path):
    hostile = "<!--<script>{{style}}</script> & \"'"
    arrays = replace(HeadArrays.embedded(), expression_names=(hostile, *_NAMES[1:]))
    avatar = avatar_of(arrays=arrays)
    theta = torch.zeros(1, avatar.layout.size)
    options = PageOptions(title=hostile)
    write_web_page(avatar, tmp_path / "a.html", front_camera(avatar, 8, 8), theta, options)
    page = (tmp_path / "a.html").read_text()
    assert "<!--" not in page.split("<body>")[1]
    assert page.count(html.escape(hostile)) == 1
    assert hostile not in page
    assert f"<title>{html.escape(hostile)}</title>" in page
    assert page.count("</style>") == 1


def test_a_page_that_cannot_be_written_is_told(tmp_path):
    avatar = avatar_of()
    (tmp_path / "file").write_text("")
    theta = torch.zeros(0, avatar.layout.size)
    with pytest.raises(UserError, match="Cannot write"):
        write_web_page(avatar, tmp_path / "file" / "page.html", front_camera(avatar, 8, 8), theta)
