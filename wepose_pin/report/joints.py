"""The joint angles in the report of a tracked recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..angles import JointAngles, joint_angles, summary
from ..errors import BadData
from ..tracking import TrackedRecording
from .measures import stated_mounts, usual
from .page import Table
from .track_figures import over_time_picture
from .words import plain, whole

FULL_TURN = 2.0 * np.pi - 1e-9


def joint_angles_section(pose: TrackedRecording) -> dict[str, Any] | None:
    """Charts and table; None where no joint has both of its segments."""
    try:
        angles = joint_angles(pose.pose)
    except BadData:  # no joint has both of its segments
        return None
    groups: dict[str, list[str]] = {}
    for joint in angles.joints:
        groups.setdefault(joint.removeprefix("left_").removeprefix("right_"), []).append(joint)
    pictures = []
    for group, members in groups.items():
        panels = {
            f"{plain(name)} [°]": {
                joint.removesuffix(f"_{group}"): np.degrees(_shown(angles[joint], k)) for joint in members
            }
            for k, name in enumerate(angles[members[0]].names)
        }
        caption = f"The {group if len(members) == 1 else group + 's'} over time."
        if any((angles[joint].near_lock | angles[joint].gap).any() for joint in members):
            caption += " Lines break where a sensor gave nothing, and near gimbal lock, where the angle says little."
        pictures.append(over_time_picture(angles.time, panels, f"angles-{group}", caption))
    rows = []
    for joint, found in summary(angles).items():
        stds = angles[joint].std
        for k, name in enumerate(angles[joint].names):
            std = np.degrees(usual(stds[:, k])) if stds is not None else np.nan
            ends = [f"{whole(np.degrees(value))}°" for value in (found.lowest[k], found.highest[k], found.range[k])]
            if not np.isfinite(found.range[k]):
                ends = ["", "", ""]  # every sample is in a gap or near the lock, as of an arm that hangs
            elif found.range[k] >= FULL_TURN and found.near_lock:
                ends = ["", "", "all round"]
            rows.append(
                [
                    f"{plain(joint)}, {plain(name)}",
                    *ends,
                    f"{np.degrees(found.peak_rate[k]):.0f} °/s" if np.isfinite(found.peak_rate[k]) else "",
                    f"± {std:.1f}°" if np.isfinite(std) else "not known",
                    f"{100 * found.near_lock:.0f} %" if k != 1 else "",
                ]
            )
    header = ["angle", "least", "most", "range", "fastest", "usual ±", "near gimbal lock"]
    return {"stated": stated_mounts(pose), "pictures": pictures, "ranges": Table(header, rows)}


def _shown(joint: JointAngles, k: int) -> np.ndarray:
    """An angle with its line broken where it says little; within ± half a turn where it passed the lock."""
    hidden = joint.gap if k == 1 else joint.gap | joint.near_lock
    values = np.where(hidden, np.nan, joint.values[:, k])
    if hidden.all() or not joint.near_lock.any() or np.nanmax(values) - np.nanmin(values) < FULL_TURN:
        return values  # who turned round did so
    values = (values + np.pi) % FULL_TURN - np.pi
    values[1:][np.abs(np.diff(values)) > np.pi] = np.nan
    return values
