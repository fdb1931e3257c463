"""Sensors to segments: orientations in sensor worlds, mounts and headings from the start pose, segment orientations.

A sensor's filter knows the vertical and not the heading: its world V differs from W by a turn about z, the heading ψ.
In the N-pose every segment frame equals W, so the mount is R_LS = R_WS = Rz(ψ) R_VS(start): the tilt of it is measured
by gravity, and ψ is what makes it nearest to the mount as stated (or as calibrated). Nobody stands exactly so: what a
calibrated mount's covariance says is weighed against the few degrees by which the pose itself is off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtr  # of Student; scipy.stats takes half a second to load

from . import rotations
from .errors import BadPhase, BadSession, WeposeError
from .filters import BEST, OFFLINE, Orientation, SensorRun, check_method
from .filters.base import in_parallel
from .filters.start import ACCEL_BIAS_STD
from .noise import SensorNoise, noise_of, quietest
from .recording import CONFIGURATION, SEGMENTS, Recording, format_time, span_text
from .static import StaticTest
from .subject import Subject

# The stated axes are by hand; further off than this they are no longer what was meant.
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

# Turning in the start pose: root mean square of the rate, and largest turn from its mean. A person who stands sways
# below 3 deg/s and 3 deg; at the limits the mean pose is no longer the pose that was meant.
MOVES_DEG_S, MOVES_DEG = 20.0, 15.0
SWAYS_DEG_S, SWAYS_DEG = 6.0, 5.0
# Sensors that all turn about the vertical at the same rate are on a person who turns: rates [rad/s] above the first, by
# chance once in a thousand times. Of one or two sensors, a rate above what data sheets give for a bias.
COMMON_RATE, COMMON_RATE_CHANCE = float(np.deg2rad(0.5)), 1e-3
LARGEST_BIAS = float(np.deg2rad(5.0))


# Samples of a phase at rest, and the share of them that each sensor must have measured.
FEWEST_AT_START, LEAST_SHARE_AT_START = 10, 0.5


@dataclass(frozen=True)
class Segments:
    """Orientation of each measured segment.

    Parameters
    ----------
    time : (n,) [s]
    quat_WL : segment → (n, 4) xyzw
    quat_LS : segment → (4,) xyzw, the mount used
    heading : segment → ψ [rad], from the sensor's world to W
    orientation : segment → what the filter gave; none for ready orientations
    covariance_W : segment → (n, 3, 3) [rad²], of the error on the left of `quat_WL`, in W: the filter's, the
        accelerometer's bias, and the heading of a calibrated mount. A stated mount counts as
        exact. Only where the filter has a covariance
    start, still : intervals [s] used for headings, and for noise and bias
    warnings : what the user should know
    """

    time: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    quat_LS: Mapping[str, np.ndarray]
    heading: Mapping[str, float]
    orientation: Mapping[str, Orientation]
    covariance_W: Mapping[str, np.ndarray]
    start: tuple[float, float]
    still: tuple[float, float]
    warnings: tuple[str, ...]


class Filtered(NamedTuple):
    """Every sensor in its own world, before any mount is known."""

    R_VS: dict[str, Rotation]  # segment → n orientations of its sensor
    at_start: dict[str, Rotation]  # their mean in the start pose
    orientation: dict[str, Orientation]  # what the filter gave; none for ready orientations
    start: tuple[float, float]  # [s]
    still: tuple[float, float]  # [s]
    warnings: list[str]


class SensorFilters:
    """The filters of a recording that comes in pieces; `filtered` is one piece.

    Parameters
    ----------
    first : the piece that the recording begins with, and in which the phases `start` and `still` are
    method, static_test : as `filtered`

    Attributes
    ----------
    start, still, warnings : as in `Filtered`
    ahead : the smoother's: `push` gives the piece before, and the last one comes from `finish`

    Raises
    ------
    WeposeError
        A start phase in which there are too few samples; an unknown method.
    """

    def __init__(self, first: Recording, *, method: str = BEST, static_test: StaticTest | None = None) -> None:
        check_method(method)
        self.start, self.still, self.warnings = _phases(first)
        self._held: Recording | None = None  # the piece that the smoother has not given yet
        self._runs: dict[str, SensorRun] = {}
        noises: dict[str, SensorNoise] = {}
        for segment, sensor in first.sensors.items():
            if not sensor.aligned:
                self.warnings += _motion(first, segment, self.start, "start")
            if self.still != self.start and not sensor.aligned:
                self.warnings += _motion(first, segment, self.still, "still")
            if sensor.ready:
                continue
            assert sensor.gyro_S is not None
            assert sensor.accel_S is not None
            at_rest = first.measured(segment, self.still)
            try:
                worn = self.still == self.start and first.start_pose != CONFIGURATION  # a robot does not sway
                noise = noise_of(sensor.gyro_S[at_rest], sensor.accel_S[at_rest], first.rate_hz, worn)
            except WeposeError as error:
                raise type(error)(f"{first.where()}: sensors.{segment}: {error}") from error
            noises[segment] = noise
        self.warnings += _common_rotation(first, noises, self.still)
        for segment, noise in noises.items():
            self._runs[segment] = SensorRun(
                first.rate_hz,
                noise,
                method,
                static_test=static_test,
                measured_start=True,
                start=first.span(self.start),
                gyro_range=first.sensors[segment].gyro_range,
            )
        self.ahead = method in OFFLINE and bool(self._runs)

    def push(self, piece: Recording) -> tuple[Recording, dict[str, Orientation]] | None:
        """Take a piece; gives a piece and what the filters say of it: this one, or with the smoother the one before."""
        measured = []
        for segment in self._runs:
            sensor = piece.sensors[segment]
            gyro_S, accel_S = sensor.gyro_S, sensor.accel_S
            assert gyro_S is not None
            assert accel_S is not None
            if sensor.gap is not None:
                # A long bridge is a guess that no filter may take for measured: lost, its covariance grows over it.
                gyro_S, accel_S = (np.where(sensor.gap[:, None], np.nan, values) for values in (gyro_S, accel_S))
            measured.append((gyro_S, accel_S))
        before, self._held = self._held, piece
        done = in_parallel(lambda run, of: run.push(*of), self._runs.values(), measured)
        found = {segment: of for segment, of in zip(self._runs, done, strict=True) if of is not None}
        if len(found) < len(self._runs):
            return None
        of_piece = before if self.ahead else piece
        assert of_piece is not None
        return of_piece, found

    def finish(self) -> tuple[Recording, dict[str, Orientation]]:
        """The smoother's last piece."""
        assert self._held is not None
        found = in_parallel(SensorRun.finish, self._runs.values())
        return self._held, dict(zip(self._runs, found, strict=True))


