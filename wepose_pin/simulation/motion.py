"""The motion of a protocol: a closed form of continuous time.

It is exact between the samples as well, and shares no code with the model room, since tests compare the two. The torso
frame T has the origin of W: the torso rotates about it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadOption
from .imperfections import Imperfections

SIDES = {"left": 1.0, "right": -1.0}  # y of the side in W
CIRCLING_POINT = "right_palm"  # draws the circles after the protocol
SEGMENTS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
ARM = ("upper_arm", "forearm", "hand")

E_Z = np.array((0.0, 0.0, 1.0))
STAND_S = 5.0  # N-pose at the start
_BLEND_S = 2.5  # N-pose to clasp, clasp to table
_RAMP_S = 2.0  # the clasp motion grows and dies away over this time
_REST_S = (2.5, 2.0)  # first rest on the table, each later one
_LIFT_S = 1.5  # table to circle, circle to table
MARGIN_S = 0.1  # the stated phases keep this distance from the motion beside them
_FLEXION = np.deg2rad((8.0, 140.0))  # of the elbow while the hand is led to a point


class BodyPose(NamedTuple):
    """Exact motion at n times."""

    R_WL: dict[str, Rotation]  # segment -> n rotations
    points: dict[str, np.ndarray]  # point -> (n, 3) [m] in W
    origins: dict[str, np.ndarray]  # segment -> (n, 3) [m] in W, or (3,) where it does not move


class BodyMotion(ABC):
    """A body's motion as a function of continuous time, and where its sensors sit.

    Attributes
    ----------
    lengths : of the body [m]
    p_LS : segment → (3,) [m] in L, of its sensor
    """

    lengths: Mapping[str, float]
    p_LS: Mapping[str, np.ndarray]

    @property
    @abstractmethod
    def span(self) -> tuple[float, float]:
        """The times [s] at which the free motion begins and the recording ends."""

    @abstractmethod
    def __call__(self, t: np.ndarray, segments: Collection[str]) -> BodyPose:
        """Return the exact pose at the times `t` (n,) [s], of these segments at least."""

    @abstractmethod
    def activity(self, t: np.ndarray) -> np.ndarray:
        """Return the activity (n,): 1 in free motion, 0 where the segments are static."""

    @abstractmethod
    def phases(self) -> dict[str, list[tuple[float, float]]]:
        """Return the phases of the recording: phase → intervals [s]."""


def make_step(t: np.ndarray, start: float, duration: float) -> np.ndarray:
    """Make a step (n,): 0 before `start`, 1 after `start + duration`, with four continuous derivatives."""
    x = np.clip((t - start) / duration, 0.0, 1.0)
    return x**5 * (126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + x * 70.0))))


def make_pulse(t: np.ndarray, start: float, stop: float, ramp: float) -> np.ndarray:
    """Make a pulse (n,): 1 between `start + ramp` and `stop - ramp`, exactly 0 outside `start` and `stop`."""
    return make_step(t, start, ramp) * (1.0 - make_step(t, stop - ramp, ramp))


class Wander:
    """A smooth random signal between -1 and 1: four sinusoids of 0.1 to 0.6 Hz, limited by tanh."""

    def __init__(self, rng: np.random.Generator) -> None:
        # One frequency from each part of the band: every seed gives slow and fast parts.
        self.frequency_hz = np.array((0.1, 0.2, 0.33, 0.46)) + rng.uniform(0.0, 0.13, 4)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 4)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        total = np.zeros_like(t)
        for frequency_hz, phase in zip(self.frequency_hz, self.phase, strict=True):
            total += np.sin(2.0 * np.pi * frequency_hz * t + phase) / np.sqrt(10.0 * frequency_hz)
        return np.tanh(0.9 * total)


class Sway:
    """A slow sway about x and y: three sinusoids of 0.3 to 0.5 Hz each, with a total rms rate of 1 rad/s."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.omega = 2.0 * np.pi * (np.array((0.3, 0.37, 0.44)) + rng.uniform(0.0, 0.06, (2, 3)))  # [rad/s]
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Angles (n, 2) [rad]."""
        waves = np.sin(self.omega * t[:, None, None] + self.phase) / self.omega
        return waves.sum(axis=2) / np.sqrt(3.0)  # each wave has the mean square 1/2, there are six


class Flaws:
    """Random imperfections of the subject's motion; the sizes scale draws that do not depend on them."""

    def __init__(self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator]) -> None:
        self.sizes = sizes
        self.slip = [Wander(rngs["palm_slip"]) for _ in range(3)]
        self.shoulder = {}  # side -> (3,) [m] in T at 90 deg of elevation
        for side, y in SIDES.items():
            direction = np.array((-0.3, -0.4 * y, 1.0)) + 0.3 * rngs["shoulder_wander"].standard_normal(3)
            self.shoulder[side] = sizes.shoulder_wander * direction / np.linalg.norm(direction)
        bend = 1.0 + 0.2 * np.clip(rngs["start_elbow"].standard_normal(2), -2.5, 2.5)
        self.elbow = dict(zip(SIDES, np.deg2rad(sizes.start_elbow_deg) * bend, strict=True))  # [rad]
        turn = np.deg2rad(sizes.start_segment_deg) / np.sqrt(3.0)
        self.start = {name: turn * rngs["start_segment"].standard_normal(3) for name in SEGMENTS[1:]}  # (3,) [rad]
        self.sway = {name: Sway(rngs["sway"]) for name in ("torso", *SIDES)}
        # The arms need slack for palm slip and shoulder motion.
        self.slack = max(0.012, sizes.palm_slip + sizes.shoulder_wander) if self.stretches else 0.0

    @property
    def stretches(self) -> bool:
        """True where palms or shoulders deviate from the ideal motion."""
        return self.sizes.palm_slip > 0.0 or self.sizes.shoulder_wander > 0.0


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
        """Time [s] at which the hand is back on the table."""
        return self.start + self.duration + 2.0 * _LIFT_S - 1.0  # turn, lift and return overlap by 0.5 s each

    def offset_W(self, t: np.ndarray, table_W: np.ndarray) -> np.ndarray:
        """Return the vector from the table point to the hand (n, 3) [m]."""
        angle = 2.0 * np.pi * self.sense * make_step(t, self.start + _LIFT_S - 0.5, self.duration)
        circle_W = self.centre_W + np.cos(angle)[:, None] * self.axes_W[0] + np.sin(angle)[:, None] * self.axes_W[1]
        return make_pulse(t, self.start, self.stop, _LIFT_S)[:, None] * (circle_W - table_W)


