"""Sensors to segments: orientations in sensor worlds, mounts and headings from the start pose, segment orientations.

A sensor's filter estimates the tilt but not the heading: its world V differs from W by the heading ψ, a rotation about
z. In the N-pose every segment frame equals W, so the mount is R_LS = R_WS = Rz(ψ) R_VS(start). Gravity measures its
tilt, and ψ brings it nearest to the stated or calibrated mount. A person's start pose is off by a few degrees, so the
covariance of a calibrated mount is weighed against that error.
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

# Limits [deg] of the angle between a stated mount and gravity or motion: error, warning.
STATED_LIMIT_DEG = 60.0
STATED_WARNING_DEG = 35.0

# Error [rad] of a person's segments in the start pose, about each axis: elbows are never straight.
START_POSE_STD = np.deg2rad(4.0)
# Difference [rad] between two start poses of one person, about each axis. An assumption.
REPEATED_START_STD = np.deg2rad(2.0)
# Error [rad] of a sensor's orientation against its segment, about each axis, mainly from soft tissue; and slip [m] of
# palms held together, on each axis.
ATTITUDE_STD = np.deg2rad(1.5)
SLIP_STD = 0.005
# A calibrated mount that differs from gravity by more than this many standard deviations has moved.
MOVED_MOUNT = 3.5


@dataclass(frozen=True)
class Segments:
    """Orientation of each measured segment.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw
    quat_LS : segment → (4,) xyzw, the mount
    heading : segment → ψ [rad], from the sensor's world to W
    orientation : segment → the filter's result; none for measured orientations
    covariance_W : segment → (n, 3, 3) [rad²], of the error on the left of `quat_WL`, in W: the filter's covariance, the
        accelerometer's bias, and the heading of a calibrated mount. A stated mount counts as exact. Only for filters
        with a covariance
    start, static_phase : intervals [s] for headings, and for noise and bias
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
    """Mounts of the sensors and headings of their worlds, from one start pose.

    Parameters
    ----------
    mount : segment → R_LS, sensor to segment
    turn : segment → Rz(ψ), the sensor's world to W
    heading : segment → ψ [rad]
    start, static_phase : intervals [s] for headings, and for noise and bias
    diagnostics : of the recording, its start pose and its mounts
    """

    mount: Mapping[str, Rotation]
    turn: Mapping[str, Rotation]
    heading: Mapping[str, float]
    start: tuple[float, float]
    static_phase: tuple[float, float]
    diagnostics: tuple[Diagnostic, ...]


# Segment → protocols in calibration/ that estimate its sensor's mount; no protocol does for other segments.
_PROTOCOLS = {
    "torso": "clasp, handle, poses or touch",
    **{f"{side}_upper_arm": f"clasp, handle, poses or touch_{side}" for side in ("left", "right")},
    **{f"{side}_forearm": f"clasp, handle, poses or touch_{side}" for side in ("left", "right")},
    **{f"{side}_hand": f"clasp, handle or touch_{side}" for side in ("left", "right")},
}


def check_mounts(recording: Recording, subject: Subject | None) -> None:
    """Raise `BadSession` where neither the subject nor the session has the mount of a sensor."""
    collect_nominal_mounts(recording, subject)


def collect_nominal_mounts(recording: Recording, subject: Subject | None) -> dict[str, np.ndarray]:
    """Collect segment → nominal mount `quat_LS` (4,) xyzw of every sensor.

    Raises
    ------
    BadSession
        Neither the subject nor the session has the mount of a sensor.
    """
    nominal = {segment: find_nominal_mount(recording, segment, subject) for segment in recording.sensors}
    mounts = {segment: mount for segment, mount in nominal.items() if mount is not None}
    missing = [segment for segment in nominal if segment not in mounts]
    if missing:
        text = f"sensors.{missing[0]}.mount is not known"
        if len(missing) > 1:
            text += f", nor that of {', '.join(missing[1:])}"
        if subject is not None and recording.remounted and set(missing) & set(subject.mounts):
            text += " (remounted = true: the subject's are of another mounting)"
        elif subject is not None and subject.mounts:
            text += f"; the subject '{subject.name}' has none for it"
        raise BadSession(f"{recording.where()}: {text}: {suggest_mounts(missing)}")
    return mounts


