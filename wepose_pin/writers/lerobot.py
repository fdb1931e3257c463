"""LeRobot data set, version 3.0: robot trajectories as episodes in Parquet, with state and action.

A folder: ``data/`` has a row a frame of all episodes one after another, ``meta/`` their beginnings, tasks, statistics
and ``info.json``. The state is the joints' positions, the action those of the next frame.

Source: lerobot 0.4.4, lerobot/datasets/lerobot_dataset.py and utils.py.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, WrongOption, one_of
from ..libraries import import_library
from .motion import REPETITIONS, JointMotion, is_even
from .result import write_table

STATE, ACTION = "observation.state", "action"
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
FILE = Path("chunk-000", "file-000.parquet")

# A motion that is one episode, the state (joints,) that follows it, and what the robot does in it.
Episode = tuple[JointMotion, np.ndarray, str]


def write_lerobot(
    folder: Path, motions: Sequence[JointMotion], episodes: str | None = None, instruction: str | None = None
) -> list[Diagnostic]:
    """Write a data set into an existing folder.

    `episodes`: "repetitions" of the movement, or the intervals of a phase; None: the motions. `instruction`: the task
    of all; None: "follow NAME", and the name of the phase.
    """
    rate_hz = _check_alike(motions)
    listed, diagnostics = list[Episode](), list[Diagnostic]()
    for motion in motions:
        listed += _list_episodes(motion, episodes, instruction, diagnostics)
    tasks = list(dict.fromkeys(task for _, _, task in listed))
    tables, begins = [], np.cumsum([0, *(len(part.time) for part, _, _ in listed)])
    for k, (part, after, task) in enumerate(listed):
        frames = np.arange(len(part.time))
        columns = {
            STATE: _to_lists(part.position),
            ACTION: _to_lists(np.vstack([part.position[1:], after])),
            "timestamp": (frames / rate_hz).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(len(frames), k),
            "index": begins[k] + frames,
            "task_index": np.full(len(frames), tasks.index(task)),
        }
        tables.append(pl.DataFrame(columns))
    for name in ("data", "meta/episodes"):
        (folder / name / FILE).parent.mkdir(parents=True)
    write_table(folder / "data" / FILE, pl.concat(tables))
    about: dict[str, Any] = {
        "episode_index": np.arange(len(listed)),
        "tasks": [[task] for _, _, task in listed],
        "length": np.diff(begins),
        "dataset_from_index": begins[:-1],
        "dataset_to_index": begins[1:],
    }
    for name in ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index"):
        about[name] = np.zeros(len(listed), dtype=np.int64)
    stats = [_compute_stats(table) for table in tables]
    for feature, of_feature in stats[0].items():
        about |= {f"stats/{feature}/{name}": [each[feature][name] for each in stats] for name in of_feature}
    write_table(folder / "meta" / "episodes" / FILE, pl.DataFrame(about))
    _write_tasks(folder / "meta" / "tasks.parquet", tasks)
    info = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))  # what all data sets have
    info |= {"robot_type": motions[0].name, "total_episodes": len(listed), "total_frames": int(begins[-1])}
    info |= {"total_tasks": len(tasks), "fps": rate_hz, "splits": {"train": f"0:{len(listed)}"}}
    names = list(motions[0].joints)
    joints = {"dtype": "float32", "shape": [len(names)], "names": names}
    info["features"] |= {STATE: joints, ACTION: joints}
    for name, content in (("stats", _compute_stats(pl.concat(tables))), ("info", info)):
        (folder / "meta" / f"{name}.json").write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
    return diagnostics


def _list_episodes(
    motion: JointMotion, by: str | None, instruction: str | None, diagnostics: list[Diagnostic]
) -> list[Episode]:
    """List the episodes of a motion; intervals that it does not follow become a diagnostic."""
    text = instruction or f"follow {motion.source or motion.name}"
    if by is None:
        return [(motion, motion.position[-1], text)]
    spans = motion.phases.get(by, ())
    if by != REPETITIONS and not instruction:
        text += f", {by}"
    parts = [part for span in spans if (part := motion.samples(span)).stop - part.start >= 2]
    if not parts:
        why = "the trajectory follows none of it" if spans else "it has no such phase"
        if by == REPETITIONS and not spans:
            why = f"no repetitions were found in it: {motion.no_repetitions}"
        known = [name for name, intervals in motion.phases.items() if intervals and name != by]
        raise WrongOption("episodes", by, f"{motion.where}: {why}; {one_of(known, by)}")
    if len(parts) < len(spans):
        first, last = motion.recorded_time[[motion.begin, -1]]
        facts: dict[str, float | str] = {"count": float(len(spans)), "recorded": f"{first:g} to {last:g} s"}
        diagnostics.append(Diagnostic("episodes-cut", WARNING, by, float(len(spans) - len(parts)), facts=facts))
    last_row = len(motion.time) - 1
    return [(motion.cut(part), motion.position[min(part.stop, last_row)], text) for part in parts]


def _check_alike(motions: Sequence[JointMotion]) -> int:
    """Return the whole rate [Hz] that all motions have."""
    first, *others = motions
    descriptions = [f"robot {each.name}, {each.rate_hz:g} Hz, joints {', '.join(each.joints)}" for each in motions]
    for other, description in zip(others, descriptions[1:], strict=True):
        if description != descriptions[0]:
            reason = f"and {first.where} is of {descriptions[0]}; --rate-hz makes one rate of all"
            raise BadData(f"{other.where}: {description}; a data set has one robot and one rate, {reason}")
    rate_hz = round(first.rate_hz)
    if not is_even(first.time) or abs(rate_hz - first.rate_hz) > 1e-3:
        stated = f"{first.where}: {first.rate_hz:g} samples a second, or times that are uneven"
        raise BadData(f"{stated}; a data set has a whole number of them, which --rate-hz makes")
    return rate_hz


def _to_lists(values: np.ndarray) -> pl.Series:
    return pl.Series(values.astype(np.float32), dtype=pl.Array(pl.Float32, values.shape[1]))


def _compute_stats(table: pl.DataFrame) -> dict[str, dict[str, list[Any]]]:
    """Return feature → statistic → a value for each of its components."""
    stats = {}
    for feature in table.columns:
        values = table[feature].to_numpy().reshape(len(table), -1).astype(float)
        of_feature = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        of_feature |= {name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()}
        stats[feature] = {name: each.tolist() for name, each in of_feature.items()} | {"count": [len(values)]}
    return stats


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks as pandas writes a table whose index is their text; pyarrow stores what pandas says of it."""
    pyarrow, parquet = (
        import_library(name, "--format lerobot", "a data set") for name in ("pyarrow", "pyarrow.parquet")
    )
    index = "__index_level_0__"
    kinds = {"task_index": ("task_index", "int64", "int64"), index: (None, "unicode", "object")}
    columns = [
        {"name": name, "field_name": column, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
        for column, (name, kind, numpy_kind) in kinds.items()
    ]
    pandas = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pyarrow.table({"task_index": list(range(len(tasks))), index: list(tasks)})
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)
