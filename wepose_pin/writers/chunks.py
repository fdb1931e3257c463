"""The result folder of a recording that was tracked in chunks (`tracking.track_session`)."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from ..errors import ExistingOutput
from ..kinematics import build_pose_table
from ..recording import Intervals
from ..tracking import SummaryAccumulator, TrackedRecording, TrackSummary
from .result import JOINTS, build_joint_table, write_about, write_table

ROW_GROUP = 50_000  # rows that are put together at a time


class ChunkWriter:
    """`write_result`, a chunk at a time: a part of each table, made one at the end.

    Parameters
    ----------
    samples : of the whole recording
    """

    def __init__(self, folder: Path, samples: int, covariance: bool = False) -> None:
        self._accumulator = SummaryAccumulator(samples)
        self._folder, self._covariance = folder, covariance
        self._parts = {name: folder / f"{name}.parts" for name in ("pose.parquet", JOINTS)}
        for parts in self._parts.values():
            parts.mkdir()
        self._seen = 0

    def add(self, chunk: TrackedRecording) -> None:
        """The next chunk.

        Raises
        ------
        ExistingOutput
            It cannot be written: a full disk, say.
        """
        name = f"{self._seen:012d}.parquet"
        write_table(self._parts["pose.parquet"] / name, build_pose_table(chunk.pose, self._covariance))
        if chunk.joints:
            write_table(self._parts[JOINTS] / name, build_joint_table(chunk.pose))
        self._seen += len(chunk.time)
        self._accumulator.add(chunk)

    def finish(self, phases: Mapping[str, Intervals], provenance: Mapping[str, Any]) -> TrackSummary:
        """Write the other files; return the summary."""
        for name, parts in self._parts.items():
            if any(parts.iterdir()):
                _concatenate(parts, self._folder / name)
            shutil.rmtree(parts)
        summary = self._accumulator.finish()
        write_about(self._folder, self._accumulator.last, summary.content, phases, provenance)
        return summary


def _concatenate(parts: Path, path: Path) -> None:
    """One Parquet file of those in a folder, in the order of their names; a few row groups at a time in memory."""
    lazy = pl.scan_parquet(sorted(parts.glob("*.parquet")))
    try:
        try:
            str(path).encode("utf-8")
        except UnicodeEncodeError:  # polars takes no such path
            write_table(path, lazy.collect())
        else:
            lazy.sink_parquet(path, row_group_size=ROW_GROUP)
    except (pl.exceptions.PolarsError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise ExistingOutput(f"{path.name}: cannot be written: {reason}; nothing was written") from error
