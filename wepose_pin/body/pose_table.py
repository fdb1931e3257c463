"""The table of a pose: `pose.parquet` and `truth.parquet`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl

from ..errors import BadData, one_of
from .covariance import compute_axis_std
from .kinematics import Pose

MAX_TABLE_NORM_DEVIATION = 1e-2  # of a quaternion in a table from 1: a file may have few decimals


def build_pose_table(pose: Pose, covariance: bool = False) -> pl.DataFrame:
    """Build the table of ``pose.parquet``.

    ``time``; ``<segment>_qx,_qy,_qz,_qw`` (`quat_WL`) and ``<segment>_std`` [rad]; ``<point>_x,_y,_z`` [m] in W and
    ``<point>_std`` [m]; with `covariance` ``<name>_cov_xx,_xy,_xz,_yy,_yz,_zz`` of each as well; ``<segment>_gap``.
    A standard deviation is that of one axis, the mean over the three (`compute_axis_std`).
    """
    table = {"time": pose.time}
    series = [(name, quat, ["qx", "qy", "qz", "qw"], pose.segment_cov) for name, quat in pose.quat_WL.items()]
    series += [(name, p, ["x", "y", "z"], pose.point_cov) for name, p in pose.points.items()]
    for name, values, components, covariances in series:
        table |= {f"{name}_{c}": values[:, k] for k, c in enumerate(components)}
        if name in covariances:
            cov = covariances[name]
            table[f"{name}_std"] = compute_axis_std(cov)
            if covariance:
                table |= {f"{name}_cov_{'xyz'[i]}{'xyz'[j]}": cov[:, i, j] for i in range(3) for j in range(i, 3)}
    table |= {f"{segment}_gap": gap for segment, gap in pose.gap.items()}
    return pl.DataFrame(table)


def parse_pose_table(table: pl.DataFrame, file: str) -> Pose:
    """Parse a `Pose` from a table as of `build_pose_table`; segments and points may be missing.

    Raises
    ------
    BadData
        No column of time, or one that does not increase; neither orientations nor points; a text; a quaternion that is
        not of unit norm.
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
    quat_WL, points = {}, {}
    for name in (name.removesuffix("_qx") for name in numbers if name.endswith("_qx")):
        columns = [f"{name}_{c}" for c in ("qx", "qy", "qz", "qw")]
        if not set(columns) <= set(numbers):
            continue
        quat = np.column_stack([numbers[column] for column in columns])
        norm = np.linalg.norm(quat, axis=1)
        if np.any(np.abs(norm - 1.0) > MAX_TABLE_NORM_DEVIATION):
            raise BadData(f"{file}: {name}_qx … _qw is no unit quaternion in row {np.argmax(abs(norm - 1)) + 1}")
        quat_WL[name] = quat / norm[:, None]
    for name in (name.removesuffix("_x") for name in numbers if name.endswith("_x")):
        if {f"{name}_y", f"{name}_z"} <= set(numbers):
            points[name] = np.column_stack([numbers[f"{name}_{c}"] for c in "xyz"])
    if not quat_WL and not points:
        raise BadData(f"{file}: neither orientations nor points; columns as <segment>_qx … or <point>_x … are needed")
    segment_cov = {name: _parse_covariances(numbers, name) for name in quat_WL}
    point_cov = {name: _parse_covariances(numbers, name) for name in points}
    gap = {name: numbers[f"{name}_gap"] > 0.0 for name in quat_WL if f"{name}_gap" in numbers}
    return Pose(
        time,
        quat_WL,
        points,
        segment_cov={name: cov for name, cov in segment_cov.items() if cov is not None},
        point_cov={name: cov for name, cov in point_cov.items() if cov is not None},
        gap=gap,
    )


def _parse_covariances(numbers: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """Parse covariances (n, 3, 3) of a table: its entries, else the standard deviation on all axes; None: neither."""
    entries = {(i, j): f"{name}_cov_{'xyz'[i]}{'xyz'[j]}" for i in range(3) for j in range(i, 3)}
    if all(column in numbers for column in entries.values()):
        cov = np.empty((len(numbers["time"]), 3, 3))
        for (i, j), column in entries.items():
            cov[:, i, j] = cov[:, j, i] = numbers[column]
        return cov
    if f"{name}_std" in numbers:
        return numbers[f"{name}_std"][:, None, None] ** 2 * np.eye(3)
    return None
