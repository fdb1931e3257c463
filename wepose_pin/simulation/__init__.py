"""People with known truth, and the IMU data that their motion gives: `simulate` and `simulate_activity`.

The motion is a closed form of continuous time; splines through it serve all sensors, each by its own clock. That of a
protocol (`motion`) shares no code with the body room: what the tests compare against is written here and nowhere else.
That of an activity of the whole body (`activities`) gives orientations; the body places the segments. Frames as
everywhere: W is z up, x forward, y left, origin at the root of the trunk; each segment frame equals W in the N-pose.

By default a perfect world: no soft tissue, an exact N-pose, palms that coincide in the clasp, hands that are static on
the table, and sensors with noise and bias only. `Imperfections` add those of real people and sensors.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from ..arguments import Count, Positive, Range, check_arguments, check_names
from ..body import DEFAULT_BODY, SEXES, load_model, load_table
from ..body.girdle import FIXED
from ..body.kinematics import Pose
from ..body.subject import BodyLength, Subject, population_subject
from ..errors import BadOption, one_of
from ..recording import ImuSensor, Recording, compute_mount
from ..recording.clocks import bridge
from ..rotations import compose, heading, log, unwrap_signs
from .activities import ACTIVITIES as ACTIVITIES
from .imperfections import GRAVITY, Device, draw_lost, jitter_time
from .imperfections import IDEAL_PRESET as IDEAL_PRESET
from .imperfections import MILD_PRESET as MILD_PRESET
from .imperfections import MTI_3 as MTI_3
from .imperfections import NOISE_FREE as NOISE_FREE
from .imperfections import PEOPLE_PRESET as PEOPLE_PRESET
from .imperfections import PRESETS as PRESETS
from .imperfections import Imperfections as Imperfections
from .imperfections import ImuNoise as ImuNoise
from .motion import CIRCLING_POINT as CIRCLING_POINT
from .motion import PARTS, SEGMENTS, STAND_S, BodyMotion, Motion
from .people import E_Z, Flaws, SoftTissue
from .people import SIDES as SIDES

_MOUNT = ("+x", "-z")  # sensor axes that point up and forward, apart from the tilt of the strap

MEASURED_LENGTHS = ("shoulder_width", "trunk")  # of a simulated person
MEASURED_STD = 0.003  # [m] of each
# [m] Shoulder width as 0.83 ± 0.03 of the biacromial breadth (`breadths` in calibration/anthropometry.toml): 12 mm of
# 400 mm.
PEOPLE_MEASURED_STD = 0.012
_GRID_HZ = 200.0  # at least, of the poses that a motion is interpolated between
_MIDPOINTS = (np.arange(4) + 0.5) / 4.0  # of an interval's quarters, for its mean


@dataclass(frozen=True)
class Simulation:
    """The result of `simulate`: exact motion, IMU data, and the contents of the session file.

    A stated mount is the true one, R_LS, apart from a turn of 2 to 10 deg about a horizontal axis: in an exact N-pose
    gravity corrects it exactly. Motion is that of the true skeleton, at `time`. Soft tissue turns a sensor from its
    mount: R_WS = R_WL @ exp(soft_tissue_L) @ R_LS, which is `quat_WS`. It and the IMU data are at `sample_time`.
    """

    time: np.ndarray  # (n,) [s], from 0
    rate_hz: float
    quat_WL: dict[str, np.ndarray]  # segment -> (n, 4) xyzw, exact
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W, exact
    gyro_S: dict[str, np.ndarray]  # sensor (named by its segment) -> (n, 3) [rad/s], over (k-1, k]; NaN where lost
    accel_S: dict[str, np.ndarray]  # sensor -> (n, 3) [m/s^2], specific force at sample k; NaN where lost
    quat_LS: dict[str, np.ndarray]  # sensor -> (4,) xyzw, exact mount, sensor to segment
    p_LS: dict[str, np.ndarray]  # sensor -> (3,) [m] in L, from hips, shoulder or elbow to the sensor
    stated_mount: tuple[str, str] | None  # axes of every sensor that point up, forward; None: not stated
    gyro_bias: dict[str, np.ndarray]  # sensor -> (n, 3) [rad/s], exact
    accel_bias: dict[str, np.ndarray]  # sensor -> (n, 3) [m/s^2], exact
    lengths: dict[str, float]  # [m]
    phases: dict[str, list[tuple[float, float]]]
    """[s]. "start": static in the N-pose; "circles": first lift off the table to last return; "rest": each rest of the
    right hand on the table, all sensors static (but for the sway); the others are those of the protocol."""
    imperfections: Imperfections
    quat_WS: dict[str, np.ndarray]  # sensor -> (n, 4) xyzw, its own true orientation
    soft_tissue: dict[str, np.ndarray]  # sensor -> (n, 3) [rad], rotation vector in L
    device: dict[str, Device]  # sensor -> its own errors
    sample_time: dict[str, np.ndarray]  # sensor -> (n,) [s], true sampling times; the file states `time`

    def __repr__(self) -> str:
        return f"Simulation({self.time[-1] - self.time[0]:.1f} s at {self.rate_hz:g} Hz, {len(self.gyro_S)} sensors)"

    def recording(self, name: str = "simulated") -> Recording:
        """Return the recording that a user would have, without truth; clock errors stay in the data, as in a file."""
        sensors, stated = {}, None if self.stated_mount is None else compute_mount(*self.stated_mount)
        for segment, gyro_S in self.gyro_S.items():
            lost = ~np.isfinite(gyro_S).all(axis=1)
            measured = bridge(gyro_S, lost, self.time), bridge(self.accel_S[segment], lost, self.time)
            sensors[segment] = ImuSensor(*measured, stated_quat_LS=stated)
        phases = {phase: tuple(spans) for phase, spans in self.phases.items() if spans}
        return Recording(name, self.time, self.rate_hz, sensors, phases).check()

    @property
    def girdles(self) -> dict[str, np.ndarray]:
        """Girdle → (7,) by what the person's shoulders differ from the law of the body's table."""
        # Without `Imperfections.girdle` they do not move; what a person has beside the law is not known. No -0.0.
        return dict.fromkeys(load_table().girdles, (1.0 - min(self.imperfections.girdle, 1.0)) * FIXED + 0.0)

    def truth(self) -> Pose:
        """Return the exact pose, in the W of tracking, whose x is where the torso faces in the start phase."""
        begin, end = self.phases["start"][0]
        start = (self.time >= begin) & (self.time <= end)
        facing = float(heading(Rotation.from_quat(self.quat_WL["torso"][start]).mean().as_quat()))
        turn = Rotation.from_rotvec([0.0, 0.0, -facing])
        return Pose(
            self.time,
            {name: (turn * Rotation.from_quat(quat)).as_quat() for name, quat in self.quat_WL.items()},
            {name: turn.apply(place) for name, place in self.points.items()},
        )


def simulate(
    lengths: Mapping[str, BodyLength],
    *,
    seed: Count,
    rate_hz: Positive = 100.0,
    noise: ImuNoise = MTI_3,
    imperfections: Imperfections = IDEAL_PRESET,
    clasp_s: Annotated[float, Range(5.0, closed=True)] = 60.0,
    circles: Count = 6,
    protocol: str = "clasp",
) -> Simulation:
    """Simulate a person with five sensors in the upper-body experiment of Lisini Baldi et al. 2019; the truth is known.

    5 s static in the N-pose; 2.5 s to the clasp; `clasp_s` of free motion with the palms together while the torso leans
    and twists; 2.5 s in which the right hand goes to a table; then `circles` circles in the air, with rests between.

    Parameters
    ----------
    lengths : length → [m]: ``trunk``, ``shoulder_width``, ``left_upper_arm``, ``left_forearm``, ``left_hand`` and the
        same of the right
    seed : the same seed gives the same numbers. Motion, mounts, noise and each imperfection have random streams of
        their own: noise and rate change neither motion nor mounts
    rate_hz : samples a second
    noise : of gyroscope and accelerometer; by default that of an Xsens MTi-3, `wp.NOISE_FREE` for none
    imperfections : of subject, mounting and sensors; `wp.IDEAL_PRESET` for none, `wp.MILD_PRESET` for a careful
        subject, `wp.PEOPLE_PRESET` for the sizes that the literature reports
    clasp_s : [s] duration of the clasp, at least 5
    circles : number of circles, 0 or more
    protocol : what the person does in the time of the clasp: "clasp", "t_pose", "bow", or several joined by "+"

    Returns
    -------
    Simulation
        `recording()` is the `Recording` that a user would have, `truth()` the true `Pose`. Before the sensor's own
        errors, the product of all exp(gyro_S / rate) is the true orientation exactly; accel_S[k] is
        R_WS[k]ᵀ (p̈ + g e_z), p̈ that of splines through the positions at 200 Hz or more.

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
    missing = [name for name in names if name not in lengths]
    if missing:
        raise BadOption(f"lengths: {', '.join(missing)} is missing; each is needed, in metres")
    parts = protocol.split("+")
    if not set(parts) <= set(PARTS) or len(set(parts)) < len(parts):
        raise BadOption(f"protocol {protocol!r} is not simulated; {one_of(PARTS, protocol)}; or several joined by +")
    flaws = Flaws(imperfections, seed, {name: float(lengths[name]) for name in names})
    return measure_motion(Motion(flaws, parts, clasp_s, circles), rate_hz, noise)