class Motion(BodyMotion):
    """The motion of a protocol, with torso and arms; `tasks` holds those of other protocols than the clasp."""

    phase = "clasp"
    lean_deg: float | np.ndarray = 15.0  # yaw, pitch, roll of the torso in the clasp

    def prepare(self, rng: np.random.Generator, pose_deg: float) -> None:
        """Draw what a protocol needs beyond the clasp; `pose_deg` is the error of poses about each axis."""

    def protocol_phases(self) -> dict[str, list[tuple[float, float]]]:
        """Return the phases between start and circles: phase → intervals [s]."""
        return {self.phase: [(self.clasp[0] + MARGIN_S, self.clasp[1] - MARGIN_S)]}

    def phases(self) -> dict[str, list[tuple[float, float]]]:
        return {
            "start": [(0.5, STAND_S - 0.5)],
            **self.protocol_phases(),
            "circles": [(self.circles[0].start, self.circles[-1].stop)] if self.circles else [],
            "rest": [(a + MARGIN_S, b - MARGIN_S) for a, b in self.rest],
        }

    @property
    def span(self) -> tuple[float, float]:
        return self.clasp[0], self.rest[-1][1]

    def __init__(
        self, lengths: Mapping[str, float], rng: np.random.Generator, clasp_s: float, circles: int, flaws: Flaws
    ) -> None:
        self.flaws = flaws
        self.lengths = lengths
        self.p_LS = place_sensors(lengths)
        self.half_width = 0.5 * lengths["shoulder_width"]
        self.arm = {s: (lengths[f"{s}_upper_arm"], lengths[f"{s}_forearm"] + lengths[f"{s}_hand"]) for s in SIDES}
        self.reach = min(sum(arm) for arm in self.arm.values())
        self.clasp = (STAND_S + _BLEND_S, STAND_S + _BLEND_S + clasp_s)
        names = ("azimuth", "elevation", "radius", "roll", "pitch", "yaw")
        arm_names = (f"{side}_{angle}" for side in SIDES for angle in ("swivel", "pronation"))
        self.wander = {name: Wander(rng) for name in (*names, *arm_names)}
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
        # The slip's gains [m]: the stated rms on each axis over the clasp, whatever the sampling rate.
        grid = np.arange(*self.clasp, 0.05)
        gate = make_pulse(grid, *self.clasp, _RAMP_S)
        rms = np.array([np.sqrt(np.mean((gate * wander(grid)) ** 2)) for wander in flaws.slip])
        self.slip_gain = flaws.sizes.palm_slip / np.sqrt(3.0) / rms

    def activity(self, t: np.ndarray) -> np.ndarray:
        moving = make_pulse(t, *self.clasp, _RAMP_S)
        return moving + sum((make_pulse(t, c.start, c.stop, _LIFT_S) for c in self.circles), np.zeros_like(t))

    def _clasp_point(self, t: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """Return the point where the palms meet (n, 3) [m] in T, from midway between the shoulders, in reach."""
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
        longest, shortest = span[:, 0].min() - self.flaws.slack, span[:, 1].max()
        # The far shoulder limits the radius from above, the near one from below; the smooth |y| is safe.
        side = self.half_width * np.sqrt(ray[:, 1] ** 2 + 0.01)
        upper = np.sqrt(side**2 + longest**2 - self.half_width**2) - side
        lower = np.sqrt(side**2 + max(shortest**2 - self.half_width**2, 0.0)) + side
        chest = 0.3 * self.reach / ray[:, 0]  # hands stay in front of the chest
        lower = (lower**8 + chest**8) ** 0.125  # a smooth maximum
        return (lower + fraction * (upper - lower))[:, None] * ray

    def _motion_share(self, t: np.ndarray) -> np.ndarray:
        return make_pulse(t, *self.clasp, _RAMP_S)  # 0 at both ends of the clasp

    def _torso(self, _t: np.ndarray, lean: np.ndarray) -> Rotation:
        """Return R_WT from `lean` (n, 3) [rad]: yaw, pitch, roll."""
        return Rotation.from_euler("ZYX", lean)

    def _palms(
        self, _t: np.ndarray, _motion_share: np.ndarray, clasp_T: np.ndarray, _R_WT: Rotation
    ) -> dict[str, np.ndarray]:
        """Return the position (n, 3) [m] in T of each palm before the right one moves to the table."""
        return {"left": clasp_T, "right": clasp_T}

    def _lead_share(self, _t: np.ndarray, led: np.ndarray, table: np.ndarray) -> dict[str, np.ndarray]:
        """Return the share (n,) by which each palm leads its arm; 0: the arm hangs."""
        return {"left": led * (1.0 - table), "right": led}  # the left arm returns to hanging

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
            raise BadOption(
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

    def __call__(self, t: np.ndarray, segments: Collection[str] = SEGMENTS) -> BodyPose:
        """Return the exact pose of the torso and of the arms of the segments' sides at the times `t` (n,) [s]."""
        moving = self._motion_share(t)
        circling = sum((make_pulse(t, c.start, c.stop, _LIFT_S) for c in self.circles), np.zeros_like(t))
        led = make_step(t, STAND_S, _BLEND_S)  # from the N-pose to the clasp
        table = make_step(t, self.clasp[1], _BLEND_S)  # from the clasp to the table

        lean = np.column_stack([self.wander[name](t) for name in ("yaw", "pitch", "roll")])
        lean *= np.deg2rad(self.lean_deg * moving[:, None] + circling[:, None] * np.array((5.0, 3.0, 3.0)))
        flaws = self.flaws
        sway = np.deg2rad(flaws.sizes.sway_deg_s)
        if sway:
            lean[:, 1:] += sway * flaws.sway["torso"](t)
        R_WT = self._torso(t, lean)
        clasp_T = self._clasp_point(t, moving) + self.lengths["trunk"] * E_Z
        hand_W = self.table_W + sum((c.offset_W(t, self.table_W) for c in self.circles), np.zeros((len(t), 3)))
        palm_T = self._palms(t, moving, clasp_T, R_WT)
        palm_T["right"] = palm_T["right"] + table[:, None] * (R_WT.inv().apply(hand_W) - palm_T["right"])
        if flaws.sizes.palm_slip:
            slip_T = moving[:, None] * np.column_stack(
                [g * w(t) for g, w in zip(self.slip_gain, flaws.slip, strict=True)]
            )
            palm_T = {"left": palm_T["left"] + 0.5 * slip_T, "right": palm_T["right"] - 0.5 * slip_T}
        led_by = self._lead_share(t, led, table)
        palm_down = {"left": 0.0 * t, "right": np.deg2rad(40.0) * table}

        R_WL, points, origins = {"torso": R_WT}, {}, {"torso": np.zeros(3)}
        for side in [side for side in SIDES if any(segment.startswith(side) for segment in segments)]:
            y, blend = SIDES[side], led_by[side]
            shoulder_T = np.array((0.0, y * self.half_width, self.lengths["trunk"]))
            swivel = np.deg2rad(35.0 + 30.0 * (moving + 0.3 * circling) * self.wander[f"{side}_swivel"](t))
            R_TU, flexion = self._arm(side, palm_T[side] - shoulder_T, swivel)
            if flaws.sizes.shoulder_wander:
                # The elevation is that of the arm from the mean centre: the same to within a degree.
                along_T = Rotation.from_rotvec(blend[:, None] * R_TU.as_rotvec()).apply(-E_Z)
                shoulder_T = shoulder_T + (1.0 + along_T[:, 2:]) * flaws.shoulder[side]
                R_TU, flexion = self._arm(side, palm_T[side] - shoulder_T, swivel)
            wander = np.deg2rad(55.0 * moving + 15.0 * circling) * self.wander[f"{side}_pronation"](t)
            bend = np.column_stack((-blend * flexion, blend * (wander + palm_down[side])))
            if flaws.sizes.start_elbow_deg:
                bend[:, 0] -= (1.0 - blend) * flaws.elbow[side]
            R_WU = R_WT * Rotation.from_rotvec(blend[:, None] * R_TU.as_rotvec())
            hanging = (1.0 - blend)[:, None]
            if sway:
                R_WU = R_WU * Rotation.from_rotvec(hanging * sway * np.pad(flaws.sway[side](t), ((0, 0), (0, 1))))
            if flaws.sizes.start_segment_deg:
                R_WU = R_WU * Rotation.from_rotvec(hanging * flaws.start[f"{side}_upper_arm"])
            R_WF = R_WU * Rotation.from_euler("YZ", bend)  # a hinge about -y, then pronation
            if flaws.sizes.start_segment_deg:
                R_WF = R_WF * Rotation.from_rotvec(hanging * flaws.start[f"{side}_forearm"])
            R_WL[f"{side}_upper_arm"], R_WL[f"{side}_forearm"] = R_WU, R_WF
            p_W = R_WT.apply(shoulder_T)
            points[f"{side}_shoulder"] = p_W
            for part, end, R_WL_part in (
                ("upper_arm", "elbow", R_WU),
                ("forearm", "wrist", R_WF),
                ("hand", "palm", R_WF),
            ):
                p_W = p_W + R_WL_part.apply((0.0, 0.0, -self.lengths[f"{side}_{part}"]))
                points[f"{side}_{end}"] = p_W
            origins |= {f"{side}_upper_arm": points[f"{side}_shoulder"], f"{side}_forearm": points[f"{side}_elbow"]}
        return BodyPose(R_WL, points, origins)


def place_sensors(lengths: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Place each sensor in L [m]: on the sternum, and half-way along the outer side of the arm segments."""
    places = {"torso": np.array((0.11, 0.0, 0.8 * lengths["trunk"]))}
    for side, y in SIDES.items():
        places[f"{side}_upper_arm"] = np.array((0.0, 0.045 * y, -0.5 * lengths[f"{side}_upper_arm"]))
        places[f"{side}_forearm"] = np.array((0.01, 0.03 * y, -0.5 * lengths[f"{side}_forearm"]))
    return places


def locate_sensor(pose: BodyPose, segment: str, p_LS: np.ndarray) -> np.ndarray:
    """Compute the sensor's position (n, 3) [m] in W."""
    return pose.R_WL[segment].apply(p_LS) + pose.origins[segment]
