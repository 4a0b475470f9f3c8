"""The site builds without a warning: `make docs`."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.nightly
@pytest.mark.skipif(sys.version_info < (3, 11), reason="the site is built by Python 3.11 or newer")
def test_the_site_builds_without_a_warning_and_is_filled(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs/site"]
    command += ["-d", str(tmp_path / "trees"), ".", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr[-4000:]
    pages = {path.stem for path in (tmp_path / "site" / "docs").glob("*.html")}
    assert pages >= {path.stem for path in (ROOT / "docs").glob("*.md")}
    reference = (tmp_path / "site" / "docs" / "python_reference.html").read_text()
    described = re.findall(r'id="(rgbavatar_ns\.[\w.]+)"', reference)
    assert "rgbavatar_ns.Avatar.render" in described
    assert len(described) > 80
    errors = (tmp_path / "site" / "docs" / "errors.html").read_text()
    assert "with --flame; without it" in errors  # signs stay as a program prints them
    assert "http-equiv" in (tmp_path / "site" / "index.html").read_text()