def simulate_activity(
    activity: str,
    *,
    seed: Count,
    rate_hz: Positive = 100.0,
    noise: ImuNoise = MTI_3,
    imperfections: Imperfections = IDEAL_PRESET,
    seconds: Positive = 40.0,
    lengths: Mapping[str, float] | None = None,
) -> Simulation:
    """Simulate an activity with known truth: of the whole body with a sensor on each of 15 segments, or of the arms.

    0 to 5 s static in the N-pose, `seconds` of the activity, 2 s static.

    Parameters
    ----------
    activity : "walk", "sit", "run", "throw" of the whole body, or "tasks" of the arms
    seed, rate_hz, noise : as in `simulate`
    imperfections : as in `simulate`. Activities of the whole body leave sway and wrists out; of soft tissue the legs
        have the random part only, and what people hold in the start pose they hold throughout
    seconds : [s] duration of the activity
    lengths : of the body [m]; those not named, or None: a person of 1.75 m

    Returns
    -------
    Simulation
        As of `simulate`.

    Raises
    ------
    BadOption, BadModel
        No such activity; too short for it; a length that the body does not have.

    Examples
    --------
    >>> wp.simulate_activity("walk", seed=1, seconds=8.0)
    Simulation(15.0 s at 100 Hz, 15 sensors)
    """
    check_arguments(simulate_activity, locals())
    if activity not in ACTIVITIES:
        raise BadOption(f"activity {activity!r} is not known; {one_of(ACTIVITIES, activity)}")
    model = load_model(ACTIVITIES[activity].body, lengths)
    # Shoulders that do not move: those of people that do are placed by their own girdle, not by the one tracked with.
    model = replace(model, girdles=dict.fromkeys(model.table.girdles, FIXED))
    flaws = Flaws(imperfections, seed, model.lengths)
    return measure_motion(ACTIVITIES[activity](model, seconds, flaws), rate_hz, noise)