def suggest_mounts(segments: Sequence[str]) -> str:
    """Say what to do about unknown mounts of these segments' sensors: state them, or estimate them by a protocol."""
    advice = 'state it, as in mount = { up = "+x", forward = "-z" }'
    by_protocols: dict[str, list[str]] = {}
    for segment in segments:
        by_protocols.setdefault(_PROTOCOLS.get(segment, ""), []).append(segment)
    for protocols, names in by_protocols.items():
        if protocols:
            advice += (
                f"; or find that of {', '.join(names)} by `wepose calibrate --protocol` {protocols}, and give that "
                f"subject"
            )
    if "" in by_protocols:
        advice += f"; no calibration finds that of {', '.join(by_protocols[''])}"
    return advice


def align(recording: Recording, subject: Subject | None, filtered: FilteredRecording) -> Alignment:
    """Compute mounts and headings; `recording` is the filtered recording, or its chunk with the start pose.

    Raises
    ------
    BadSession
        A mount is not known, or gravity contradicts it.
    """
    start, diagnostics = filtered.start, list(filtered.diagnostics)
    guessed = recording.start_is_guessed or not recording.phases.get("start")
    facts = {"variant": "guessed"} if guessed else {}
    nominal = collect_nominal_mounts(recording, subject)
    mount, turn, heading = {}, {}, {}
    aligned = [segment for segment, sensor in recording.sensors.items() if sensor.aligned]
    if aligned:
        # The torso faces x, or the most central aligned segment without the torso.
        facing = min(aligned, key=SEGMENTS.index)
        psi_aligned = compute_heading(filtered.at_start[facing], Rotation.identity())
    for segment, at_start in filtered.at_start.items():
        if recording.sensors[segment].aligned:
            turn[segment] = Rotation.from_rotvec([0.0, 0.0, psi_aligned])
            mount[segment], heading[segment] = Rotation.identity(), psi_aligned
            continue
        R_stated = Rotation.from_quat(nominal[segment])
        psi = compute_heading(at_start, R_stated)
        R_LS = Rotation.from_rotvec([0.0, 0.0, psi]) * at_start
        off = np.degrees((R_LS * R_stated.inv()).magnitude())
        if off > STATED_LIMIT_DEG:
            calibrated = subject is not None and segment in subject.mounts and not recording.remounted
            place, advice = ".mount", "check which sensor axis points up and which forward"
            if guessed:
                advice = f"name its seconds, or {advice}"
            if calibrated:
                place, advice = ": its calibrated mount", "if it was remounted, state remounted = true and the mounts"
                if guessed:
                    advice = f"name its seconds; {advice}"
            why = ", which was only guessed: [phases] start = [[from, to]] is missing" if guessed else ""
            raise BadSession(
                f"{recording.where()}: sensors.{segment}{place} is {off:.0f} deg off gravity in the start pose "
                f"({format_span(start)}){why}; {advice}"
            )
        if off > STATED_WARNING_DEG:
            value, limit = float(np.deg2rad(off)), float(np.deg2rad(STATED_WARNING_DEG))
            diagnostics.append(Diagnostic("mount-contradicts-gravity", WARNING, segment, value, limit, facts))
        known = find_mount_covariance(recording, segment, subject)
        if known is not None:
            # The misfit of the tilt is the sum of the pose's error and the mount's; it is divided by their covariances.
            # The heading was fitted: the start pose corrects the mount's heading only through its correlations.
            misfit = (R_LS * R_stated.inv()).as_rotvec()[:2]
            both = known[:2, :2] + START_POSE_STD**2 * np.eye(2)
            R_LS = Rotation.from_rotvec(known[:, :2] @ np.linalg.solve(both, misfit)) * R_stated
            psi = compute_heading(at_start, R_LS)
            offset = subject.start_pose_offset.get(segment) if subject is not None else None
            if offset is not None:
                # Tilt and mount of the calibration come from one start pose and share its error.
                misfit, both = misfit - offset.tilt, REPEATED_START_STD**2 * np.eye(2)
            if misfit @ np.linalg.solve(both, misfit) > MOVED_MOUNT**2:
                value = float(np.linalg.norm(misfit))
                diagnostics.append(Diagnostic("mount-moved", WARNING, segment, value, MOVED_MOUNT, facts))
        mount[segment], heading[segment] = R_LS, psi
        turn[segment] = Rotation.from_rotvec([0.0, 0.0, psi])
    return Alignment(mount, turn, heading, start, filtered.static_phase, tuple(diagnostics))


