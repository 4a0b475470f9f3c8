"""A Ray cluster of two nodes on this machine does what local processes do, also if one dies."""

import socket
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.engines import LocalEngine, RayEngine
from rgbavatar_ns.experiments.report import write_report
from rgbavatar_ns.experiments.runner import LOG_FILE
from rgbavatar_ns.experiments.sweep import sweep
from tests.plugin.tiny import tiny_dataset

pytestmark = pytest.mark.nightly

TEXT = """
title: On a cluster
preset: rgbavatar-tiny
subjects: [data]
metrics: [psnr, ssim]
base: {max_num_iterations: 3, pipeline.model.avatar.uv_resolution: 16}
variants:
  - name: two bases
    set: {pipeline.model.avatar.num_bases: 2}
  - name: no bases
    set: {pipeline.model.avatar.num_bases: 0}
"""
# A node that chooses its agents' ports itself gives up where they take 15 s to tell them.
_AGENTS = ("dashboard_agent_listen", "metrics_agent", "metrics_export", "runtime_env_agent")


def _node() -> dict[str, int]:
    """What a node of one CPU is started with."""
    with ExitStack() as held:
        free = [held.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in _AGENTS]
        ports = {f"{name}_port": one.getsockname()[1] for name, one in zip(_AGENTS, free)}
    return {"num_cpus": 1, "object_store_memory": 80 << 20, **ports}


@pytest.fixture
def cluster(monkeypatch):
    """A head and a second node with one CPU each."""
    ray = pytest.importorskip("ray", reason="Ray is not installed (pip install 'ray>=2.9')")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    started = Cluster(initialize_head=True, head_node_args={**_node(), "include_dashboard": False})
    yield started
    ray.shutdown()
    started.shutdown()


def _alive() -> int:
    import ray

    return sum(bool(node["Alive"]) for node in ray.nodes())


def _kill_once_busy(cluster, node, out: Path) -> threading.Thread:
    """Kill the node when both cells have begun; one a node."""

    def watch() -> None:
        end = time.monotonic() + 300
        while time.monotonic() < end and len(list(out.glob(f"cells/*/{LOG_FILE}"))) < 2:
            time.sleep(0.1)
        cluster.remove_node(node, allow_graceful=False)
        while time.monotonic() < end and _alive() == 2:
            time.sleep(0.1)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def test_a_cluster_that_loses_a_node_gives_the_table_of_local_processes(cluster, tmp_path):
    tiny_dataset(tmp_path / "data")
    (tmp_path / "cluster.yaml").write_text(TEXT)
    experiment = read_experiment(tmp_path / "cluster.yaml")
    second = cluster.add_node(**_node())
    out = tmp_path / "ray"
    engine = RayEngine(cluster.address, cpus=1.0, gpus=0.0)
    assert _alive() == 2
    killed = _kill_once_busy(cluster, second, out)
    statuses = sweep(experiment, out, engine)
    killed.join()
    assert _alive() == 1
    assert [status.state for status in statuses] == ["done"] * 2, statuses[0].why + statuses[1].why
    assert all(
        status.state == "done" for status in sweep(experiment, tmp_path / "local", LocalEngine(2))
    )
    on_cluster, locally = (
        write_report(experiment, folder, plots=False).table.to_markdown()
        for folder in (out, tmp_path / "local")
    )
    assert on_cluster == locally
    assert "2 of 2 cells done" in on_cluster
