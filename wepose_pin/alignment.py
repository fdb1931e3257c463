"""Sensors to segments: orientations in sensor worlds, mounts and headings from the start pose, segment orientations.

A sensor's filter knows the vertical and not the heading: its world V differs from W by a turn about z, the heading ψ.
In the N-pose every segment frame equals W, so the mount is R_LS = R_WS = Rz(ψ) R_VS(start): the tilt of it is measured
by gravity, and ψ is what makes it nearest to the mount as stated (or as calibrated). Nobody stands exactly so: what a
calibrated mount's covariance says is weighed against the few degrees by which the pose itself is off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from . import rotations
from .diagnostics import WARNING, Diagnostic
from .errors import BadSession
from .filters import Orientation
from .filters.sensors import FilteredRecording, collect_rotations
from .filters.start import ACCEL_BIAS_STD
from .recording import SEGMENTS, Recording, format_span
from .subject import Subject

# Angles [deg] between a stated mount and gravity or motion, above which it is an error or a warning.
STATED_LIMIT_DEG = 60.0
STATED_WARNING_DEG = 35.0

# How far a person's segments are off the start pose [rad], about each axis: elbows never hang straight.
START_POSE_STD = np.deg2rad(4.0)
# How alike a person stands again: so far apart are two start poses of one person [rad], about each axis. An assumption.
REPEATED_START_STD = np.deg2rad(2.0)
# How far a sensor's orientation is off its segment's about each axis [rad], soft tissue above all, and palms that are
# held together slip [m], each axis.
ATTITUDE_STD = np.deg2rad(1.5)
SLIP_STD = 0.005
# A calibrated mount that gravity contradicts by more than this many standard deviations has moved.
MOVED_MOUNT = 3.5


@dataclass(frozen=True)
class Segments:
    """Orientation of each measured segment.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw
    quat_LS : segment → (4,) xyzw, the mount used
    heading : segment → ψ [rad], from the sensor's world to W
    orientation : segment → what the filter gave; none for measured orientations
    covariance_W : segment → (n, 3, 3) [rad²], of the error on the left of `quat_WL`, in W: the filter's, the
        accelerometer's bias, and the heading of a calibrated mount. A stated mount counts as
        exact. Only where the filter has a covariance
    start, static_phase : intervals [s] used for headings, and for noise and bias
    diagnostics : of the recording, its start pose and its mounts
    """

    time: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    quat_LS: Mapping[str, np.ndarray]
    heading: Mapping[str, float]
    orientation: Mapping[str, Orientation]
    covariance_W: Mapping[str, np.ndarray]
    start: tuple[float, float]
    static_phase: tuple[float, float]
    diagnostics: tuple[Diagnostic, ...]


@dataclass(frozen=True)
class Alignment:
    """How sensors sit on their segments and where their worlds' headings are, from one start pose.

    Parameters
    ----------
    mount : segment → R_LS, sensor to segment
    turn : segment → Rz(ψ), the sensor's world to W
    heading : segment → ψ [rad]
    start, static_phase : intervals [s] used for headings, and for noise and bias
    diagnostics : of the recording, its start pose and its mounts
    """

    mount: Mapping[str, Rotation]
    turn: Mapping[str, Rotation]
    heading: Mapping[str, float]
    start: tuple[float, float]
    static_phase: tuple[float, float]
    diagnostics: tuple[Diagnostic, ...]


# Which protocols in calibration/ see a segment's sensor; a sensor that is not here none of them sees.
_FOUND_BY = {
    "torso": "clasp, handle, poses or touch",
    **{f"{side}_upper_arm": f"clasp, handle, poses or touch_{side}" for side in ("left", "right")},
    **{f"{side}_forearm": f"clasp, handle, poses or touch_{side}" for side in ("left", "right")},
    **{f"{side}_hand": f"clasp, handle or touch_{side}" for side in ("left", "right")},
}


def check_mounts(recording: Recording, subject: Subject | None) -> None:
    """Raises `BadSession` where neither the subject nor the session knows the mount of a sensor."""
    missing = [segment for segment in recording.sensors if find_nominal_mount(recording, segment, subject) is None]
    if missing:
        of = f"sensors.{missing[0]}.mount is not known"
        if len(missing) > 1:
            of += f", nor that of {', '.join(missing[1:])}"
        if subject is not None and recording.remounted and set(missing) & set(subject.mounts):
            of += " (remounted = true: the subject's are of another mounting)"
        elif subject is not None and subject.mounts:
            of += f"; the subject '{subject.name}' has none for it"
        raise BadSession(f"{recording.where()}: {of}: {suggest_mounts(missing)}")


def suggest_mounts(segments: Sequence[str]) -> str:
    """What to do where mounts of these segments' sensors are not known: state them, or which calibration finds them."""
    do = 'state it, as in mount = { up = "+x", forward = "-z" }'
    by_protocols: dict[str, list[str]] = {}
    for segment in segments:
        by_protocols.setdefault(_FOUND_BY.get(segment, ""), []).append(segment)
    for protocols, of in by_protocols.items():
        if protocols:
            do += (
                f"; or find that of {', '.join(of)} by `wepose calibrate --protocol` {protocols}, and give that subject"
            )
    if "" in by_protocols:
        do += f"; no calibration finds that of {', '.join(by_protocols[''])}"
    return do