def orient_segments(
    chunk: Recording, alignment: Alignment, orientation: Mapping[str, Orientation], subject: Subject | None
) -> Segments:
    """Compute the segments of a recording, or of a chunk of it, from its sensors' orientations."""
    quat_WL, covariance_W = {}, {}
    for segment, R_VS in collect_rotations(chunk, orientation).items():
        turn, R_LS = alignment.turn[segment], alignment.mount[segment]
        if chunk.sensors[segment].aligned:
            quat_WL[segment] = (turn * R_VS).as_quat()
            continue
        quat_WL[segment] = (turn * R_VS * R_LS.inv()).as_quat()
        result = orientation.get(segment)
        if result is not None and result.attitude_cov is not None:
            covariance_W[segment] = compute_segment_covariance(
                chunk, segment, subject, turn * R_VS, R_LS, result.attitude_cov
            )
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
    """Compute ψ [rad] such that Rz(ψ) R_VS is nearest to R_WS: the twist about the vertical of R_WS R_VSᵀ."""
    return float(rotations.heading((R_WS * R_VS.inv()).as_quat()))


def find_nominal_mount(recording: Recording, segment: str, subject: Subject | None) -> np.ndarray | None:
    """Find the mount `quat_LS` (4,) xyzw: the calibrated, else the stated, else that of a measured segment, or None."""
    if subject is not None and segment in subject.mounts and not recording.remounted:
        return subject.mounts[segment]
    stated = recording.sensors[segment].stated_quat_LS
    if stated is None and segment not in recording.imus:
        return np.array([0.0, 0.0, 0.0, 1.0])  # a device's own orientations of segments
    return stated


def compute_heading_variance(quat_VS: np.ndarray, attitude_cov: np.ndarray) -> np.ndarray:
    """Compute the variance about the vertical (n,) [rad²] of errors on the right (n, 3, 3), in S."""
    up_S = Rotation.from_quat(quat_VS).inv().apply([0.0, 0.0, 1.0])
    return np.einsum("na,nab,nb->n", up_S, attitude_cov, up_S)


def compute_segment_covariance(
    recording: Recording,
    segment: str,
    subject: Subject | None,
    R_WS: Rotation,
    R_LS: Rotation,
    attitude_cov: np.ndarray,
) -> np.ndarray:
    """Compute the covariance (n, 3, 3) [rad²] in W of a segment's orientation, error on the left.

    `attitude_cov` (n, 3, 3) [rad²] is the filter's, in S, error on the right; see `Segments.covariance_W`.
    """
    R = R_WS.as_matrix()
    cov_W = R @ attitude_cov @ R.swapaxes(1, 2)
    # Each static phase measures the tilt with the same accelerometer bias, which does not average out.
    cov_W += ACCEL_BIAS_STD**2 * np.diag([1.0, 1.0, 0.0])
    known = find_mount_covariance(recording, segment, subject)
    if known is not None:
        # A mount's error ε in L rotates R_WL by R_WL ε. Its heading error δ was put into the world's heading, which
        # changes R_WL into Rz(δ) R_WL Rz(δ)ᵀ and has no effect in the start pose. The start pose reduced its tilt.
        R_WL = (R_WS * R_LS.inv()).as_matrix()
        lever = R_WL - np.array([0.0, 0.0, 1.0])[:, None] * np.array([0.0, 0.0, 1.0])
        tilt = known[:2]
        left = known - tilt.T @ np.linalg.solve(tilt[:, :2] + START_POSE_STD**2 * np.eye(2), tilt)
        cov_W += lever @ left @ lever.swapaxes(1, 2)
        cov_W[:, 2, 2] += compute_start_heading_var(recording, segment, subject)
    return cov_W


def compute_start_heading_var(recording: Recording, segment: str, subject: Subject | None) -> float:
    """Compute the variance [rad²] of the heading of a sensor's world, from the error of the segment's start pose.

    It is zero for the torso, which defines x, and for a stated mount, which is defined by the start pose.
    """
    calibrated = find_mount_covariance(recording, segment, subject) is not None
    return START_POSE_STD**2 if calibrated and segment != "torso" else 0.0


def find_mount_covariance(recording: Recording, segment: str, subject: Subject | None) -> np.ndarray | None:
    """Find the covariance (3, 3) [rad²] of a calibrated mount's error in L; None: unknown or remounted."""
    return None if subject is None or recording.remounted else subject.mount_covariance(segment)
