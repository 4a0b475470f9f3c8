"""One cell in a process of its own: `python -m rgbavatar_ns.experiments.runner FOLDER PARENT`.

The folder holds cell.json (what to run, and on which data). ns-train and ns-eval write beside it;
result.json comes last, so that its presence says that the cell is done. A cell that was
interrupted resumes its training.
"""

import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.storage.checkpoint_file import checkpoints_of
from rgbavatar_ns.bench.machine import machine_facts
from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.errors import UserError, told_as_user_error
from rgbavatar_ns.experiments import commands
from rgbavatar_ns.experiments.avatar_size import avatar_size
from rgbavatar_ns.experiments.cell_pictures import write_pictures
from rgbavatar_ns.experiments.cells import Cell
from rgbavatar_ns.experiments.dataset_state import dataset_state, old_dataset_state
from rgbavatar_ns.experiments.overrides import as_flags
from rgbavatar_ns.experiments.process_lock import alone_in, end_with_parent
from rgbavatar_ns.experiments.reenactment import (
    OnnxFaceRecognition,
    load_tracker,
    reenactment_scores,
)
from rgbavatar_ns.experiments.rendering_speed import frames_per_second
from rgbavatar_ns.experiments.streamed import write_streamed
from rgbavatar_ns.files import read_json, write_json, written_json
from rgbavatar_ns.plugin.online.least_losses import read_least

CELL_FILE, RESULT_FILE, LOG_FILE = "cell.json", "result.json", "log.txt"
FAILED_FILE = "failed.json"
SIDE_BY_SIDE = "side_by_side"
"""In cell.json and in what a result was made by: other cells may have run on the machine too."""
_EVALUATION = "eval.json"
_STATES, _OLD_STATES = "datasets", "dataset_states"
_RUN = "run"
_LPIPS = ("lpips_vgg", "lpips_vgg_refined")
_MADE = ("processor", "gpu", "cores", "instruction_set", "torch", "commit", "date")
"""Facts of the machine that a result is kept with."""
State = Callable[[Path], str]


def write_cell(
    folder: Path,
    cell: Cell,
    data: Path,
    driver: Path | None = None,
    *,
    side_by_side: bool = False,
    state: State = dataset_state,
) -> None:
    """Leave in `folder` what `run_cell` needs: the cell, its dataset and its driver's.

    side_by_side: whether other cells may run on the machine meanwhile; of training that goes on
    from a checkpoint it stays so, since part of its seconds was shared. state: what a dataset is
    now, which may remember it.
    """
    places = {"data": str(data), "driver_data": None if driver is None else str(driver)}
    states = {_STATES: [state(place) for place in (data, driver) if place is not None]}
    goes_on = bool(checkpoints_of(run_folder_of(folder, cell)))
    before = (read_json(folder / CELL_FILE) or {}).get(SIDE_BY_SIDE) is True
    run = {SIDE_BY_SIDE: side_by_side or (goes_on and before)}
    write_json(folder / CELL_FILE, {**cell.to_json(), **places, **states, **run})


def is_of_other_data(
    folder: Path, data: Path, driver: Path | None = None, *, state: State = dataset_state
) -> bool:
    """Whether a cell was begun on another state of its datasets; False where it is not known.

    A cell of before, when less of a dataset counted, is asked for that alone.
    """
    described = read_json(folder / CELL_FILE) or {}
    places = [place for place in (data, driver) if place is not None]
    for name, state_of in ((_STATES, state), (_OLD_STATES, old_dataset_state)):
        if name in described:
            return described[name] != [state_of(place) for place in places]
    return False


def run_folder_of(folder: Path, cell: Cell) -> Path:
    """Where in the cell's folder its ns-train run lies."""
    return folder / _RUN / "cell" / cell.preset / "run"


def read_result(folder: Path) -> dict[str, Any] | None:
    """The metrics of a finished cell; None where it is not done."""
    return read_json(folder / RESULT_FILE)


def run_cell(folder: Path) -> dict[str, Any]:
    """Train and evaluate; returns what result.json then holds."""
    described = written_json(folder / CELL_FILE)
    data, driver = Path(described.pop("data")), described.pop("driver_data")
    for name in (_STATES, _OLD_STATES):
        described.pop(name, None)
    side_by_side = described.pop(SIDE_BY_SIDE, False)
    cell = Cell.from_json(described)
    run_folder = run_folder_of(folder, cell)
    training = commands.train(cell.preset, data, run_folder, cell.seed, as_flags(cell.overrides))
    scores = commands.evaluate(run_folder, folder / _EVALUATION)
    found = {**training, **scores}
    numbers = {name: value for name, value in found.items() if isinstance(value, int | float)}
    avatar, dataset = load_avatar(run_folder), load_dataset(data)
    numbers["frames_per_second"] = frames_per_second(avatar, dataset)
    numbers |= avatar_size(avatar)
    write_pictures(avatar, dataset, folder)
    if "stream" in training:
        numbers |= write_streamed(avatar, dataset, folder, read_least(run_folder))
    facts = machine_facts()
    made = {name: facts[name] for name in _MADE} | {SIDE_BY_SIDE: side_by_side}
    result = {"key": cell.key, "metrics": numbers, "run": str(run_folder), "made": made}
    unavailable = {}
    if "lpips_unavailable" in scores:
        unavailable = dict.fromkeys(_LPIPS, scores["lpips_unavailable"])
    if cell.cross_identity is not None and driver is not None:
        values, missing = _reenact(avatar, dataset, Path(driver), cell.cross_identity)
        numbers |= values
        unavailable |= missing
    if unavailable:
        result["unavailable"] = unavailable
    write_json(folder / RESULT_FILE, result)
    return result


def _reenact(
    avatar: AvatarMethod, own: TrackedDataset, driver: Path, named: Mapping[str, str]
) -> tuple[dict[str, float], dict[str, str]]:
    tracker = load_tracker(named["tracker"]) if "tracker" in named else None
    file = named.get("face_recognition")
    recognition = None if file is None else OnnxFaceRecognition(Path(file))
    return reenactment_scores(avatar, own, load_dataset(driver), tracker, recognition)


def main() -> None:
    """Run the cell in the folder that is the first argument; exit code 1 tells of a failure.

    Ends when the process that started it does, and waits for another one in the same folder, so
    that a cluster may start a lost cell anew.
    """
    folder = Path(sys.argv[1])
    end_with_parent(int(sys.argv[2]))
    try:
        with alone_in(folder):
            if read_result(folder) is None:
                run_cell(folder)
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        # Where it came from, which need not be the cell's folder, and what led to it.
        traceback.print_exc()
        told = told_as_user_error(error) or f"The cell ended with {type(error).__name__}: {error}."
        print(told, file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
