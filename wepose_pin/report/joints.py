"""The joint angles in the report of a tracked recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..angles import Angles, JointAngles, group_sides, joint_angles, summary
from ..errors import BadData
from ..tracking import TrackedRecording
from ..tracking.measures import finite_median, has_stated_mounts
from .chart import Picture
from .page import Table
from .track_figures import draw_over_time
from .words import plain, plural, whole

FULL_TURN = 2.0 * np.pi - 1e-9


def build_joint_angles_section(tracked: TrackedRecording) -> dict[str, Any] | None:
    """Charts and table; None where no joint has both of its segments."""
    try:
        angles = joint_angles(tracked.pose)
    except BadData:  # no joint has both of its segments
        return None
    rows = []
    for joint, ranges in summary(angles).items():
        stds = angles[joint].std
        for k, name in enumerate(angles[joint].names):
            std = np.degrees(finite_median(stds[:, k])) if stds is not None else np.nan
            ends = [f"{whole(np.degrees(value))}°" for value in (ranges.lowest[k], ranges.highest[k], ranges.range[k])]
            if not np.isfinite(ranges.range[k]):
                ends = ["", "", ""]  # every sample is in a gap or near the lock, as of an arm that hangs
            elif ranges.range[k] >= FULL_TURN and ranges.near_lock:
                ends = ["", "", "all round"]
            rows.append(
                [
                    f"{plain(joint)}, {plain(name)}",
                    *ends,
                    f"{np.degrees(ranges.peak_rate[k]):.0f} °/s" if np.isfinite(ranges.peak_rate[k]) else "",
                    f"± {std:.1f}°" if np.isfinite(std) else "not known",
                    f"{100 * ranges.near_lock:.0f} %" if k != 1 else "",
                ]
            )
    header = ["angle", "lowest", "highest", "range", "peak rate", "median ±", "near gimbal lock"]
    return {"stated": has_stated_mounts(tracked), "pictures": draw_joint_angles(angles), "ranges": Table(header, rows)}


def draw_joint_angles(angles: Angles) -> list[Picture]:
    """Draw a chart for each kind of joint, as the elbows."""
    pictures = []
    for group, members in group_sides(angles.joints).items():
        panels = {
            f"{plain(name)} [°]": {side: np.degrees(_break_line(angles[joint], k)) for side, joint in members.items()}
            for k, name in enumerate(angles[next(iter(members.values()))].names)
        }
        caption = f"The {plain(group) if len(members) == 1 else plural(plain(group))} over time."
        if any((angles[joint].near_lock | angles[joint].gap).any() for joint in members.values()):
            caption += " Lines break where samples are lost, and near gimbal lock, where an angle is not determined."
        pictures.append(
            draw_over_time(angles.time, panels, f"angles-{group}", caption, dict(zip(members, members, strict=True)))
        )
    return pictures


def _break_line(joint: JointAngles, k: int) -> np.ndarray:
    """An angle with its line broken where it is not determined; within ± half a turn where it passed the lock."""
    hidden = joint.hidden(k)
    values = np.where(hidden, np.nan, joint.values[:, k])
    if hidden.all() or not joint.near_lock.any() or np.nanmax(values) - np.nanmin(values) < FULL_TURN:
        return values  # a real whole turn
    values = (values + np.pi) % FULL_TURN - np.pi
    values[1:][np.abs(np.diff(values)) > np.pi] = np.nan
    return values