class _SampledMotion:
    """A motion by splines of fifth order through its poses on a grid: evaluated once for all sensors.

    The grid holds the samples at `rate_hz`. Between them protocols are met to 1e-10 rad, 1e-10 m and 2e-5 m/s^2; what a
    sensor measures is exactly the motion of the splines.
    """

    def __init__(self, motion: BodyMotion, begin: float, end: float, rate_hz: float) -> None:
        grid_hz = rate_hz * np.ceil(_GRID_HZ / rate_hz)
        grid = np.arange(np.floor(begin * grid_hz) - 1.0, np.ceil(end * grid_hz) + 2.0) / grid_hz
        pose, self.moving_time = motion(grid), motion.moving_time
        through = partial(make_interp_spline, grid, k=5)
        self.points = {point: through(place_W) for point, place_W in pose.points.items()}
        self._quat_WL, self._accel_W = {}, {}
        for segment, p_LS in motion.p_LS.items():
            self._quat_WL[segment] = through(unwrap_signs(pose.R_WL[segment].as_quat()))
            self._accel_W[segment] = through(pose.R_WL[segment].apply(p_LS) + pose.origins[segment]).derivative(2)

    def rotate(self, t: np.ndarray, segments: Iterable[str] = SEGMENTS) -> dict[str, Rotation]:
        """Return R_WL of segments at the times `t` (n,) [s]."""
        return {segment: Rotation.from_quat(self._quat_WL[segment](t)) for segment in segments}

    def sample(
        self, segment: str, R_LS: Rotation, tissue: SoftTissue, t: np.ndarray
    ) -> tuple[Rotation, np.ndarray, np.ndarray]:
        """Sample a sensor without errors of its own at the times `t` (n,) [s].

        Return orientations (n) in W, specific force (n, 3) [m/s^2] in S, rotation vectors of tissue (n, 3) [rad] in L.
        """
        accel_W = self._accel_W[segment](t)
        R_WL = self.rotate(t, {*SEGMENTS, segment})
        soft_L = tissue(t, self.moving_time(t, segment), R_WL, R_WL[segment].inv().apply(accel_W))
        R_WS = compose(R_WL[segment], Rotation.from_rotvec(soft_L), R_LS)
        return R_WS, R_WS.inv().apply(accel_W + GRAVITY * E_Z), soft_L


