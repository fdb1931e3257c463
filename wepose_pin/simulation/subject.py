"""`simulate`: the paper's upper-body experiment with known truth; and the IMU data that any motion gives."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..arguments import Count, Positive, check_arguments, check_names
from ..body import DEFAULT_BODY, SEXES, load_table
from ..body.girdle import PARAMETERS
from ..body.kinematics import Pose
from ..body.subject import Subject, check_lengths, population_subject
from ..errors import BadOption
from ..recording import ImuSensor, Recording, check_recording, compute_mount
from ..recording.clocks import Clock
from ..recording.gaps import bridge, mark_lost_samples
from ..rotations import compose, heading, log
from .imperfections import IDEAL_PRESET, Imperfections
from .imu import GRAVITY, MTI_3, Device, ImuNoise, draw_lost, jitter_time
from .motion import E_Z, SEGMENTS, STAND_S, BodyMotion, BodyPose, Flaws
from .sequence import find_task
from .signals import Wander
from .soft_tissue import JointRotations, SoftTissue, is_on, read_joints

_MOUNT = ("+x", "-z")  # sensor axes that point up and forward, apart from the tilt of the strap

MEASURED_LENGTHS = ("shoulder_width", "trunk")  # of a simulated person
MEASURED_STD = 0.003  # [m] of each
# [m] Shoulder width as 0.83 ± 0.03 of the biacromial breadth (`breadths` in calibration/anthropometry.toml): 12 mm of
# 400 mm.
PEOPLE_MEASURED_STD = 0.012
_STENCIL_S = 1e-3  # for p_ddot: truncation and rounding together stay below 1e-6 m/s^2
_MIDPOINTS = (np.arange(4) + 0.5) / 4.0  # of an interval's quarters, for its mean
_GAIN_RATE_HZ = 20.0  # at which soft-tissue motion is scaled to its rms
# Streams of random numbers: new ones go to the end.
_STREAMS = (
    "motion",
    "strap",
    "noise",
    "palm_slip",
    "shoulder_wander",
    "start_elbow",
    "start_segment",
    "sway",
    "soft_tissue",
    "device",
    "clock_jitter",
    "clock_offset",
    "dropped",
    "mount",
    "task",
    "tissue_gain",
    "tissue_random",
    "breath",
    "creep",
    "strap_slip",
    "girdle_person",
    "girdle_wander",
    "girdle_rest",
    "carrying_angle",
    "elbow_abduction",
    "start_pose",
    "start_heading",
    "sway_tilt",
    "wrist",
    "gyro_warm_up",
    "clock_drift",
)
# What stays with a person from session to session.
_PERSON_STREAMS = (
    "shoulder_wander",
    "tissue_gain",
    "girdle_person",
    "girdle_rest",
    "carrying_angle",
    "elbow_abduction",
)


@dataclass(frozen=True)
class Simulation:
    """The result of `simulate`: exact motion, IMU data, and the contents of the session file.

    `quat_LS` is R_LS = Swing @ N, where N takes the axes of `stated_mount` to z (up) and x (forward) of the
    segment and Swing turns by 2 to 10 deg about a horizontal axis. So, in an exact N-pose, the stated axes and gravity
    measured there give the mount exactly: Swing is the least rotation from N @ (up in S) to e_z. With mounts at any
    rotation nothing is stated.

    Motion is that of the true skeleton, at `time`. Soft tissue turns a sensor by `soft_tissue` from its mount:
    R_WS = R_WL @ exp(soft_tissue_L) @ R_LS, which is `quat_WS`. It and the IMU data are at `sample_time`.
    """

    time: np.ndarray  # (n,) [s], from 0
    rate_hz: float
    quat_WL: dict[str, np.ndarray]  # segment -> (n, 4) xyzw, exact
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W, exact
    gyro_S: dict[str, np.ndarray]  # sensor (named by its segment) -> (n, 3) [rad/s], over (k-1, k]; NaN where lost
    accel_S: dict[str, np.ndarray]  # sensor -> (n, 3) [m/s^2], specific force at sample k; NaN where lost
    quat_LS: dict[str, np.ndarray]  # sensor -> (4,) xyzw, exact mount, sensor to segment
    p_LS: dict[str, np.ndarray]  # sensor -> (3,) [m] in L, from hips, shoulder or elbow to the sensor
    stated_mount: dict[str, tuple[str, str] | None]  # sensor -> its axes that point up, forward; None: not stated
    gyro_bias: dict[str, np.ndarray]  # sensor -> (n, 3) [rad/s], exact
    accel_bias: dict[str, np.ndarray]  # sensor -> (n, 3) [m/s^2], exact
    lengths: dict[str, float]  # [m]
    phases: dict[str, list[tuple[float, float]]]
    """[s]. "start": static in the N-pose; "clasp": palms together; "circles": first lift off the table to last
    return; "rest": each rest of the right hand on the table, all sensors static (but for the sway)."""
    imperfections: Imperfections
    quat_WS: dict[str, np.ndarray]  # sensor -> (n, 4) xyzw, its own true orientation
    soft_tissue: dict[str, np.ndarray]  # sensor -> (n, 3) [rad], rotation vector in L
    device: dict[str, Device]  # sensor -> its own errors
    sample_time: dict[str, np.ndarray]  # sensor -> (n,) [s], true sampling times; the file states `time`

    def __repr__(self) -> str:
        return f"Simulation({self.time[-1] - self.time[0]:.1f} s at {self.rate_hz:g} Hz, {len(self.gyro_S)} sensors)"

    def recording(self, name: str = "simulated") -> Recording:
        """Return the recording that a user would have: sensors, stated mounts and phases, without truth.

        It has the stated times, so that clock errors stay in the data as in a file. The readers' code bridges lost
        samples.
        """
        clock = Clock(self.time, np.arange(len(self.time)), 1.0 / self.rate_hz)
        sensors = {}
        for segment, gyro_S in self.gyro_S.items():
            marks = mark_lost_samples(clock, np.isfinite(gyro_S).all(axis=1))
            stated = self.stated_mount[segment]
            sensors[segment] = ImuSensor(
                gyro_S=bridge(gyro_S, marks, clock, rate=True),
                accel_S=bridge(self.accel_S[segment], marks, clock),
                stated_quat_LS=None if stated is None else compute_mount(*stated),
            )
        phases = {phase: tuple(spans) for phase, spans in self.phases.items() if spans}
        return check_recording(Recording(name, self.time, self.rate_hz, sensors, phases))

    @property
    def girdles(self) -> dict[str, np.ndarray]:
        """Girdle → (7,) what the person's shoulders differ by from the law of the body's table, as far as it is known.

        Without `Imperfections.girdle` they do not move; what a person has beside de Groot's regression is not in it.
        """
        own = np.zeros(len(PARAMETERS))
        own[PARAMETERS.index("law")] = min(self.imperfections.girdle, 1.0) - 1.0
        return dict.fromkeys(load_table().girdles, own)

    def truth(self) -> Pose:
        """Return the exact pose."""
        return Pose(self.time, self.quat_WL, self.points)

    def truth_facing_torso(self) -> Pose:
        """Return the exact pose in the W of tracking, whose x is where the torso faces in the first start phase."""
        begin, end = self.phases["start"][0]
        start = (self.time >= begin) & (self.time <= end)
        facing = float(heading(Rotation.from_quat(self.quat_WL["torso"][start]).mean().as_quat()))
        turn = Rotation.from_rotvec([0.0, 0.0, -facing])
        return Pose(
            self.time,
            {name: (turn * Rotation.from_quat(quat)).as_quat() for name, quat in self.quat_WL.items()},
            {name: turn.apply(place) for name, place in self.points.items()},
        )


class _Moved(NamedTuple):
    """The motion of a segment and of its sensor's position at n times."""

    time: np.ndarray  # (n,) [s]
    R_WL: Rotation
    p_ddot: np.ndarray  # (n, 3) [m/s^2] in W, of the sensor's position
    rate_L: np.ndarray  # (n, 3) [rad/s] of the segment