def filtered(recording: Recording, *, method: str = BEST, static_test: StaticTest | None = None) -> Filtered:
    """Filter every sensor; the start pose, and how still it was.

    Raises
    ------
    WeposeError
        A start phase in which there are too few samples; an unknown method.
    """
    filters = SensorFilters(recording, method=method, static_test=static_test)
    _, orientation = filters.push(recording) or filters.finish()
    return filtered_piece(filters, recording, orientation)


def filtered_piece(filters: SensorFilters, piece: Recording, orientation: Mapping[str, Orientation]) -> Filtered:
    """A piece that `filters` gave, if the start pose is in it."""
    R_VS = _in_sensor_worlds(piece, orientation)
    at_start = {segment: R[piece.measured(segment, filters.start)].mean() for segment, R in R_VS.items()}
    return Filtered(R_VS, at_start, dict(orientation), filters.start, filters.still, filters.warnings)


def _in_sensor_worlds(piece: Recording, orientation: Mapping[str, Orientation]) -> dict[str, Rotation]:
    """Segment → n orientations of its sensor, each in a world of its own."""
    return {
        segment: Rotation.from_quat(sensor.quat_WS if sensor.quat_WS is not None else orientation[segment].quat_WS)
        for segment, sensor in piece.sensors.items()
    }


