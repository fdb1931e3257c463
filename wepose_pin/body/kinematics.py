"""`Pose`: the segments and points of a body over time, and its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import polars as pl

from ..arguments import check_array, check_fields, check_names, check_numbers
from ..errors import BadData, one_of
from ..recording import EACH_TIME, check_time, format_span
from .links import compute_axis_std

MAX_POSE_NORM_DEVIATION = 1e-3  # of a quaternion in a `Pose` from 1
MAX_TABLE_NORM_DEVIATION = 1e-2  # the same in a table: a file may have few decimals
LARGEST_IN_TABLE = 1e6  # of a position, also in mm, or a standard deviation; more is damage
# Columns of a quaternion, a position and a covariance in a table.
_QUAT, _XYZ = ("qx", "qy", "qz", "qw"), ("x", "y", "z")
_ENTRIES = {f"cov_{'xyz'[i]}{'xyz'[j]}": (i, j) for i in range(3) for j in range(i, 3)}


@dataclass(frozen=True)
class Pose:
    """The pose of a body over time, in W.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw, segment frame L to W; only segments that are known. Of a person it is the measured
        orientation, of a mechanism the nearest that its joints can take
    points : point → (n, 3) [m] in W, whose origin is the root: of a person midway between the hips; only points that
        are known
    q : (n, nq) configuration of the Pinocchio model, in which a segment without a sensor is rigid with the one above;
        None for a pose from a table
    segment_cov : segment → (n, 3, 3) [rad²], covariance of the error rotation vector in W (on the left of `quat_WL`);
        empty where none is known
    point_cov : point → (n, 3, 3) [m²], covariance of the position in W
    gap : segment → (n,) bool, true where its sensor lost samples for longer than 50 ms; only segments with such gaps
    joints : joint of one axis → (n,) [rad or m], of a mechanism alone
    """

    time: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    points: Mapping[str, np.ndarray]
    q: np.ndarray | None = None
    segment_cov: Mapping[str, np.ndarray] = field(default_factory=dict)
    point_cov: Mapping[str, np.ndarray] = field(default_factory=dict)
    gap: Mapping[str, np.ndarray] = field(default_factory=dict)
    joints: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Pose({len(self.time)} samples; {len(self.quat_WL)} segments, {len(self.points)} points)"

    def cut(self, span: slice | np.ndarray) -> Pose:
        """Return the pose of a span of samples, or of samples by their numbers."""
        series = ("quat_WL", "points", "segment_cov", "point_cov", "gap", "joints")
        parts = {name: {key: rows[span] for key, rows in getattr(self, name).items()} for name in series}
        return replace(self, time=self.time[span], q=None if self.q is None else self.q[span], **parts)

    def check(self) -> Pose:
        """Check all fields and return the pose; NaN stands for missing values. Raise `BadOption` or `BadData`."""
        where, n = "pose: ", np.size(self.time)
        check_fields(self, where)
        check_array(f"{where}time", self.time, (n,))
        if not n:
            raise BadData(f"{where}time has no samples")
        check_time("pose", self.time)
        for name, known, shape, unit in (
            ("quat_WL", self.quat_WL, (n, 4), MAX_POSE_NORM_DEVIATION),
            ("points", self.points, (n, 3), np.inf),
            ("segment_cov", self.quat_WL, (n, 3, 3), np.inf),
            ("point_cov", self.points, (n, 3, 3), np.inf),
            ("gap", self.quat_WL, (n,), np.inf),
            ("joints", self.joints, (n,), np.inf),
        ):
            check_names(f"{where}{name}", getattr(self, name), tuple(known))
            for key, values in getattr(self, name).items():
                if name == "gap":
                    check_array(f"{where}{name}.{key}", values, shape, "b", EACH_TIME)
                else:
                    check_numbers(f"{where}{name}.{key}", values, shape, EACH_TIME, missing=True, unit=unit)
        return self


def join_poses(parts: Sequence[Pose]) -> Pose:
    """Join the samples of consecutive poses of one body."""
    if len(parts) == 1:
        return parts[0]

    def join(values: Sequence[Any]) -> Any:
        if isinstance(values[0], Mapping):
            return {name: np.concatenate([arrays[name] for arrays in values]) for name in values[0]}
        return None if values[0] is None else np.concatenate(values)

    return Pose(*(join([getattr(part, entry.name) for part in parts]) for entry in fields(Pose)))


def find_usual_rate(time: np.ndarray) -> float:
    """Return one over the usual step of times (n,) [s], to six digits; NaN of one sample."""
    return float(f"{1.0 / np.median(np.diff(time)):.6g}") if len(time) > 1 else float("nan")


def find_samples(time: np.ndarray, interval: tuple[float, float]) -> slice:
    """Return the samples of times (n,) [s] within an interval [s], both ends included; `BadData`: there is none."""
    first, last = (int(k) for k in np.searchsorted(time, [interval[0] - 1e-9, interval[1] + 1e-9]))
    if first == last:
        raise BadData(f"the interval {format_span(interval)} has no sample")
    return slice(first, last)


def build_pose_table(pose: Pose, covariance: bool = False) -> pl.DataFrame:
    """Build the table of ``pose.parquet``.

    ``time``; ``<segment>_qx,_qy,_qz,_qw`` (`quat_WL`) and ``<segment>_std`` [rad]; ``<point>_x,_y,_z`` [m] in W and
    ``<point>_std`` [m]; with `covariance` ``<name>_cov_xx,_xy,_xz,_yy,_yz,_zz`` of each as well; ``<segment>_gap``.
    A standard deviation is that of one axis, the mean over the three (`compute_axis_std`).
    """
    table = {"time": pose.time}
    for series, components, covariances in (
        (pose.quat_WL, _QUAT, pose.segment_cov),
        (pose.points, _XYZ, pose.point_cov),
    ):
        for name, values in series.items():
            table |= {f"{name}_{component}": values[:, k] for k, component in enumerate(components)}
            if name in covariances:
                table[f"{name}_std"] = compute_axis_std(covariances[name])
                if covariance:
                    table |= {f"{name}_{entry}": covariances[name][:, i, j] for entry, (i, j) in _ENTRIES.items()}
    return pl.DataFrame(table | {f"{segment}_gap": gap for segment, gap in pose.gap.items()})


def parse_pose_table(table: pl.DataFrame, file: str) -> Pose:
    """Parse a `Pose` from a table as of `build_pose_table`; segments and points may be missing.

    Raise `BadData` where time is missing or does not increase, with neither orientations nor points, on a text, on a
    number that is none of a pose, or on a quaternion that is not of unit norm.
    """
    if "time" not in table.columns:
        raise BadData(f"{file}: no column 'time'; a table as in pose.parquet is needed; {one_of(table.columns)}")
    try:
        numbers = {name: table[name].cast(pl.Float64).to_numpy() for name in table.columns}
    except pl.exceptions.PolarsError as error:
        raise BadData(f"{file}: a column holds text: {str(error).splitlines()[0]}") from error
    time = numbers["time"]
    if not (len(time) and np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise BadData(f"{file}: time does not increase from row to row; seconds that do are needed, in one row or more")

    def collect(*components: str) -> dict[str, np.ndarray]:
        """Collect name → its columns (n, k), where all of them are there."""
        names = [name.removesuffix(f"_{components[0]}") for name in numbers if name.endswith(f"_{components[0]}")]
        columns = {name: [f"{name}_{component}" for component in components] for name in names}
        complete = {name: own for name, own in columns.items() if set(own) <= set(numbers)}
        for column in (column for own in complete.values() for column in own):
            if (wrong := np.abs(numbers[column]) > LARGEST_IN_TABLE).any():
                number, row = numbers[column][wrong][0], int(np.argmax(wrong)) + 1
                raise BadData(f"{file}: column '{column}' holds {number:.3g} in row {row}; the file is damaged")
        return {name: np.column_stack([numbers[column] for column in own]) for name, own in complete.items()}

    quat_WL, points = collect(*_QUAT), collect(*_XYZ)
    for name, quat in quat_WL.items():
        norm = np.linalg.norm(quat, axis=1)
        if np.any(np.abs(norm - 1.0) > MAX_TABLE_NORM_DEVIATION):
            raise BadData(f"{file}: {name}_qx … _qw is no unit quaternion in row {np.argmax(abs(norm - 1)) + 1}")
        quat_WL[name] = quat / norm[:, None]
    if not quat_WL and not points:
        raise BadData(f"{file}: neither orientations nor points; columns as <segment>_qx … or <point>_x … are needed")
    covariances = {name: std[:, :, None] ** 2 * np.eye(3) for name, std in collect("std").items()}
    for name, entries in collect(*_ENTRIES).items():
        cov = covariances[name] = np.empty((len(time), 3, 3))
        for column, (i, j) in zip(entries.T, _ENTRIES.values(), strict=True):
            cov[:, i, j] = cov[:, j, i] = column
    segment_cov, point_cov = (
        {name: covariances[name] for name in series if name in covariances} for series in (quat_WL, points)
    )
    gap = {name: numbers[f"{name}_gap"] > 0.0 for name in quat_WL if f"{name}_gap" in numbers}
    return Pose(time, quat_WL, points, segment_cov=segment_cov, point_cov=point_cov, gap=gap)