class _Sampled:
    """The motion at n times, and at neighbouring times for numerical derivatives."""

    def __init__(self, motion: BodyMotion, t: np.ndarray, segment: str = "", *, joints: bool = False) -> None:
        """Sample all segments, or one segment and those that carry it; `joints`: with the rotations of the joints."""
        segments = [segment] if segment else list(motion.p_LS)
        all_arms = joints and segment in ("", "torso")  # the sensor on the chest follows both
        self.time, self._motion, self._segments = t, motion, segments
        self.pose: BodyPose = motion(t, [*segments, *SEGMENTS] if all_arms else segments)
        self.joints: JointRotations | None = read_joints(self.pose) if joints else None

    @cached_property
    def neighbours(self) -> list[BodyPose]:
        """The poses two steps and one step before, one and two after."""
        return [self._motion(self.time + step * _STENCIL_S, self._segments) for step in (-2, -1, 1, 2)]

    def segment(self, segment: str) -> _Moved:
        p_LS = self._motion.p_LS[segment]
        poses = [self.pose, *self.neighbours]
        p_W, *others_W = (pose.R_WL[segment].apply(p_LS) + pose.origins[segment] for pose in poses)
        # Differences to the middle first: for a static segment they are exactly zero.
        far, near, near_after, far_after = (other_W - p_W for other_W in others_W)
        p_ddot = (16.0 * (near + near_after) - (far + far_after)) / (12.0 * _STENCIL_S**2)
        turn = compose(self.neighbours[1].R_WL[segment].inv(), self.neighbours[2].R_WL[segment])
        return _Moved(self.time, self.pose.R_WL[segment], p_ddot, log(turn.as_quat()) / (2.0 * _STENCIL_S))