@dataclass(frozen=True)
class Alignment:
    """How sensors sit on their segments and where their worlds' headings are, from one start pose.

    Parameters
    ----------
    mount : segment → R_LS, sensor to segment
    turn : segment → Rz(ψ), the sensor's world to W
    heading : segment → ψ [rad]
    start, still : intervals [s] used for headings, and for noise and bias
    warnings : what the user should know
    """

    mount: Mapping[str, Rotation]
    turn: Mapping[str, Rotation]
    heading: Mapping[str, float]
    start: tuple[float, float]
    still: tuple[float, float]
    warnings: tuple[str, ...]


def segment_orientations(
    recording: Recording,
    subject: Subject | None = None,
    *,
    method: str = BEST,
    static_test: StaticTest | None = None,
) -> Segments:
    """Filter every sensor, then align it with its segment by the start pose.

    A calibrated mount of the subject is taken before a stated one, unless the strapping is new. Orientations that are
    aligned already are only turned about the vertical, all by the same angle, so that the torso faces x in the start
    pose.

    Raises
    ------
    WeposeError
        No mount is known for a sensor; a start phase in which there are too few samples; an unknown method.
    """
    need_mounts(recording, subject)
    found = filtered(recording, method=method, static_test=static_test)
    return oriented_segments(recording, align(recording, subject, found), found.orientation, subject)


# Which protocols in calibration/ see a segment's sensor; a sensor that is not here none of them sees.
_FOUND_BY = {
    "torso": "clasp, handle, poses or touch",
    **{f"{side}_upper_arm": f"clasp, handle, poses or touch_{side}" for side in ("left", "right")},
    **{f"{side}_forearm": f"clasp, handle, poses or touch_{side}" for side in ("left", "right")},
    **{f"{side}_hand": f"clasp, handle or touch_{side}" for side in ("left", "right")},
}


def need_mounts(recording: Recording, subject: Subject | None) -> None:
    """Raises `BadSession` where neither the subject nor the session knows the mount of a sensor."""
    missing = [segment for segment in recording.sensors if nominal_mount(recording, segment, subject) is None]
    if missing:
        of = f"sensors.{missing[0]}.mount is not known"
        if len(missing) > 1:
            of += f", nor that of {', '.join(missing[1:])}"
        if subject is not None and recording.strapping == "new" and set(missing) & set(subject.mounts):
            of += ' (strapping = "new": the subject\'s are of another strapping)'
        elif subject is not None and subject.mounts:
            of += f"; the subject '{subject.name}' has none for it"
        raise BadSession(f"{recording.where()}: {of}: {mount_advice(missing)}")


def mount_advice(segments: Sequence[str]) -> str:
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


