"""A subject with known truth and the IMU data that its motion gives.

The motion is a closed form of continuous time, so that it is known exactly between the samples as well, and
it shares no code with the model room: what the tests compare against is written here and nowhere else. Frames
as everywhere: W is z up, x forward, y left, origin at the root of the trunk; each segment frame equals W in
the N-pose; the arm runs along -z. The torso frame T shares its origin with W: the torso turns about it.

A perfect world: no soft tissue, an exact N-pose, palms that coincide in the clasp, a hand still at rest.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from .pose import Pose
from .recording import Recording, Sensor, check, mount_from_axes
from .subject import LENGTHS, SEXES, Subject, average_subject

GRAVITY = 9.81  # [m/s^2]
SIDES = {"left": 1.0, "right": -1.0}  # y of the side in W
SEGMENTS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
ARM = ("upper_arm", "forearm", "hand")
MOUNT = ("+x", "-z")  # sensor axes that point up and forward, but for the tilt of the strap

_E_Z = np.array((0.0, 0.0, 1.0))
_STAND_S = 5.0  # N-pose at the start
_BLEND_S = 2.5  # N-pose to clasp, clasp to table
_RAMP_S = 2.0  # the clasp motion grows and dies away over this time
_REST_S = (2.5, 2.0)  # first rest on the table, each later one
_LIFT_S = 1.5  # table to circle, circle to table
_MARGIN_S = 0.1  # the stated phases keep this distance from the motion beside them
_FLEXION = np.deg2rad((8.0, 140.0))  # of the elbow while the hand is led to a point
_STENCIL_S = 1e-3  # for p_ddot: truncation and rounding together stay below 1e-6 m/s^2


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an IMU; the defaults are those of the Xsens MTi-3.

    Densities and in-run stabilities: MTi 1-series data sheet (0.007 deg/s/sqrt(Hz), 10 deg/h; 120
    ug/sqrt(Hz), 0.03 mg). It gives no turn-on bias that is comparable: 0.2 deg/s and 3 mg are assumptions.

    White noise has the standard deviation density * sqrt(rate) at each sample, the convention of angle and
    velocity random walk. The bias is the turn-on bias, constant over the recording, plus a first-order
    Gauss-Markov process whose standard deviation is the in-run stability and whose correlation time is an
    assumption as well.
    """

    gyro_density: float = np.deg2rad(0.007)  # [rad/s/sqrt(Hz)]
    gyro_bias_std: float = np.deg2rad(0.2)  # [rad/s], turn-on, each axis
    gyro_bias_instability: float = np.deg2rad(10.0) / 3600.0  # [rad/s]
    accel_density: float = 120e-6 * GRAVITY  # [m/s^2/sqrt(Hz)]
    accel_bias_std: float = 3e-3 * GRAVITY  # [m/s^2], turn-on, each axis
    accel_bias_instability: float = 0.03e-3 * GRAVITY  # [m/s^2]
    correlation_s: float = 100.0  # [s], of the in-run biases