class _MildTissue:
    """Soft-tissue rotation of a sensor of the mild preset: a mixture of specific force and rate, a slow wandering."""

    def __init__(self, rng: np.random.Generator, rms_deg: float, moved: _Moved, activity: np.ndarray) -> None:
        """The rotation has its rms over these samples."""
        self.mixture = rng.standard_normal((6, 3))
        self.wander = [Wander(rng) for _ in range(3)]
        follows, wanders = self._parts(moved, activity)
        each = np.array([1.0 / np.sqrt(np.mean(part**2, axis=0)) for part in (follows, wanders)])
        total = each[0] * follows + each[1] * wanders
        rms = np.deg2rad(rms_deg) / np.sqrt(3.0)  # [rad] of an axis
        self.gains = each * rms / np.sqrt(np.mean(total**2, axis=0))  # (2, 3) of the two parts, of each axis

    def _parts(self, moved: _Moved, activity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # In units of g and of 3 rad/s, typical of free arm motion; zero in a static N-pose.
        force_L = moved.R_WL.inv().apply(moved.p_ddot / GRAVITY + E_Z) - E_Z
        follows = np.column_stack((force_L, moved.rate_L / 3.0)) @ self.mixture
        return follows, activity[:, None] * np.column_stack([wander(moved.time) for wander in self.wander])

    def __call__(self, moved: _Moved, activity: np.ndarray) -> np.ndarray:
        """Return rotation vectors (n, 3) [rad] in L."""
        follows, wanders = self._parts(moved, activity)
        return self.gains[0] * follows + self.gains[1] * wanders


class _Skin:
    """What turns one sensor on its segment."""

    def __init__(
        self,
        motion: BodyMotion,
        segment: str,
        sizes: Imperfections,
        rngs: Mapping[str, np.random.Generator],
        start: JointRotations | None,
        coarse: _Sampled | None,
    ) -> None:
        """`start`: the joints in the start pose; `coarse`: the motion that the mild tissue is scaled by; None: off."""
        self.motion, self.segment, self.start = motion, segment, start
        self.mild: _MildTissue | None = None
        if coarse is not None:
            moved, activity = coarse.segment(segment), motion.activity(coarse.time)
            self.mild = _MildTissue(rngs["soft_tissue"], sizes.soft_tissue_deg, moved, activity)
        place = -motion.p_LS[segment][2] / motion.lengths.get(segment, 1.0)
        self.tissue = SoftTissue(segment, place, sizes, rngs, motion.span[1])

    def sample(self, t: np.ndarray) -> _Sampled:
        """Sample the motion at the times `t` (n,) [s], for this sensor alone."""
        return _Sampled(self.motion, t, self.segment, joints=self.start is not None)

    def turn(self, sampled: _Sampled) -> tuple[_Moved, np.ndarray]:
        """Return the segment's motion and the sensor's rotation vectors (n, 3) [rad] in L."""
        moved = sampled.segment(self.segment)
        soft_L = np.zeros((len(sampled.time), 3))
        if self.mild is not None:
            soft_L = self.mild(moved, self.motion.activity(sampled.time))
        if self.start is not None and sampled.joints is not None:
            accel_L = moved.R_WL.inv().apply(moved.p_ddot)
            moving_time = self.motion.moving_time(sampled.time, self.segment)
            soft_L = soft_L + self.tissue(sampled.time, moving_time, (sampled.joints, self.start), accel_L)
        return moved, soft_L


def simulate(
    lengths: Mapping[str, float],
    *,
    seed: Count,
    rate_hz: Positive = 100.0,
    noise: ImuNoise = MTI_3,
    imperfections: Imperfections = IDEAL_PRESET,
    clasp_s: Positive = 60.0,
    circles: Count = 6,
    protocol: str = "clasp",
    session: Count = 0,
) -> Simulation:
    """Simulate a person with five sensors in the upper-body experiment of Lisini Baldi et al. 2019; the truth is known.

    0 to 5 s static in the N-pose; 2.5 s to the clasp; `clasp_s` of free motion with the palms together while
    the torso leans and twists; 2.5 s in which the left arm returns to hang and the right hand goes to a
    table; then `circles` circles in the air, a rest on the table before and after each.

    Parameters
    ----------
    lengths : mapping
        Length → [m]: ``trunk``, ``shoulder_width``, ``left_upper_arm``, ``left_forearm``, ``left_hand`` and the same of
        the right.
    seed : int
        The same seed gives the same numbers. Motion, mounts, noise and each imperfection have random streams of their
        own: noise and rate change neither motion nor mounts, and twice the density is the same noise twice as large.
    rate_hz : float
        Samples a second.
    noise : ImuNoise
        Of gyroscope and accelerometer; by default that of an Xsens MTi-3, `NOISE_FREE` for none. It and the names in
        capitals below are in `wepose_pin.simulation`.
    imperfections : Imperfections
        Of subject, mounting and sensors; `IDEAL_PRESET` for none, `MILD_PRESET` for a careful subject, `PEOPLE_PRESET`
        for the sizes that the literature reports.
    clasp_s : float
        [s] duration of the clasp, at least 5.
    circles : int
        Number of circles, 0 or more.
    protocol : str
        What the person does in the time of the clasp: "clasp", "t_pose", "bow", or several of them joined by "+".
    session : int
        Number of the person's session. Another number is another day: sensors are mounted again; motion, start pose and
        noise are others.

    Returns
    -------
    Simulation
        `recording()` is the `Recording` that a user would have, `truth()` the true `Pose`. Before the sensor's own
        errors, gyro_S[k] is log(R_WS[k-1]ᵀ R_WS[k]) over the time between the two samples, so that the product of all
        exp(gyro_S / rate) is the true orientation exactly; accel_S[k] is R_WS[k]ᵀ (p̈ + g e_z), p̈ by central
        differences.

    Raises
    ------
    BadOption
        A length is missing or not positive, the arms cannot do the motion, or a parameter is out of range.

    Examples
    --------
    >>> person = wp.population_subject(1.75)
    >>> simulation = wp.simulate(person.lengths, seed=1, clasp_s=10.0, circles=0)
    >>> simulation.recording()
    Recording('simulated': 22.5 s at 100 Hz, 5 sensors, phases start, clasp, rest)
    >>> simulation.truth().points["right_palm"].shape  # [m] in W
    (2251, 3)
    """
    check_arguments(simulate, locals())
    names = tuple(load_table().lengths)
    check_names("lengths", lengths, names)
    check_lengths("lengths", lengths)
    missing = [name for name in names if name not in lengths]
    if missing:
        raise BadOption(f"lengths: {', '.join(missing)} is missing; each is needed, in metres")
    if not (clasp_s >= 5.0 and circles >= 0 and rate_hz > 0.0):
        raise BadOption(f"clasp_s {clasp_s} must be >= 5, circles {circles} >= 0, rate_hz {rate_hz} > 0")
    task = find_task(protocol)
    lengths = {name: float(lengths[name]) for name in names}
    rngs = spawn_streams(seed, session)
    motion = task(lengths, rngs["motion"], clasp_s, circles, Flaws(imperfections, rngs, lengths["shoulder_width"]))
    motion.fit_to_person(rngs["task"])
    return measure_motion(motion, rngs, rate_hz, noise, imperfections)


def spawn_streams(seed: int, session: int = 0) -> dict[str, np.random.Generator]:
    """Spawn the streams of random numbers by their names; a later session of the person shares those of the person."""
    streams = dict(zip(_STREAMS, np.random.default_rng(seed).spawn(len(_STREAMS)), strict=True))
    if session:
        again = zip(_STREAMS, np.random.default_rng([seed, session]).spawn(len(_STREAMS)), strict=True)
        streams |= {name: stream for name, stream in again if name not in _PERSON_STREAMS}
    return streams


def measure_motion(
    motion: BodyMotion,
    rngs: Mapping[str, np.random.Generator],
    rate_hz: float,
    noise: ImuNoise,
    imperfections: Imperfections,
) -> Simulation:
    """Measure a motion with a sensor on each segment of its `p_LS`, by the streams of `spawn_streams`."""
    n = int(np.floor(motion.span[1] * rate_hz)) + 1
    time = np.arange(n) / rate_hz
    N = Rotation.from_matrix([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # x_S to z_L, -z_S to x_L

    sizes = imperfections
    own_clocks = any((sizes.clock_jitter, sizes.clock_offset, sizes.clock_drift_ppm))
    never_still = own_clocks or any((sizes.sway_deg_s, sizes.sway_tilt_deg, sizes.breath_deg, sizes.creep_deg))
    start = read_joints(motion(np.array([0.5 * STAND_S]), SEGMENTS)) if is_on(sizes) else None
    stated_time = _Sampled(motion, time, joints=start is not None)
    coarse = _Sampled(motion, np.arange(*motion.span, 1.0 / _GAIN_RATE_HZ)) if sizes.soft_tissue_deg else None

    sensors: defaultdict[str, dict] = defaultdict(dict)
    for segment in motion.p_LS:
        heading, tilt = rngs["strap"].uniform(0.0, 2.0 * np.pi), np.deg2rad(rngs["strap"].uniform(2.0, 10.0))
        R_LS = Rotation.from_rotvec(tilt * np.array((np.cos(heading), np.sin(heading), 0.0))) * N
        any_quat = rngs["mount"].standard_normal(4)  # uniform on the sphere
        if sizes.mount == "any":
            R_LS = Rotation.from_quat(any_quat / np.linalg.norm(any_quat))
        own_time = jitter_time(rngs["clock_jitter"], time, rate_hz, sizes.clock_jitter)
        own_time = own_time + sizes.clock_offset * rngs["clock_offset"].standard_normal()
        own_time = own_time + 1e-6 * sizes.clock_drift_ppm * rngs["clock_drift"].standard_normal() * time

        skin = _Skin(motion, segment, sizes, rngs, start, coarse)
        moved, soft_L = skin.turn(skin.sample(own_time) if own_clocks else stated_time)
        R_WS = compose(moved.R_WL, Rotation.from_rotvec(soft_L), R_LS)
        rotvec = log(compose(R_WS[:-1].inv(), R_WS[1:]).as_quat())
        rate_S = np.vstack((np.zeros(3), rotvec * rate_hz))  # static before the first sample
        if own_clocks:
            rate_S[1:] = rotvec / np.diff(own_time)[:, None]
        if never_still:  # a sample before the first one, for the rate that ends there
            before, soft_before = skin.turn(skin.sample(own_time[:1] - 1.0 / rate_hz))
            R_before = before.R_WL * Rotation.from_rotvec(soft_before) * R_LS
            rate_S[0] = (R_before[0].inv() * R_WS[0]).as_rotvec() * rate_hz
        force_S = R_WS.inv().apply(moved.p_ddot + GRAVITY * E_Z)
        if sizes.accel_average:
            parts = []
            for age in sizes.accel_average / rate_hz * _MIDPOINTS:
                then, soft_then = skin.turn(skin.sample(own_time - age))
                R_then = then.R_WL * Rotation.from_rotvec(soft_then) * R_LS
                parts.append(R_then.inv().apply(then.p_ddot + GRAVITY * E_Z))
            force_S = np.mean(parts, axis=0)

        device = Device.sample(rngs["device"], sizes, rngs["gyro_warm_up"])
        readings = device.measure(rate_S, force_S, rate_hz, noise, sizes, rngs["noise"])
        dropped = draw_lost(rngs["dropped"], n, rate_hz, sizes.dropped)
        readings.gyro_S[dropped] = readings.accel_S[dropped] = np.nan
        own = {"quat_LS": R_LS.as_quat(), "quat_WS": R_WS.as_quat(), "soft_tissue": soft_L, "sample_time": own_time}
        for name, value in {**own, **readings._asdict(), "device": device}.items():
            sensors[name][segment] = value

    return Simulation(
        time=time,
        rate_hz=rate_hz,
        quat_WL={segment: stated_time.pose.R_WL[segment].as_quat() for segment in motion.p_LS},
        points=stated_time.pose.points,
        p_LS=dict(motion.p_LS),
        stated_mount=dict.fromkeys(motion.p_LS, _MOUNT if sizes.mount == "stated" else None),
        lengths=dict(motion.lengths),
        phases=motion.phases(),
        imperfections=imperfections,
        **sensors,
    )


class Person(NamedTuple):
    """A random person, with the lengths that a user would measure."""

    lengths: dict[str, float]  # [m], true
    stature: float  # [m]
    sex: str  # "f" or "m"
    measured: dict[str, float]  # [m] measured lengths, each with a random error of `measured_std`
    measured_std: float  # [m]
    prior: Subject  # the population prior of that stature and sex


def simulate_person(seed: int, measured_std: float = MEASURED_STD, body: str = DEFAULT_BODY) -> Person:
    """Sample a person of the population, with the lengths of a `body` and measured shoulder width and trunk.

    `measured_std` [m] is the error of both: by default that of a careful measurement between the joint centres
    themselves. Nobody can reach them: `PEOPLE_MEASURED_STD` is the error of 0.83 times the biacromial breadth.
    """
    rng = np.random.default_rng([seed, 7])
    sex = SEXES[int(rng.integers(2))]
    mean, std = {"f": (1.63, 0.064), "m": (1.756, 0.069)}[sex]  # [m], ANSUR II (Gordon et al. 2014)
    stature = float(np.clip(rng.normal(mean, std), 1.45, 2.0))
    table = load_table(body)
    prior = population_subject(round(stature, 2), sex, table)
    lengths = dict(population_subject(stature, sex, table).sample(rng).lengths)
    measured = {name: lengths[name] + float(rng.normal(0.0, measured_std)) for name in MEASURED_LENGTHS}
    return Person(lengths, stature, sex, measured, measured_std, prior)