def align(recording: Recording, subject: Subject | None, found: Filtered) -> Alignment:
    """Mounts and headings; `recording` is that which was filtered, or its piece with the start pose.

    Raises
    ------
    BadSession
        A mount that gravity contradicts.
    """
    start, warnings = found.start, list(found.warnings)
    named = bool(recording.phases.get("start"))
    guessed = "" if named else ", which was only guessed: [phases] start = [[from, to]] is missing"
    mount, turn, heading = {}, {}, {}
    aligned = [segment for segment, sensor in recording.sensors.items() if sensor.aligned]
    if aligned:
        # The torso faces x; where it is not among them the most central of the others does.
        facing = min(aligned, key=SEGMENTS.index)
        psi_aligned = heading_to(found.at_start[facing], Rotation.identity())
    for segment, at_start in found.at_start.items():
        if recording.sensors[segment].aligned:
            turn[segment] = Rotation.from_rotvec([0.0, 0.0, psi_aligned])
            mount[segment], heading[segment] = Rotation.identity(), psi_aligned
            continue
        stated = nominal_mount(recording, segment, subject)
        assert stated is not None
        R_stated = Rotation.from_quat(stated)
        psi = heading_to(at_start, R_stated)
        R_LS = Rotation.from_rotvec([0.0, 0.0, psi]) * at_start
        off = np.degrees((R_LS * R_stated.inv()).magnitude())
        if off > STATED_LIMIT_DEG:
            calibrated = subject is not None and segment in subject.mounts and recording.strapping != "new"
            of, do = ".mount", "check which sensor axis points up and which forward"
            if guessed:
                do = f"name its seconds, or {do}"
            if calibrated:
                of, do = ": its calibrated mount", 'strapped on anew? then state strapping = "new" and the mounts'
                if guessed:
                    do = f"name its seconds; {do}"
            raise BadSession(
                f"{recording.where()}: sensors.{segment}{of} is {off:.0f} deg off gravity in the start pose "
                f"({span_text(start)}){guessed}; {do}"
            )
        if off > STATED_WARNING_DEG:
            warnings.append(
                f"sensors.{segment}.mount is {off:.0f} deg off what gravity says in the start pose{guessed}"
            )
        known = mount_covariance(recording, segment, subject)
        if known is not None:
            # The tilt's misfit is the pose's error and the mount's together; each takes its share. Of the heading,
            # which was made to fit, the start pose says nothing but through the mount's own correlations.
            misfit = (R_LS * R_stated.inv()).as_rotvec()[:2]
            both = known[:2, :2] + START_POSE_STD**2 * np.eye(2)
            R_LS = Rotation.from_rotvec(known[:, :2] @ np.linalg.solve(both, misfit)) * R_stated
            psi = heading_to(at_start, R_LS)
            stood = subject.start_tilt.get(segment) if subject is not None else None
            if stood is not None:
                # Tilt and mount of the calibration come from one start pose: what one is off by, the other is too.
                misfit, both = misfit - stood.tilt, REPEATED_START_STD**2 * np.eye(2)
            if misfit @ np.linalg.solve(both, misfit) > MOVED_MOUNT**2:
                off = np.degrees(np.linalg.norm(misfit))
                warnings.append(
                    f"sensors.{segment}: its calibrated mount is {off:.0f} deg off what gravity says in the start "
                    f'pose{guessed}; strapped on anew? then state strapping = "new"'
                )
        mount[segment], heading[segment] = R_LS, psi
        turn[segment] = Rotation.from_rotvec([0.0, 0.0, psi])
    return Alignment(mount, turn, heading, start, found.still, tuple(warnings))


def oriented_segments(
    piece: Recording, alignment: Alignment, orientation: Mapping[str, Orientation], subject: Subject | None
) -> Segments:
    """A recording's segments, or those of a piece of it, from what its sensors' filters gave."""
    quat_WL, covariance_W = {}, {}
    for segment, R_VS in _in_sensor_worlds(piece, orientation).items():
        turn, R_LS = alignment.turn[segment], alignment.mount[segment]
        if piece.sensors[segment].aligned:
            quat_WL[segment] = (turn * R_VS).as_quat()
            continue
        quat_WL[segment] = (turn * R_VS * R_LS.inv()).as_quat()
        ours = orientation.get(segment)
        if ours is not None and ours.attitude_cov is not None:
            covariance_W[segment] = covariance_of(piece, segment, subject, turn * R_VS, R_LS, ours)
    return Segments(
        piece.time,
        quat_WL,
        {segment: R_LS.as_quat() for segment, R_LS in alignment.mount.items()},
        alignment.heading,
        orientation,
        covariance_W,
        alignment.start,
        alignment.still,
        alignment.warnings,
    )


def heading_to(R_VS: Rotation, R_WS: Rotation) -> float:
    """ψ [rad] such that Rz(ψ) R_VS is nearest to R_WS: the twist about the vertical of R_WS R_VSᵀ."""
    return float(rotations.heading((R_WS * R_VS.inv()).as_quat()))