MTI_3 = ImuNoise()
PERFECT = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Simulation:
    """What `simulate` gives: exact motion, IMU data, and what the session file would state.

    `quat_LS` is R_LS = Swing @ N, where N takes the axes of `stated_mount` to z (up) and x (forward) of the
    segment and Swing turns by 2 to 10 deg about a horizontal axis. So the stated axes and gravity measured in
    the start pose give the mount exactly: Swing is the least rotation from N @ (up in S) to e_z.
    """

    time: np.ndarray  # (n,) [s], from 0
    rate_hz: float
    quat_WL: dict[str, np.ndarray]  # segment -> (n, 4) xyzw, exact
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W, exact
    gyro_S: dict[str, np.ndarray]  # sensor (named by its segment) -> (n, 3) [rad/s], over (k-1, k]
    accel_S: dict[str, np.ndarray]  # sensor -> (n, 3) [m/s^2], specific force at time[k]
    quat_LS: dict[str, np.ndarray]  # sensor -> (4,) xyzw, exact mount, sensor to segment
    p_LS: dict[str, np.ndarray]  # sensor -> (3,) [m] in L, from hips, shoulder or elbow to the sensor
    stated_mount: dict[str, tuple[str, str]]  # sensor -> its axes that point up, forward in the start pose
    gyro_bias: dict[str, np.ndarray]  # sensor -> (n, 3) [rad/s], exact
    accel_bias: dict[str, np.ndarray]  # sensor -> (n, 3) [m/s^2], exact
    lengths: dict[str, float]  # [m]
    phases: dict[str, list[tuple[float, float]]]
    """[s]. "start": still in the N-pose; "clasp": palms together; "circles": first lift off the table to last
    return; "rest": each rest of the right hand on the table, all sensors still."""

    def recording(self, name: str = "simulated") -> Recording:
        """What a user would have recorded of it: sensors, stated mounts and phases, no truth."""
        sensors = {
            segment: Sensor(
                gyro_S=self.gyro_S[segment],
                accel_S=self.accel_S[segment],
                stated_quat_LS=mount_from_axes(*self.stated_mount[segment]),
            )
            for segment in self.gyro_S
        }
        phases = {phase: tuple(spans) for phase, spans in self.phases.items() if spans}
        return check(Recording(name, self.time, self.rate_hz, sensors, phases))

    def truth(self) -> Pose:
        """The exact pose."""
        return Pose(self.time, self.quat_WL, self.points)


class _Pose(NamedTuple):
    """Exact motion at n times."""

    R_WL: dict[str, Rotation]  # segment -> n rotations
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W


def _step(t: np.ndarray, start: float, duration: float) -> np.ndarray:
    """0 before `start`, 1 after `start + duration`, four derivatives continuous: (n,)."""
    x = np.clip((t - start) / duration, 0.0, 1.0)
    return x**5 * (126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + x * 70.0))))


def _pulse(t: np.ndarray, start: float, stop: float, ramp: float) -> np.ndarray:
    """1 between `start + ramp` and `stop - ramp`, exactly 0 outside `start` and `stop`: (n,)."""
    return _step(t, start, ramp) * (1.0 - _step(t, stop - ramp, ramp))


class _Wander:
    """A smooth wandering between -1 and 1: four sinusoids of 0.1 to 0.6 Hz, pressed to the limits by tanh."""

    def __init__(self, rng: np.random.Generator) -> None:
        # One frequency from each part of the band: no seed gives a motion without slow or without fast parts.
        self.frequency_hz = np.array((0.1, 0.2, 0.33, 0.46)) + rng.uniform(0.0, 0.13, 4)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 4)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        total = np.zeros_like(t)
        for frequency_hz, phase in zip(self.frequency_hz, self.phase, strict=True):
            total += np.sin(2.0 * np.pi * frequency_hz * t + phase) / np.sqrt(10.0 * frequency_hz)
        return np.tanh(0.9 * total)


@dataclass(frozen=True)
class _Circle:
    """One circle of the right hand, drawn between two rests on the table."""

    start: float  # [s] lift off the table
    duration: float  # [s] of the turn itself
    centre_W: np.ndarray  # (3,) [m]
    axes_W: np.ndarray  # (2, 3) [m], orthogonal, as long as the radius
    sense: float  # +1 or -1

    @property
    def stop(self) -> float:
        """When the hand is back on the table [s]."""
        return self.start + self.duration + 2.0 * _LIFT_S - 1.0  # turn, lift and return overlap by 0.5 s each

    def offset_W(self, t: np.ndarray, table_W: np.ndarray) -> np.ndarray:
        """From the table point to the hand: (n, 3) [m]."""
        angle = 2.0 * np.pi * self.sense * _step(t, self.start + _LIFT_S - 0.5, self.duration)
        circle_W = self.centre_W + np.cos(angle)[:, None] * self.axes_W[0] + np.sin(angle)[:, None] * self.axes_W[1]
        return _pulse(t, self.start, self.stop, _LIFT_S)[:, None] * (circle_W - table_W)


