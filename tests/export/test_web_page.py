"""What is inside the exported page, without a browser."""

import html
import re
from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import PageOptions, calm_theta, front_camera, write_web_page
from rgbavatar_ns.export.web_scripts import PAGE_SCRIPTS, sources
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays

from .avatar_of_page import avatar_of_page
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
    rest = re.sub(r'class="part">[^<]*</script>', "", page)
    assert not re.search(r"https?://|//cdn|src=|import\s*\(|<link", rest)
    # RGBAvatar.load takes an address, which a page of its own never gives it.
    assert re.findall(r"fetch\s*\(\w*", rest) == ["fetch(source"]
    assert "default-src 'none'" in rest
    loopback = [
        f"{kind}://{host}:*" for kind in ("ws", "wss") for host in ("127.0.0.1", "localhost")
    ]
    assert f'connect-src {" ".join(loopback)}"' in rest
    assert "This preview runs no programs" in rest.split("<noscript>")[1].split("</noscript>")[0]
    manifest, arrays = avatar_of_page(path)
    assert page.count('class="part"') == len(manifest["parts"])
    assert arrays["theta"].shape == theta.shape


def test_each_name_of_the_programs_is_declared_once():
    # Plain scripts would take the last one, silently; the module would not start.
    declared = re.compile(r"^(?:async )?(?:function|class|const|let) (\w+)", re.MULTILINE)
    names = [name for source in sources(PAGE_SCRIPTS) for name in declared.findall(source)]
    assert len(names) > 50
    assert sorted(names) == sorted(set(names))


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


def test_a_slider_goes_to_both_sides_only_where_its_number_does(tmp_path):
    """A neck that moves to both sides does not make a smile go below rest."""
    avatar = avatar_of(arrays=HeadArrays.embedded(EMBEDDED_BUST))
    names = avatar.head.arrays.expression_names
    theta = torch.zeros(4, avatar.layout.size)
    theta[:, names.index("neckForward")] = torch.tensor([-0.4, 0.1, 0.2, 0.3])
    theta[:, names.index("mouthSmileLeft")] = torch.tensor([-0.01, 0.2, 0.4, 1.2])
    write_web_page(avatar, tmp_path / "a.html", front_camera(avatar, 8, 8), theta)
    manifest, _ = avatar_of_page(tmp_path / "a.html")
    low, high = manifest["expression_range"]
    ends = {name: (a, b) for name, a, b in zip(names, low, high)}
    assert ends["neckForward"] == (-3.0, 3.0)
    assert ends["jawOpen"] == (0.0, 1.0)
    assert ends["mouthSmileLeft"] == pytest.approx((-0.01, 1.2))
