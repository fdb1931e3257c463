"""A session's angles for a paper: its repetitions, and what each angle comes to in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from ..body.kinematics import Pose, find_samples
from ..errors import WrongOption, one_of
from ..filters.butterworth import low_pass
from ..recording import Intervals
from ..recording.gaps import find_runs
from ..rotations import unwrap_signs
from .curves import MeanCurve, compute_mean_curves
from .euler import count_turns
from .joints import AUTO, JOINTS, Angles, joint_angles
from .repetitions import Repetitions, find_repetitions
from .tables import compute_summary_std, summarize_joint

MEASURES = {"lowest": "deg", "highest": "deg", "range": "deg", "peak_rate": "deg_s"}  # units in a file
# A longer time step than this many usual ones ends a run: the samples on its two sides are filtered apart.
_LONGEST_STEP = 1.5
_SHORTEST_RUN = 10  # samples; a shorter run is not filtered


@dataclass(frozen=True)
class MovementOptions:
    """How the angles of a session are made and its repetitions found.

    Parameters
    ----------
    sequence : of the shoulder, one of `SHOULDER_SEQUENCES`, or `AUTO`
    cutoff_hz : of the low-pass (`smooth_pose`); None: none
    phase : takes each of its intervals as a repetition; None: repetitions are found
    main_angle, rising, cycles : of `find_repetitions`
    """

    sequence: str = AUTO
    cutoff_hz: float | None = None
    phase: str | None = None
    main_angle: str | None = None
    rising: bool | None = None
    cycles: bool = False


@dataclass(frozen=True)
class Movement:
    """The angles of a session, or of the selected time of it.

    Parameters
    ----------
    name : of the session
    pose : low-passed as the angles are
    angles : of the pose
    phases : of the recording, as far as they lie in the time of the pose
    repetitions : found, or marked by a phase
    measures : of the repetitions, as `measure_spans` has them
    curves : joint → its three mean curves; empty without repetitions
    cutoff_hz : of the low-pass; None: there is none
    """

    name: str
    pose: Pose
    angles: Angles
    phases: Mapping[str, Intervals]
    repetitions: Repetitions
    measures: pl.DataFrame
    curves: Mapping[str, tuple[MeanCurve, MeanCurve, MeanCurve]]
    cutoff_hz: float | None

    @property
    def sequence(self) -> str:
        """That of the shoulder's angles; empty: there is none."""
        return next((each.sequence for name, each in self.angles.joints.items() if not JOINTS[name].sequence), "")


def analyze_movement(name: str, pose: Pose, phases: Mapping[str, Intervals], options: MovementOptions) -> Movement:
    """Compute the angles of a session, find its repetitions and measure them.

    Parameters
    ----------
    phases : of the recording, [s]

    Raises
    ------
    WeposeError
        No joint has both of its segments; there is no such angle or phase; a cut-off that is not possible.
    """
    if options.cutoff_hz is not None:
        pose = smooth_pose(pose, options.cutoff_hz)
    angles = joint_angles(pose, options.sequence)
    # Intervals that lie in the time of the pose, or exceed it by less than a sample.
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 0.0
    begin, end = pose.time[0] - step, pose.time[-1] + step
    lying = {phase: tuple((a, b) for a, b in spans if a > begin and b < end) for phase, spans in phases.items()}
    inside = {phase: spans for phase, spans in lying.items() if spans}
    marked = options.phase
    if marked is None:
        repetitions = find_repetitions(angles, options.main_angle, options.rising, options.cycles)
    elif phases.get(marked):
        reason = "" if marked in inside else f"no interval of the phase {marked} lies in the selected time"
        spans = np.array(inside.get(marked, ()), dtype=float).reshape(-1, 2)
        repetitions = Repetitions(spans, marked, reason=reason)
    else:
        choices = one_of(phases, marked) if phases else "it has no phases; without --repetitions they are found"
        raise WrongOption("repetitions", marked, f"the recording has no such phase; {choices}")
    measures = measure_spans(pose, angles, repetitions.spans)
    curves = compute_mean_curves(angles, repetitions.spans) if len(repetitions.spans) else {}
    return Movement(name, pose, angles, inside, repetitions, measures, curves, options.cutoff_hz)


def smooth_pose(pose: Pose, cutoff_hz: float) -> Pose:
    """Return the pose with orientations low-passed by a Butterworth filter of second order, forwards and backwards.

    Nothing is delayed; at `cutoff_hz` the two passes together halve the amplitude (−6 dB). Filtered are the components
    of the quaternions, which are normalised afterwards. Points, covariances and gaps stay.

    Raises
    ------
    WrongOption
        The cut-off is not above 0 and below 0.45 of the sampling rate.
    """
    step = float(np.median(np.diff(pose.time))) if len(pose.time) > 1 else 1.0
    if not 0.0 < cutoff_hz < 0.45 / step:
        raise WrongOption("low-pass-hz", f"{cutoff_hz:g}", f"above 0 and below {0.45 / step:.3g} Hz is needed here")
    gaps = 1 + np.flatnonzero(np.diff(pose.time) >= _LONGEST_STEP * step)
    quat_WL = {}
    for segment, quat in pose.quat_WL.items():
        smooth = quat.copy()
        known = np.isfinite(quat).all(axis=1)
        for start, stop in zip([0, *gaps], [*gaps, len(quat)], strict=True):
            for a, b in find_runs(known[start:stop]):
                run = slice(start + a, start + b)
                if b - a >= _SHORTEST_RUN:
                    filtered = low_pass(unwrap_signs(quat[run]), cutoff_hz, 1.0 / step)
                    smooth[run] = filtered / np.linalg.norm(filtered, axis=1, keepdims=True)
        quat_WL[segment] = smooth
    return replace(pose, quat_WL=quat_WL, q=None)


def measure_spans(pose: Pose, angles: Angles, spans: Sequence[tuple[float, float]] | np.ndarray) -> pl.DataFrame:
    """A row an angle in each span [s], both ends included: `MEASURES` in degrees, each with its ±; NaN: not determined.

    Raises
    ------
    BadData
        A span has no sample.
    """
    parts = [find_samples(pose.time, (float(begin), float(end))) for begin, end in spans]
    rows = []
    for order, (name, joint) in enumerate(angles.joints.items()):
        summaries = [summarize_joint(pose.time, joint, part) for part in parts]
        values = np.array(
            [np.column_stack([each.lowest, each.highest, each.range, each.peak_rate]) for each in summaries]
        ).reshape(-1, 3, len(MEASURES))
        values[:, :, :2] -= count_turns(values[:, :, :2].mean(axis=2))[:, :, None]
        samples = np.array([each.samples for each in summaries], dtype=int).reshape(values.shape)
        stds = compute_summary_std(pose, name, joint, samples)
        for span, (each, value, std) in enumerate(zip(summaries, np.degrees(values), np.degrees(stds), strict=True)):
            for k, angle in enumerate(joint.names):
                row = {"span": span, "order": order, "joint": name, "angle": angle, "sequence": joint.sequence}
                for m, (measure, unit) in enumerate(MEASURES.items()):
                    row |= {f"{measure}_{unit}": value[k, m], f"{measure}_std_{unit}": std[k, m]}
                rows.append({**row, "near_lock": each.near_lock, "gap": each.gap})
    return pl.DataFrame(rows).sort("span", "order", maintain_order=True).drop("order") if rows else pl.DataFrame()
