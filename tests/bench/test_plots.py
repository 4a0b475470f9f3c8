import importlib.util
from pathlib import Path

import cv2
import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "speed" / "plots.py"


def test_the_plot_is_drawn_from_figures_with_a_peer_missing(tmp_path):
    pytest.importorskip("matplotlib")
    spec = importlib.util.spec_from_file_location("plots", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    plots = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(plots)
    points = [(1000.0, 1.0, 0.9, 1.2), (2000.0, 2.0, 1.9, 2.1)]
    names = ("ms_per_image_by_count", "ms_per_batch_by_batch", "ms_per_image_by_pixels")
    peers = {"one": {"whole_ms_per_image": 300.0}, "other": {"unavailable": "not installed"}}
    least = {"ms_per_image": 3.0}
    facts = {"processor": "a processor", "threads": 2, "instruction_set": "avx2"}
    figures = {name: points for name in names} | {
        "rasterizer": {
            "images_per_second": 120.0,
            "roofline": least,
            "peers": peers,
        },
        "machine": facts | {"commit": None, "date": "2020-01-01 00:00"},
    }
    path = tmp_path / "docs" / "speed.png"
    plots.draw(figures, path)
    assert cv2.imread(str(path)).shape[1] > 1000
