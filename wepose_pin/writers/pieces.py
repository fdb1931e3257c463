"""The result folder of a recording that was tracked in pieces (`tracking.track_pieces`)."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..errors import ExistingOutput
from ..pose import Pose, pose_table
from ..tracking import TrackedPose
from ..tracking.tracked import Tally
from .result import write_about, write_table

MOST_FRAMES = 5000  # of the pose that is kept for a page


class PieceWriter:
    """`write_result`, a piece at a time: a part of ``pose.parquet`` each, made one table at the end.

    Parameters
    ----------
    samples : of the whole recording

    Attributes
    ----------
    tally : what the summary counts
    """

    def __init__(self, folder: Path, samples: int, covariance: bool = False) -> None:
        self.tally = Tally()
        self._folder, self._covariance = folder, covariance
        self._parts = folder / "parts"
        self._parts.mkdir()
        self._seen, self._every = 0, max(1, samples // MOST_FRAMES)
        self._thin: list[Pose] = []

    def add(self, piece: TrackedPose) -> None:
        """The next piece.

        Raises
        ------
        ExistingOutput
            It cannot be written: a full disk, say.
        """
        write_table(self._parts / f"{self._seen:012d}.parquet", pose_table(piece, self._covariance))
        at = slice(-self._seen % self._every, None, self._every)
        self._thin.append(
            Pose(
                piece.time[at].copy(),  # a view would keep the whole piece
                {name: quat[at].copy() for name, quat in piece.quat_WL.items()},
                {name: p[at].copy() for name, p in piece.points.items()},
                piece.q[at].copy() if piece.q is not None else None,
            )
        )
        self._seen += len(piece.time)
        self.tally.add(piece)

    def finish(self, phases: Mapping[str, Sequence[tuple[float, float]]], made_by: Mapping[str, Any]) -> Pose:
        """The other files; gives every so many samples of the pose, for a page."""
        _put_together(self._parts, self._folder / "pose.parquet")
        shutil.rmtree(self._parts)
        last = self.tally.last
        assert last is not None
        write_about(self._folder, last, self.tally.summary(), phases, made_by)
        thin = self._thin
        assert thin[0].q is not None
        return Pose(
            np.concatenate([pose.time for pose in thin]),
            {name: np.concatenate([pose.quat_WL[name] for pose in thin]) for name in thin[0].quat_WL},
            {name: np.concatenate([pose.points[name] for pose in thin]) for name in thin[0].points},
            np.concatenate([pose.q for pose in thin if pose.q is not None]),
        )


def _put_together(parts: Path, path: Path) -> None:
    """One Parquet file of those in a folder, in the order of their names; a few row groups at a time in memory."""
    lazy = pl.scan_parquet(sorted(parts.glob("*.parquet")))
    try:
        try:
            str(path).encode("utf-8")
        except UnicodeEncodeError:  # polars takes no such path
            write_table(path, lazy.collect())
        else:
            lazy.sink_parquet(path)
    except (pl.exceptions.PolarsError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise ExistingOutput(f"{path.name}: cannot be written: {reason}; nothing was written") from error
