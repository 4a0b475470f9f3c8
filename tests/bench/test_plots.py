import importlib.util
import json
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import pytest

from rgbavatar_ns.errors import UserError

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "speed" / "plots.py"


@pytest.fixture
def plots() -> ModuleType:
    spec = importlib.util.spec_from_file_location("plots", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    plots = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(plots)
    return plots


@pytest.fixture
def figures() -> dict[str, Any]:
    """With a peer missing."""
    points = [(1000.0, 1.0, 0.9, 1.2), (2000.0, 2.0, 1.9, 2.1)]
    names = ("ms_per_image_by_count", "ms_per_batch_by_batch", "ms_per_image_by_pixels")
    peers = {"one": {"whole_ms_per_image": 300.0}, "other": {"unavailable": "not installed"}}
    least = {"ms_per_image": 3.0}
    facts = {"processor": "a processor", "threads": 2, "instruction_set": "avx2"}
    return {name: points for name in names} | {
        "rasterizer": {
            "images_per_second": 120.0,
            "roofline": least,
            "peers": peers,
        },
        "machine": facts | {"commit": None, "date": "2020-01-01 00:00"},
    }


def test_the_plot_is_drawn_from_figures_with_a_peer_missing(plots, figures, tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "docs" / "speed.png"
    plots.draw(figures, path)
    assert cv2.imread(str(path)).shape[1] > 1000


@pytest.mark.parametrize("part", ["machine", "rasterizer", "ms_per_image_by_count", None])
def test_a_file_that_holds_no_figures_is_told(plots, figures, tmp_path, part):
    pytest.importorskip("matplotlib")
    path = tmp_path / "speed.json"
    path.write_text(json.dumps({k: v for k, v in figures.items() if k != part} if part else []))
    with pytest.raises(UserError, match=r"speed\.json holds no figures .*--json wrote"):
        plots.draw_again(path, tmp_path / "speed.png")
    assert not (tmp_path / "speed.png").exists()


def test_all_four_panels_are_measured_on_the_processor(plots, monkeypatch):
    asked = []

    def bench(options: Any, tell: Any) -> SimpleNamespace:
        asked.append(options.device)
        return SimpleNamespace(to_json=dict)

    monkeypatch.setattr(plots, "bench_rasterizer", bench)
    monkeypatch.setattr(plots, "_sweep", lambda *words: [])
    plots.measure(plots.Options())
    assert asked == ["cpu"]