def measure_motion(motion: BodyMotion, rate_hz: float, noise: ImuNoise) -> Simulation:
    """Measure a motion with a sensor on each segment of its `p_LS`."""
    sizes, rngs = motion.flaws.sizes, motion.flaws.rngs
    n = int(np.floor(motion.end * rate_hz)) + 1
    time = np.arange(n) / rate_hz
    N = Rotation.from_matrix([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # x_S to z_L, -z_S to x_L

    own_times = {}
    for segment in motion.p_LS:
        own_time = jitter_time(rngs["clock_jitter"], time, rate_hz, sizes.clock_jitter)
        own_time = own_time + sizes.clock_offset * rngs["clock_offset"].standard_normal()
        own_times[segment] = own_time + 1e-6 * sizes.clock_drift_ppm * rngs["clock_drift"].standard_normal() * time
    # One sample more, before the first one, for the rate that ends there.
    begin = min(0.0, *(own_time[0] for own_time in own_times.values())) - 1.0 / rate_hz
    end = max(time[-1], *(own_time[-1] for own_time in own_times.values()))
    sampled = _SampledMotion(motion, begin, end, rate_hz)
    start = sampled.rotate(np.array([0.5 * STAND_S]))

    sensors: defaultdict[str, dict] = defaultdict(dict)
    for segment, own_time in own_times.items():
        heading, tilt = rngs["strap"].uniform(0.0, 2.0 * np.pi), np.deg2rad(rngs["strap"].uniform(2.0, 10.0))
        R_LS = Rotation.from_rotvec(tilt * np.array((np.cos(heading), np.sin(heading), 0.0))) * N
        any_quat = rngs["mount"].standard_normal(4)  # uniform on the sphere
        if sizes.mount == "any":
            R_LS = Rotation.from_quat(any_quat / np.linalg.norm(any_quat))
        place = -motion.p_LS[segment][2] / motion.lengths.get(segment, 1.0)
        worn = segment, R_LS, SoftTissue(segment, place, sizes, rngs, motion.end, start)
        t = np.insert(own_time, 0, own_time[0] - 1.0 / rate_hz)
        R_WS, force_S, soft_L = sampled.sample(*worn, t)
        rate_S = log(compose(R_WS[:-1].inv(), R_WS[1:]).as_quat()) / np.diff(t)[:, None]
        force_S = force_S[1:]
        if sizes.accel_average:
            ages = sizes.accel_average / rate_hz * _MIDPOINTS
            force_S = np.mean([sampled.sample(*worn, own_time - age)[1] for age in ages], axis=0)

        device = Device(rngs["device"], sizes, rngs["gyro_warm_up"])
        readings = device.measure(rate_S, force_S, rate_hz, noise, rngs["noise"])
        dropped = draw_lost(rngs["dropped"], n, rate_hz, sizes.dropped)
        readings["gyro_S"][dropped] = readings["accel_S"][dropped] = np.nan
        own = {"quat_LS": R_LS.as_quat(), "quat_WS": R_WS[1:].as_quat(), "soft_tissue": soft_L[1:]}
        for name, value in {**own, **readings, "device": device, "sample_time": own_time}.items():
            sensors[name][segment] = value

    return Simulation(
        time=time,
        rate_hz=rate_hz,
        quat_WL={segment: R.as_quat() for segment, R in sampled.rotate(time, motion.p_LS).items()},
        points={point: place_W(time) for point, place_W in sampled.points.items()},
        p_LS=dict(motion.p_LS),
        stated_mount=_MOUNT if sizes.mount == "stated" else None,
        lengths=dict(motion.lengths),
        phases=motion.phases,
        imperfections=sizes,
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
    """Draw a person of the population, with shoulder width and trunk as a user would measure them.

    Parameters
    ----------
    seed : the same seed gives the same person
    measured_std : [m] error of both measurements: by default that of a careful measurement between the joint centres
        themselves. Nobody can reach them: `PEOPLE_MEASURED_STD` is the error of 0.83 times the biacromial breadth
    body : the body whose lengths are drawn: "upper_body" or "whole_body"

    Returns
    -------
    Person
        Its `lengths` are those that `simulate` takes, its `prior` is a subject of that stature and sex.

    Raises
    ------
    BadModel
        No such body.

    Examples
    --------
    >>> person = wp.simulate_person(3)
    >>> simulation = wp.simulate(person.lengths, seed=3, imperfections=wp.MILD_PRESET, clasp_s=10.0)
    """
    rng = np.random.default_rng([seed, 7])
    sex = SEXES[int(rng.integers(2))]
    mean, std = {"f": (1.63, 0.064), "m": (1.756, 0.069)}[sex]  # [m], ANSUR II (Gordon et al. 2014)
    stature = float(np.clip(rng.normal(mean, std), 1.45, 2.0))
    table = load_table(body)
    prior = population_subject(round(stature, 2), sex, table)
    people = population_subject(stature, sex, table)
    usual = np.array(list(people.lengths.values()))
    drawn = np.clip(rng.multivariate_normal(usual, people.lengths_covariance()), 0.7 * usual, 1.3 * usual)
    lengths = dict(zip(people.lengths, drawn.tolist(), strict=True))
    measured = {name: lengths[name] + float(rng.normal(0.0, measured_std)) for name in MEASURED_LENGTHS}
    return Person(lengths, stature, sex, measured, measured_std, prior)