class _Motion:
    """The subject's motion as a function of continuous time."""

    def __init__(self, lengths: Mapping[str, float], rng: np.random.Generator, clasp_s: float, circles: int) -> None:
        self.lengths = lengths
        self.half_width = 0.5 * lengths["shoulder_width"]
        self.arm = {s: (lengths[f"{s}_upper_arm"], lengths[f"{s}_forearm"] + lengths[f"{s}_hand"]) for s in SIDES}
        self.reach = min(sum(arm) for arm in self.arm.values())
        self.clasp = (_STAND_S + _BLEND_S, _STAND_S + _BLEND_S + clasp_s)
        names = ("azimuth", "elevation", "radius", "roll", "pitch", "yaw")
        arm_names = (f"{side}_{angle}" for side in SIDES for angle in ("swivel", "pronation"))
        self.wander = {name: _Wander(rng) for name in (*names, *arm_names)}
        # In units of the reach, from the right shoulder: table above the hips, circles before the chest.
        shoulder_W = np.array((0.0, -self.half_width, lengths["trunk"]))
        self.table_W = shoulder_W + self.reach * np.array((0.52, 0.03, -0.6))
        t = self.clasp[1] + _BLEND_S
        self.rest = [(t, t + _REST_S[0])]
        self.circles: list[_Circle] = []
        for _ in range(circles):
            centre_W = shoulder_W + self.reach * (
                np.array((0.62, 0.03, 0.0)) + rng.uniform(-1, 1, 3) * (0.03, 0.1, 0.12)
            )
            radius = self.reach * rng.uniform(0.2, 0.31)
            tilt, turn, first = rng.uniform(-1.0, 1.0, 3) * np.array((0.5, 0.5, np.pi))  # mostly frontal
            plane = Rotation.from_euler("ZYX", [turn, tilt, first])
            axes_W = radius * plane.apply([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            circle = _Circle(self.rest[-1][1], rng.uniform(3.0, 4.0), centre_W, axes_W, rng.choice((-1.0, 1.0)))
            self.circles.append(circle)
            self.rest.append((circle.stop, circle.stop + _REST_S[1]))

    def _clasp_point(self, t: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """Where the palms meet, from midway between the shoulders in T: (n, 3) [m], in reach of both arms."""
        azimuth = np.deg2rad(38.0) * moving * self.wander["azimuth"](t)
        elevation = np.deg2rad(-4.0 + 46.0 * moving * self.wander["elevation"](t))
        fraction = 0.5 + 0.5 * moving * self.wander["radius"](t)
        ray = np.column_stack(
            (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
        )
        # Shoulder to palm at the limits of the elbow, for the arm that is nearer to them.
        span = np.array(
            [[np.sqrt(a * a + b * b + 2 * a * b * np.cos(f)) for f in _FLEXION] for a, b in self.arm.values()]
        )
        longest, shortest = span[:, 0].min(), span[:, 1].max()
        # The far shoulder limits the radius from above, the near one from below; the smooth |y| is safe.
        side = self.half_width * np.sqrt(ray[:, 1] ** 2 + 0.01)
        upper = np.sqrt(side**2 + longest**2 - self.half_width**2) - side
        lower = np.sqrt(side**2 + max(shortest**2 - self.half_width**2, 0.0)) + side
        chest = 0.3 * self.reach / ray[:, 0]  # hands stay before the chest
        lower = (lower**8 + chest**8) ** 0.125  # a smooth maximum
        return (lower + fraction * (upper - lower))[:, None] * ray

    def _arm(self, side: str, palm_T: np.ndarray, swivel: np.ndarray) -> tuple[Rotation, np.ndarray]:
        """Upper arm in T and elbow flexion [rad] to bring the palm to `palm_T` (n, 3) [m], from the shoulder.

        `swivel` (n,) [rad] turns the elbow about the line from shoulder to palm, from below outwards. The
        elbow is a hinge: the forearm is the upper arm turned by flexion about -y, then by pronation about its
        own z.
        """
        upper, lower = self.arm[side]
        distance = np.linalg.norm(palm_T, axis=1)
        cos_flexion = (distance**2 - upper**2 - lower**2) / (2.0 * upper * lower)
        if not np.all(np.abs(cos_flexion) < np.cos(np.deg2rad(3.0))):
            raise ValueError(
                f"lengths: the {side} arm ({upper:.3f} m + {lower:.3f} m) does not reach through the motion"
            )
        flexion = np.arccos(cos_flexion)
        cos_alpha = (upper + lower * cos_flexion) / distance  # between upper arm and line to the palm
        sin_alpha = lower * np.sin(flexion) / distance
        n = palm_T / distance[:, None]
        down = np.array((0.0, 0.0, -1.0)) + n[:, 2:] * n  # e_down less its part along n
        down /= np.linalg.norm(down, axis=1)[:, None]
        m = np.cos(swivel)[:, None] * down + SIDES[side] * np.sin(swivel)[:, None] * np.cross(n, down)
        u = cos_alpha[:, None] * n + sin_alpha[:, None] * m  # shoulder to elbow
        x = sin_alpha[:, None] * n - cos_alpha[:, None] * m  # into which the forearm flexes
        return Rotation.from_matrix(np.stack((x, np.cross(n, m), -u), axis=2)), flexion

    def __call__(self, t: np.ndarray) -> _Pose:
        """The pose at the times `t` (n,) [s], exact."""
        moving = _pulse(t, *self.clasp, _RAMP_S)  # 0 at both ends of the clasp
        circling = sum((_pulse(t, c.start, c.stop, _LIFT_S) for c in self.circles), np.zeros_like(t))
        led = _step(t, _STAND_S, _BLEND_S)  # from the N-pose to the clasp
        table = _step(t, self.clasp[1], _BLEND_S)  # from the clasp to the table

        lean = np.column_stack([self.wander[name](t) for name in ("yaw", "pitch", "roll")])
        lean *= np.deg2rad(15.0 * moving[:, None] + circling[:, None] * np.array((5.0, 3.0, 3.0)))
        R_WT = Rotation.from_euler("ZYX", lean)
        clasp_T = self._clasp_point(t, moving) + self.lengths["trunk"] * _E_Z
        hand_W = self.table_W + sum((c.offset_W(t, self.table_W) for c in self.circles), np.zeros((len(t), 3)))
        palm_T = {
            "left": clasp_T,
            "right": clasp_T + table[:, None] * (R_WT.inv().apply(hand_W) - clasp_T),
        }
        led_by = {"left": led * (1.0 - table), "right": led}  # the left arm goes back to hang
        palm_down = {"left": 0.0 * t, "right": np.deg2rad(40.0) * table}

        R_WL, points = {"torso": R_WT}, {}
        for side, y in SIDES.items():
            blend = led_by[side]
            shoulder_T = np.array((0.0, y * self.half_width, self.lengths["trunk"]))
            swivel = np.deg2rad(35.0 + 30.0 * (moving + 0.3 * circling) * self.wander[f"{side}_swivel"](t))
            R_TU, flexion = self._arm(side, palm_T[side] - shoulder_T, swivel)
            wander = np.deg2rad(55.0 * moving + 15.0 * circling) * self.wander[f"{side}_pronation"](t)
            bend = np.column_stack((-blend * flexion, blend * (wander + palm_down[side])))
            R_WU = R_WT * Rotation.from_rotvec(blend[:, None] * R_TU.as_rotvec())
            R_WF = R_WU * Rotation.from_euler("YZ", bend)  # a hinge about -y, then pronation
            R_WL[f"{side}_upper_arm"], R_WL[f"{side}_forearm"] = R_WU, R_WF
            p_W = R_WT.apply(shoulder_T)
            points[f"{side}_shoulder"] = p_W
            for part, end, R_WL_part in (
                ("upper_arm", "elbow", R_WU),
                ("forearm", "wrist", R_WF),
                ("hand", "hand", R_WF),
            ):
                p_W = p_W + R_WL_part.apply((0.0, 0.0, -self.lengths[f"{side}_{part}"]))
                points[f"{side}_{end}"] = p_W
        return _Pose(R_WL, points)


def _sensor_places(lengths: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Where each sensor sits in L [m]: on the sternum, half-way along the outer side of the arm segments."""
    places = {"torso": np.array((0.11, 0.0, 0.8 * lengths["trunk"]))}
    for side, y in SIDES.items():
        places[f"{side}_upper_arm"] = np.array((0.0, 0.045 * y, -0.5 * lengths[f"{side}_upper_arm"]))
        places[f"{side}_forearm"] = np.array((0.01, 0.03 * y, -0.5 * lengths[f"{side}_forearm"]))
    return places


def _sensor_position(pose: _Pose, segment: str, p_LS: np.ndarray) -> np.ndarray:
    """The sensor's place in W: (n, 3) [m]."""
    p_W = pose.R_WL[segment].apply(p_LS)
    if segment == "torso":
        return p_W
    side, part = segment.split("_", 1)
    return p_W + pose.points[f"{side}_shoulder" if part == "upper_arm" else f"{side}_elbow"]


def _bias(rng: np.random.Generator, shape: tuple[int, int], turn_on: float, in_run: float, decay: float) -> np.ndarray:
    """Turn-on bias plus Gauss-Markov process of standard deviation `in_run`, which keeps `decay` a sample."""
    white = rng.standard_normal(shape) * np.sqrt(1.0 - decay**2)
    white[0] /= np.sqrt(1.0 - decay**2)  # stationary from the first sample
    return turn_on * rng.standard_normal(shape[1]) + in_run * lfilter([1.0], [1.0, -decay], white, axis=0)


def simulate(
    lengths: Mapping[str, float],
    *,
    seed: int,
    rate_hz: float = 100.0,
    noise: ImuNoise = MTI_3,
    clasp_s: float = 60.0,
    circles: int = 6,
) -> Simulation:
    """A recording of the paper's upper-body experiment with known truth.

    0 to 5 s still in the N-pose; 2.5 s to the clasp; `clasp_s` of free motion with the palms together while
    the torso leans and twists; 2.5 s in which the left arm returns to hang and the right hand goes to a
    table; then `circles` circles in the air (Lisini Baldi 2019, upper-body experiment), a rest on the table
    before and after each.

    Parameters
    ----------
    lengths : segment lengths [m]: trunk, shoulder_width, and upper_arm, forearm, hand of left_ and right_.
    seed : the same seed gives the same bits. Motion, mounts and noise draw from streams of their own: noise
        and rate change neither motion nor mounts, and twice the density is the same noise twice as large.
    rate_hz : samples a second.
    noise : of gyroscope and accelerometer; `PERFECT` for none.
    clasp_s : how long the palms stay together [s], at least 5.
    circles : how many circles, 0 or more.

    Returns
    -------
    Simulation
        gyro_S[k] is log(R_WS[k-1]^T R_WS[k]) * rate, so that multiplying up exp(gyro_S / rate) gives the
        orientation back exactly; accel_S[k] is R_WS[k]^T (p_ddot + g e_z), p_ddot by central differences.

    Raises
    ------
    ValueError
        A length is missing or not positive, the arms cannot do the motion, or a parameter is out of range.
    """
    wrong = {name: lengths.get(name) for name in LENGTHS if not 0.0 < lengths.get(name, 0.0) < np.inf}
    if wrong:
        raise ValueError(f"lengths: must be given in metres and above 0: {wrong}")
    if not (clasp_s >= 5.0 and circles >= 0 and rate_hz > 0.0):
        raise ValueError(f"clasp_s {clasp_s} must be >= 5, circles {circles} >= 0, rate_hz {rate_hz} > 0")
    lengths = {name: float(lengths[name]) for name in LENGTHS}
    motion_rng, mount_rng, noise_rng = np.random.default_rng(seed).spawn(3)
    motion = _Motion(lengths, motion_rng, clasp_s, circles)
    n = int(np.floor(motion.rest[-1][1] * rate_hz)) + 1
    time = np.arange(n) / rate_hz
    pose = motion(time)
    beside = [motion(time + k * _STENCIL_S) for k in (-2, -1, 1, 2)]

    p_LS = _sensor_places(lengths)
    N = Rotation.from_matrix([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # x_S to z_L, -z_S to x_L
    decay = np.exp(-1.0 / (noise.correlation_s * rate_hz))
    quat_WL: dict[str, np.ndarray] = {}
    quat_LS: dict[str, np.ndarray] = {}
    gyro_S: dict[str, np.ndarray] = {}
    accel_S: dict[str, np.ndarray] = {}
    gyro_bias: dict[str, np.ndarray] = {}
    accel_bias: dict[str, np.ndarray] = {}
    for segment in SEGMENTS:
        heading, tilt = mount_rng.uniform(0.0, 2.0 * np.pi), np.deg2rad(mount_rng.uniform(2.0, 10.0))
        R_LS = Rotation.from_rotvec(tilt * np.array((np.cos(heading), np.sin(heading), 0.0))) * N
        R_WS = pose.R_WL[segment] * R_LS
        rotvec = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec()
        # Differences to the middle first: where nothing moves they are exactly zero.
        p_W = _sensor_position(pose, segment, p_LS[segment])
        far, near, near_after, far_after = (_sensor_position(b, segment, p_LS[segment]) - p_W for b in beside)
        p_ddot = (16.0 * (near + near_after) - (far + far_after)) / (12.0 * _STENCIL_S**2)

        gyro_bias[segment] = _bias(noise_rng, (n, 3), noise.gyro_bias_std, noise.gyro_bias_instability, decay)
        accel_bias[segment] = _bias(noise_rng, (n, 3), noise.accel_bias_std, noise.accel_bias_instability, decay)
        white = noise_rng.standard_normal((2, n, 3)) * np.sqrt(rate_hz)
        rate_S = np.vstack((np.zeros(3), rotvec * rate_hz))  # still before the first sample
        force_S = R_WS.inv().apply(p_ddot + GRAVITY * _E_Z)
        gyro_S[segment] = rate_S + gyro_bias[segment] + noise.gyro_density * white[0]
        accel_S[segment] = force_S + accel_bias[segment] + noise.accel_density * white[1]
        quat_WL[segment], quat_LS[segment] = pose.R_WL[segment].as_quat(), R_LS.as_quat()

    phases = {
        "start": [(0.5, _STAND_S - 0.5)],
        "clasp": [(motion.clasp[0] + _MARGIN_S, motion.clasp[1] - _MARGIN_S)],
        "circles": [(motion.circles[0].start, motion.circles[-1].stop)] if motion.circles else [],
        "rest": [(a + _MARGIN_S, b - _MARGIN_S) for a, b in motion.rest],
    }
    return Simulation(
        time=time,
        rate_hz=rate_hz,
        quat_WL=quat_WL,
        points=pose.points,
        gyro_S=gyro_S,
        accel_S=accel_S,
        quat_LS=quat_LS,
        p_LS=p_LS,
        stated_mount=dict.fromkeys(SEGMENTS, MOUNT),
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        lengths=lengths,
        phases=phases,
    )


class Person(NamedTuple):
    """A random person, and what a user with a tape would know of them."""

    lengths: dict[str, float]  # [m], true
    stature: float  # [m]
    sex: str  # "f" or "m"
    taped: dict[str, float]  # [m], measured lengths, each off by a draw of `taped_std`
    taped_std: float  # [m]
    average: Subject  # the average person of that stature and sex


def simulated_person(seed: int, taped_std: float = 0.003) -> Person:
    """A person drawn from the anthropometric distribution; the shoulder width is taped."""
    rng = np.random.default_rng([seed, 7])
    sex = SEXES[int(rng.integers(2))]
    mean, std = {"f": (1.63, 0.064), "m": (1.756, 0.069)}[sex]  # [m], ANSUR II (Gordon et al. 2014)
    stature = float(np.clip(rng.normal(mean, std), 1.45, 2.0))
    average = average_subject(round(stature, 2), sex)
    lengths = dict(average_subject(stature, sex).draw(rng).lengths)
    taped = {"shoulder_width": lengths["shoulder_width"] + float(rng.normal(0.0, taped_std))}
    return Person(lengths, stature, sex, taped, taped_std, average)
