"""What a tracked motion is good for, which its report and `wepose track` say first."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

import numpy as np

from ..angles import AUTO, Angles, joint_angles
from ..body import BodyTable
from ..body.links import compute_axis_std
from ..errors import BadData
from ..tracking import TrackResult
from ..tracking.measures import find_samples_after_start, finite_median, measure_reach
from .words import kinds, listed, plain


def compute_angles(tracked: TrackResult) -> Angles | None:
    """Compute the joint angles of a motion; None: it has none."""
    with contextlib.suppress(BadData):  # no joint has both of its segments
        return joint_angles(tracked.pose, AUTO)
    return None


def describe_reliance(tracked: TrackResult) -> str:
    """What the motion is good for: the usual ± of hinges, hands and rotations, and the least certain angle."""
    after_start, table, angles = find_samples_after_start(tracked), tracked.model.table, compute_angles(tracked)
    stds: dict[str, float] = {}  # median [deg] where an angle is determined, of the side where that is larger
    for joint, each in angles.joints.items() if angles is not None else ():
        for k, angle in enumerate(each.names):
            name = f"{plain(table.shared_name(joint))} {plain(angle)}"
            known = after_start & ~each.hidden(k)
            std = np.nan if each.std is None else float(np.degrees(finite_median(each.std[known, k])))
            if np.isfinite(std):
                stds[name] = max(std, stds.get(name, 0.0))
    hinges = [f"{plain(table.shared_name(hinge))} flexion" for hinge in table.hinges]
    best = next((name for name in stds if name in hinges), min(stds, key=stds.__getitem__, default=None))
    worst = max(stds, key=stds.__getitem__, default=None)
    good = [f"{best} to ± {stds[best]:.0f}°"] if best is not None else []
    covs, reaches = tracked.pose.point_cov, measure_reach(tracked.pose, table)
    tips = [finite_median(compute_axis_std(covs[name])[after_start]) for name in reaches if name in covs]
    if np.isfinite(tips).any():
        root = "the root" if table.is_mechanism else "the middle of the hips"
        good.append(f"{name_tips(table, table.drawn_limbs)} to ± {1e3 * np.nanmax(tips):.0f} mm from {root}")
    good += [f"{name} to ± {std:.0f}°" for name, std in stds.items() if name.endswith("rotation") and name != worst]
    if not good and tracked.pose.segment_cov:  # of a mechanism
        variances = [np.median(np.diagonal(cov[after_start], 0, 1, 2), 0) for cov in tracked.pose.segment_cov.values()]
        good = [f"the orientation of each link to ± {np.degrees(np.sqrt(np.max(variances))):.1f}°"]
    least = f" Least certain: {worst}, ± {stds[worst]:.0f}°." if worst not in (best, None) else ""
    return f"**Good for** {listed(good)}.{least}" if good else explain_no_covariance(tracked)


def explain_no_covariance(tracked: TrackResult) -> str:
    """Why nothing is said of the uncertainty."""
    source = f"The filter {tracked.options['method']}" if tracked.recording.imus else "The device"
    return (
        f"{source} states no uncertainty: how far angles and positions may be off is not known. The methods "
        "amekf, smoother, smekf and smekf_published state it."
    )


def name_tips(table: BodyTable, points: Iterable[str]) -> str:
    """What these points whose path is drawn are on, as "hands"."""
    return listed(kinds(table, [(table.drawn_limbs[name].segments or (name,))[-1] for name in points]))
