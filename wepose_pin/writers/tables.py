"""CSV and Parquet: the pose with its joint angles, a row a sample (columns: docs/export.md)."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ..angles import angle_table, diagnose_lock, joint_angles
from ..body.kinematics import build_pose_table
from ..diagnostics import Diagnostic
from ..errors import BadData
from .motion import Motion
from .result import write_table


def build_table(motion: Motion) -> tuple[pl.DataFrame, list[Diagnostic]]:
    """Build the table of the pose, and beside it that of the angles where a joint has both of its segments."""
    pose = build_pose_table(motion.pose).with_columns(**motion.pose.joints)
    try:
        angles = joint_angles(motion.pose)
    except BadData:
        return pose, []
    return pl.concat([pose, angle_table(angles).drop("time")], how="horizontal"), diagnose_lock(angles)


def write_parquet(path: Path, motion: Motion) -> list[Diagnostic]:
    """Write every number to its last bit; what is not known is NaN."""
    rows, diagnostics = build_table(motion)
    write_table(path, rows)
    return diagnostics


def write_csv(path: Path, motion: Motion) -> list[Diagnostic]:
    """Write every number to its last bit (the shortest text that reads back as it); what is not known is empty."""
    rows, diagnostics = build_table(motion)
    write_table_csv(path, rows)
    return diagnostics


def write_table_csv(path: Path, table: pl.DataFrame) -> None:
    """Write a CSV file; what is not known is empty."""
    table.fill_nan(None).write_csv(path)
