"""LeRobot data set, version 3.0: robot trajectories as episodes in Parquet, with state and action.

A folder: ``data/`` has a row a frame of all episodes one after another, ``meta/`` their beginnings, tasks, statistics
and ``info.json``. The state is the joints' positions, the action those of the next frame.

Source: lerobot 0.4.4, lerobot/datasets/lerobot_dataset.py and utils.py.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, BadOption, WrongOption, how_to_install, one_of
from .joint_motion import REPETITIONS, JointMotion, cut_interval, find_whole_rate, is_followed
from .motion import SLACK_S
from .result import write_table

VERSION = "v3.0"
FILES_IN_CHUNK, FILE_MB = 1000, 100  # at most, as lerobot's own writer has them
STATE, ACTION = "observation.state", "action"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


class Episode(NamedTuple):
    """A motion that is one episode, the state (joints,) that follows it, and what the robot does in it."""

    motion: JointMotion
    after: np.ndarray
    task: str


def list_episodes(motion: JointMotion, by: str | None, instruction: str | None) -> list[Episode]:
    """Return the episodes of a motion.

    Parameters
    ----------
    by : "repetitions": each repetition of the movement is one; a phase: each of its intervals; None: all of it
    instruction : text of all episodes; None: "follow NAME", or with the name of the phase after it

    Raises
    ------
    WrongOption, BadData
        The recording has no repetitions, or no such phase.
    """
    if by is None:
        return [Episode(motion, motion.position[-1], instruction or f"follow {motion.source or motion.name}")]
    if not motion.phases.get(by):
        known = [name for name, spans in motion.phases.items() if spans]
        reason = "it has no such phase"
        if by == REPETITIONS:
            reason = ": ".join(["no repetitions were found in it", *filter(None, [motion.no_repetitions])])
        choices = one_of(known, by) if known else "leave --episodes out"
        raise WrongOption("episodes", by, f"{motion.where}: {reason}; {choices}")
    following = [] if by == REPETITIONS else [by]
    text = instruction or ", ".join([f"follow {motion.source or motion.name}", *following])
    episodes = []
    intervals = [each for each in motion.phases[by] if is_followed(motion, each)] or motion.phases[by]
    for interval in intervals:
        end = motion.samples(interval).stop
        episodes.append(Episode(cut_interval(motion, interval), motion.position[min(end, len(motion.time) - 1)], text))
    return episodes


def diagnose_episodes(motion: JointMotion, by: str | None) -> list[Diagnostic]:
    """Return what `list_episodes` cuts off the intervals of a phase, or the repetitions, and which it leaves out."""
    if by is None:
        return []
    spans = motion.phases.get(by, ())
    first, last = motion.recorded_time[[motion.begin, -1]].tolist()
    outside = [each for each in spans if not is_followed(motion, each)]
    slack_s = 1.0 / motion.rate_hz + SLACK_S
    shortened = [(a, b) for a, b in spans if (a, b) not in outside and max(first - a, b - last) > slack_s]
    diagnostics = []
    for variant, affected in (("outside", outside), ("", shortened)):
        if affected:
            facts: dict[str, float | str] = {
                "variant": variant,
                "count": float(len(spans)),
                "span": "{:g} to {:g} s".format(*affected[0]),
                "recorded": f"{first:g} to {last:g} s",
            }
            diagnostics.append(Diagnostic("episodes-cut", WARNING, by, float(len(affected)), facts=facts))
    return diagnostics


def write_lerobot(folder: Path, episodes: Sequence[Episode]) -> None:
    """Write a data set into an existing folder.

    Raises
    ------
    BadData
        Episodes of several robots, of other joints or rates; a rate that is no whole number.
    """
    rate_hz = _check_alike(episodes)
    tasks = list(dict.fromkeys(episode.task for episode in episodes))
    tables, begins = [], np.cumsum([0, *(len(episode.motion.time) for episode in episodes)])
    for k, episode in enumerate(episodes):
        state = episode.motion.position
        n = len(state)
        action = np.vstack([state[1:], episode.after])
        tables.append(
            pl.DataFrame(
                {
                    STATE: _fixed_size_lists(state),
                    ACTION: _fixed_size_lists(action),
                    "timestamp": (np.arange(n) / rate_hz).astype(np.float32),
                    "frame_index": np.arange(n),
                    "episode_index": np.full(n, k),
                    "index": begins[k] + np.arange(n),
                    "task_index": np.full(n, tasks.index(episode.task)),
                }
            )
        )
    files = _split_files(tables)
    for number in sorted(set(files)):
        own = [table for table, file in zip(tables, files, strict=True) if file == number]
        write_table(_make_path(folder / "data", number), pl.concat(own))
    stats = [_compute_stats(table) for table in tables]
    _write_episodes(folder, episodes, begins, files, stats)
    _write_tasks(folder / "meta" / "tasks.parquet", tasks)
    _write_json(folder / "meta" / "stats.json", _compute_stats(pl.concat(tables)))
    joints = {"dtype": "float32", "shape": [len(episodes[0].motion.joints)], "names": list(episodes[0].motion.joints)}
    number_feature = {"dtype": "int64", "shape": [1], "names": None}
    info = {
        "codebase_version": VERSION,
        "robot_type": episodes[0].motion.name,
        "total_episodes": len(episodes),
        "total_frames": int(begins[-1]),
        "total_tasks": len(tasks),
        "chunks_size": FILES_IN_CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": rate_hz,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            STATE: joints,
            ACTION: joints,
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **dict.fromkeys(COUNTERS, number_feature),
        },
    }
    _write_json(folder / "meta" / "info.json", info)


def _check_alike(episodes: Sequence[Episode]) -> int:
    """Return the rate [Hz] that all episodes have."""
    first = episodes[0].motion
    for motion in [episode.motion for episode in episodes[1:]]:
        for what, own, other in (
            ("robot", first.name, motion.name),
            ("joints", ", ".join(first.joints), ", ".join(motion.joints)),
            ("rate [Hz]", f"{first.rate_hz:g}", f"{motion.rate_hz:g}"),
        ):
            if own != other:
                advice = "; --rate-hz makes one rate of all" if what.startswith("rate") else ""
                raise BadData(
                    f"{motion.where}: its {what} '{other}' differs from '{own}' of {first.where}; a data set has one"
                    f"{advice}"
                )
    return find_whole_rate(first)


def _fixed_size_lists(values: np.ndarray) -> pl.Series:
    return pl.Series(values.astype(np.float32), dtype=pl.Array(pl.Float32, values.shape[1]))


def _split_files(tables: Sequence[pl.DataFrame]) -> list[int]:
    """Return the number of the file of each episode; none is split."""
    files: list[int] = []
    size, number = 0.0, 0
    for table in tables:
        megabytes = table.estimated_size("mb")
        if files and size + megabytes > FILE_MB:
            number, size = number + 1, 0.0
        size += megabytes
        files.append(number)
    return files


def _make_path(folder: Path, number: int) -> Path:
    path = folder / f"chunk-{number // FILES_IN_CHUNK:03d}" / f"file-{number % FILES_IN_CHUNK:03d}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _compute_stats(table: pl.DataFrame) -> dict[str, dict[str, list[Any]]]:
    """Return feature → statistic → a value for each of its components."""
    stats = {}
    for feature in table.columns:
        values = table[feature].to_numpy().reshape(len(table), -1).astype(float)
        of_feature = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        of_feature |= {name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()}
        stats[feature] = {name: each.tolist() for name, each in of_feature.items()} | {"count": [len(values)]}
    return stats


def _write_episodes(
    folder: Path,
    episodes: Sequence[Episode],
    begins: np.ndarray,
    files: Sequence[int],
    stats: Sequence[dict[str, dict[str, list[Any]]]],
) -> None:
    count = len(episodes)
    columns: dict[str, Any] = {
        "episode_index": np.arange(count),
        "tasks": [[episode.task] for episode in episodes],
        "length": np.diff(begins),
        "data/chunk_index": [file // FILES_IN_CHUNK for file in files],
        "data/file_index": [file % FILES_IN_CHUNK for file in files],
        "dataset_from_index": begins[:-1],
        "dataset_to_index": begins[1:],
        "meta/episodes/chunk_index": np.zeros(count, dtype=np.int64),
        "meta/episodes/file_index": np.zeros(count, dtype=np.int64),
    }
    for feature, of_feature in stats[0].items():
        for name in of_feature:
            columns[f"stats/{feature}/{name}"] = [each[feature][name] for each in stats]
    write_table(_make_path(folder / "meta" / "episodes", 0), pl.DataFrame(columns))


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks as pandas writes a table whose index is their text; pyarrow stores what pandas says of it.

    Raises
    ------
    BadOption
        pyarrow is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise BadOption(f"--format lerobot: needs pyarrow: {how_to_install('pyarrow')}") from None
    index = "__index_level_0__"
    kinds = {"task_index": ("task_index", "int64", "int64"), index: (None, "unicode", "object")}
    columns = [
        {"name": name, "field_name": column, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
        for column, (name, kind, numpy_kind) in kinds.items()
    ]
    pandas = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pyarrow.table({"task_index": list(range(len(tasks))), index: list(tasks)})
    pyarrow.parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _write_json(path: Path, values: Any) -> None:
    path.write_text(json.dumps(values, indent=4) + "\n", encoding="utf-8")