def align(recording: Recording, subject: Subject | None, filtered: FilteredRecording) -> Alignment:
    """Mounts and headings; `recording` is that which was filtered, or its chunk with the start pose.

    Raises
    ------
    BadSession
        A mount that gravity contradicts.
    """
    start, diagnostics = filtered.start, list(filtered.diagnostics)
    guessed = recording.start_is_guessed or not recording.phases.get("start")
    facts = {"variant": "guessed"} if guessed else {}
    mount, turn, heading = {}, {}, {}
    aligned = [segment for segment, sensor in recording.sensors.items() if sensor.aligned]
    if aligned:
        # The torso faces x; where it is not among them the most central of the others does.
        facing = min(aligned, key=SEGMENTS.index)
        psi_aligned = compute_heading(filtered.at_start[facing], Rotation.identity())
    for segment, at_start in filtered.at_start.items():
        if recording.sensors[segment].aligned:
            turn[segment] = Rotation.from_rotvec([0.0, 0.0, psi_aligned])
            mount[segment], heading[segment] = Rotation.identity(), psi_aligned
            continue
        stated = find_nominal_mount(recording, segment, subject)
        assert stated is not None
        R_stated = Rotation.from_quat(stated)
        psi = compute_heading(at_start, R_stated)
        R_LS = Rotation.from_rotvec([0.0, 0.0, psi]) * at_start
        off = np.degrees((R_LS * R_stated.inv()).magnitude())
        if off > STATED_LIMIT_DEG:
            calibrated = subject is not None and segment in subject.mounts and not recording.remounted
            of, do = ".mount", "check which sensor axis points up and which forward"
            if guessed:
                do = f"name its seconds, or {do}"
            if calibrated:
                of, do = ": its calibrated mount", "strapped on anew? then state remounted = true and the mounts"
                if guessed:
                    do = f"name its seconds; {do}"
            why = ", which was only guessed: [phases] start = [[from, to]] is missing" if guessed else ""
            raise BadSession(
                f"{recording.where()}: sensors.{segment}{of} is {off:.0f} deg off gravity in the start pose "
                f"({format_span(start)}){why}; {do}"
            )
        if off > STATED_WARNING_DEG:
            value, limit = float(np.deg2rad(off)), float(np.deg2rad(STATED_WARNING_DEG))
            diagnostics.append(Diagnostic("mount-contradicts-gravity", WARNING, segment, value, limit, facts))
        known = find_mount_covariance(recording, segment, subject)
        if known is not None:
            # The tilt's misfit is the pose's error and the mount's together; each takes its share. Of the heading,
            # which was made to fit, the start pose says nothing but through the mount's own correlations.
            misfit = (R_LS * R_stated.inv()).as_rotvec()[:2]
            both = known[:2, :2] + START_POSE_STD**2 * np.eye(2)
            R_LS = Rotation.from_rotvec(known[:, :2] @ np.linalg.solve(both, misfit)) * R_stated
            psi = compute_heading(at_start, R_LS)
            stood = subject.start_pose_offset.get(segment) if subject is not None else None
            if stood is not None:
                # Tilt and mount of the calibration come from one start pose: what one is off by, the other is too.
                misfit, both = misfit - stood.tilt, REPEATED_START_STD**2 * np.eye(2)
            if misfit @ np.linalg.solve(both, misfit) > MOVED_MOUNT**2:
                value = float(np.linalg.norm(misfit))
                diagnostics.append(Diagnostic("mount-moved", WARNING, segment, value, MOVED_MOUNT, facts))
        mount[segment], heading[segment] = R_LS, psi
        turn[segment] = Rotation.from_rotvec([0.0, 0.0, psi])
    return Alignment(mount, turn, heading, start, filtered.static_phase, tuple(diagnostics))