def nominal_mount(recording: Recording, segment: str, subject: Subject | None) -> np.ndarray | None:
    """The mount `quat_LS` (4,) xyzw as calibrated, else as stated, else of a ready segment; None where unknown."""
    if subject is not None and segment in subject.mounts and recording.strapping != "new":
        return subject.mounts[segment]
    stated = recording.sensors[segment].stated_quat_LS
    if stated is None and recording.sensors[segment].ready:
        return np.array([0.0, 0.0, 0.0, 1.0])  # orientations of segments, from a device that aligned them itself
    return stated


def covariance_of(
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
    known = mount_covariance(recording, segment, subject)
    if known is not None:
        # A mount's error ε in L turns R_WL by R_WL ε. Its heading was taken for the world's, so that it turns R_WL
        # into Rz(δ) R_WL Rz(δ)ᵀ, which is nothing in the start pose; the pose weighed in on its tilt.
        R_WL = (R_WS * R_LS.inv()).as_matrix()
        lever = R_WL - np.array([0.0, 0.0, 1.0])[:, None] * np.array([0.0, 0.0, 1.0])
        tilt = known[:2]
        left = known - tilt.T @ np.linalg.solve(tilt[:, :2] + START_POSE_STD**2 * np.eye(2), tilt)
        cov_W += lever @ left @ lever.swapaxes(1, 2)
        cov_W[:, 2, 2] += start_heading_var(recording, segment, subject)
    return cov_W


def start_heading_var(recording: Recording, segment: str, subject: Subject | None) -> float:
    """Variance [rad²] of the heading that a segment's start pose gives its sensor's world: nobody stands exactly so.

    The torso's is zero: it says where x points. Nor does it count where the mount is stated, since what a person means
    by it is the start pose.
    """
    calibrated = mount_covariance(recording, segment, subject) is not None
    return START_POSE_STD**2 if calibrated and segment != "torso" else 0.0


def mount_covariance(recording: Recording, segment: str, subject: Subject | None) -> np.ndarray | None:
    """Covariance (3, 3) [rad²] of a calibrated mount's error in L, where it holds for this strapping and is known."""
    return None if subject is None or recording.strapping == "new" else subject.mount_covariance(segment)


def _phases(recording: Recording) -> tuple[tuple[float, float], tuple[float, float], list[str]]:
    """The start pose's interval, the interval that noise and bias come from, and what to tell the user of them."""
    notes = list(recording.notes)
    if recording.phases.get("start"):
        start = recording.phases["start"][0]
        if len(recording.phases["start"]) > 1:
            notes.append(f"phases.start holds several intervals; the first, {span_text(start)}, is used")
    elif recording.phases.get("still"):
        raise BadPhase(
            f"{recording.where()}: phases.still without phases.start; name the seconds of the start pose, "
            f"start = [[from, to]]"
        )
    else:
        start = quietest(recording)
        notes.append(f"no phases.start: the quietest window, {span_text(start)}, is taken for the start pose")
    still = recording.phases.get("still", ())
    if len(still) > 1:
        notes.append(f"phases.still holds several intervals; the first, {span_text(still[0])}, is used")
    for name, interval in (("start", start), *(("still", span) for span in still[:1])):
        place = f"{recording.where()}: phases.{name}: [{format_time(interval[0])}, {format_time(interval[1])}]"
        samples = len(recording.time[recording.span(interval)])
        if samples < FEWEST_AT_START:
            raise BadPhase(f"{place} holds {samples} samples; it needs at least {FEWEST_AT_START}, better two seconds")
        for segment in recording.sensors:
            measured = len(recording.measured(segment, interval))
            if measured < max(FEWEST_AT_START, LEAST_SHARE_AT_START * samples):
                raise BadPhase(
                    f"{place}: sensors.{segment} is lost in {samples - measured} of its {samples} samples: nothing "
                    f"there says how it sits; name seconds in which it measures, or take [sensors.{segment}] out"
                )
    return start, still[0] if still else start, notes


def _common_rotation(recording: Recording, noises: dict[str, SensorNoise], interval: tuple[float, float]) -> list[str]:
    """A warning if the person turns in a phase, whose mean rate is the gyroscopes' bias then; an error if by much.

    The biases of several sensors about the vertical are as different as sensors are; the same rate in all is the
    person's (one-sample t-test). What it may be stays in the biases' covariance, in place.
    """
    up_S = {}
    for segment in noises:
        accel_S = recording.sensors[segment].accel_S
        assert accel_S is not None
        mean_S = accel_S[recording.measured(segment, interval)].mean(axis=0)
        up_S[segment] = mean_S / np.linalg.norm(mean_S)
    rates = np.array([noise.gyro_bias @ up_S[segment] for segment, noise in noises.items()])
    if len(rates) == 0:
        return []
    mean = float(rates.mean())
    if len(rates) >= 3:
        spread = max(float(rates.std(ddof=1)), 1e-9) / np.sqrt(len(rates))
        turns = abs(mean) > COMMON_RATE and 2.0 * stdtr(len(rates) - 1, -abs(mean) / spread) < COMMON_RATE_CHANCE
    else:
        turns = abs(mean) > LARGEST_BIAS
    if not turns:
        return []
    turn_deg = abs(np.degrees(mean)) * (interval[1] - interval[0])
    found = f"all sensors turn about the vertical at {np.degrees(mean):.1f} deg/s, by {turn_deg:.0f} deg in all"
    if turn_deg > MOVES_DEG:
        raise BadPhase(
            f"{recording.where()}: phases.start ({format_time(interval[0])} to {format_time(interval[1])} s): {found}, "
            f"where gyroscopes have biases of their own: name seconds in which the person does not turn"
        )
    for segment, noise in noises.items():
        up = up_S[segment]
        noises[segment] = replace(noise, gyro_bias_cov=noise.gyro_bias_cov + mean**2 * np.outer(up, up))
    return [f"{found}: the biases of the gyroscopes, and so all headings, are uncertain by as much"]


def _motion(recording: Recording, segment: str, interval: tuple[float, float], phase: str) -> list[str]:
    """A note if the sensor sways in the phase, an error if it moves.

    The turn is taken without the mean rate, in which the gyroscope's bias cannot be told from a steady turn.
    """
    sensor, measured = recording.sensors[segment], recording.measured(segment, interval)
    if sensor.quat_WS is not None:
        R = Rotation.from_quat(sensor.quat_WS[measured])
        rate = (R[:-1].inv() * R[1:]).as_rotvec() * recording.rate_hz
    else:
        assert sensor.gyro_S is not None
        rate = sensor.gyro_S[measured]
        R = Rotation.from_quat(rotations.integrate((rate - rate.mean(axis=0)) / recording.rate_hz))
    rms = float(np.degrees(np.sqrt(np.mean(np.sum(rate**2, axis=1)))))
    turn = float(np.degrees(np.max((R.mean().inv() * R).magnitude())))
    guessed = phase not in recording.phases or not recording.phases[phase]
    place = "the quietest window, taken for the start pose" if guessed else f"phases.{phase}"
    found = f"sensors.{segment} turns by {turn:.0f} deg and at {rms:.0f} deg/s rms in {place} ({span_text(interval)})"
    if rms > MOVES_DEG_S or turn > MOVES_DEG:
        raise BadPhase(
            f"{recording.where()}: {found}; name seconds in which it keeps still, up to {MOVES_DEG_S:g} deg/s and "
            f"{MOVES_DEG:g} deg"
        )
    if rms > SWAYS_DEG_S or turn > SWAYS_DEG:
        return [f"{found}: mounts and headings are uncertain by as much"]
    return []