def orient_segments(
    chunk: Recording, alignment: Alignment, orientation: Mapping[str, Orientation], subject: Subject | None
) -> Segments:
    """A recording's segments, or those of a chunk of it, from what its sensors' filters gave."""
    quat_WL, covariance_W = {}, {}
    for segment, R_VS in collect_rotations(chunk, orientation).items():
        turn, R_LS = alignment.turn[segment], alignment.mount[segment]
        if chunk.sensors[segment].aligned:
            quat_WL[segment] = (turn * R_VS).as_quat()
            continue
        quat_WL[segment] = (turn * R_VS * R_LS.inv()).as_quat()
        ours = orientation.get(segment)
        if ours is not None and ours.attitude_cov is not None:
            covariance_W[segment] = compute_segment_covariance(chunk, segment, subject, turn * R_VS, R_LS, ours)
    return Segments(
        chunk.time,
        quat_WL,
        {segment: R_LS.as_quat() for segment, R_LS in alignment.mount.items()},
        alignment.heading,
        orientation,
        covariance_W,
        alignment.start,
        alignment.static_phase,
        alignment.diagnostics,
    )


def compute_heading(R_VS: Rotation, R_WS: Rotation) -> float:
    """ψ [rad] such that Rz(ψ) R_VS is nearest to R_WS: the twist about the vertical of R_WS R_VSᵀ."""
    return float(rotations.heading((R_WS * R_VS.inv()).as_quat()))


def find_nominal_mount(recording: Recording, segment: str, subject: Subject | None) -> np.ndarray | None:
    """The mount `quat_LS` (4,) xyzw as calibrated, else as stated, else that of a measured segment; None: unknown."""
    if subject is not None and segment in subject.mounts and not recording.remounted:
        return subject.mounts[segment]
    stated = recording.sensors[segment].stated_quat_LS
    if stated is None and segment not in recording.imus:
        return np.array([0.0, 0.0, 0.0, 1.0])  # orientations of segments, from a device that aligned them itself
    return stated


def compute_heading_variance(quat_VS: np.ndarray, attitude_cov: np.ndarray) -> np.ndarray:
    """(n,) [rad²]: variance about the vertical of errors on the right (n, 3, 3), in S."""
    up_S = Rotation.from_quat(quat_VS).inv().apply([0.0, 0.0, 1.0])
    return np.einsum("na,nab,nb->n", up_S, attitude_cov, up_S)


def compute_segment_covariance(
    recording: Recording,
    segment: str,
    subject: Subject | None,
    R_WS: Rotation,
    R_LS: Rotation,
    orientation: Orientation,
) -> np.ndarray:
    """Covariance (n, 3, 3) [rad²] in W of a segment's orientation, error on the left; see `Segments.covariance_W`."""
    R = R_WS.as_matrix()
    assert orientation.attitude_cov is not None
    cov_W = R @ orientation.attitude_cov @ R.swapaxes(1, 2)
    # Each rest measures the tilt anew with the same accelerometer bias, which averaging does not take away.
    cov_W += ACCEL_BIAS_STD**2 * np.diag([1.0, 1.0, 0.0])
    known = find_mount_covariance(recording, segment, subject)
    if known is not None:
        # A mount's error ε in L turns R_WL by R_WL ε. Its heading was taken for the world's, so that it turns R_WL
        # into Rz(δ) R_WL Rz(δ)ᵀ, which is nothing in the start pose; the pose weighed in on its tilt.
        R_WL = (R_WS * R_LS.inv()).as_matrix()
        lever = R_WL - np.array([0.0, 0.0, 1.0])[:, None] * np.array([0.0, 0.0, 1.0])
        tilt = known[:2]
        left = known - tilt.T @ np.linalg.solve(tilt[:, :2] + START_POSE_STD**2 * np.eye(2), tilt)
        cov_W += lever @ left @ lever.swapaxes(1, 2)
        cov_W[:, 2, 2] += compute_start_heading_var(recording, segment, subject)
    return cov_W


def compute_start_heading_var(recording: Recording, segment: str, subject: Subject | None) -> float:
    """Variance [rad²] of the heading that a segment's start pose gives its sensor's world: nobody stands exactly so.

    The torso's is zero: it says where x points. Nor does it count where the mount is stated, since what a person means
    by it is the start pose.
    """
    calibrated = find_mount_covariance(recording, segment, subject) is not None
    return START_POSE_STD**2 if calibrated and segment != "torso" else 0.0


def find_mount_covariance(recording: Recording, segment: str, subject: Subject | None) -> np.ndarray | None:
    """Covariance (3, 3) [rad²] of a calibrated mount's error in L, where it holds for this mounting and is known."""
    return None if subject is None or recording.remounted else subject.mount_covariance(segment)
