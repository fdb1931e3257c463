"""Motions of protocols in turn: joined hands, elbows that bend, arms that swing, a T-pose, palms on the body, a bow."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadOption
from ..rotations import compose
from .motion import LIFT_S, MARGIN_S, SIDES, FreeArm, Motion
from .people import Offset
from .signals import Process, Wander, integrate_pulse, make_pulse, make_step

_LONG_S = 45.0  # [s] of a session, from which on parts have their full length
_PART_S = {
    "bow": (5.0, 6.0),
    "elbows": (7.0, 10.0),
    "swing": (7.0, 10.0),
    "t_pose": (4.0, 5.0),
    "touch_body": (4.0, 6.0),
}  # short, full
_LEAST_CLASP_S = 5.0
_BLEND_S = 1.5  # between hanging arms and hands that are led, or arms held sideways
_RAMP_S = 1.0  # in which a part's motion grows and dies away
_LONG_RAMPS_S = {"bow": 2.0, "clasp": 2.0}
_BEND = np.deg2rad(45.0)  # half the range of the elbow
_TURN = np.deg2rad(60.0)  # of the forearm to either side
_STILL = np.deg2rad(3.0)  # of upper arms that are to hang still, assumption
_SWING = np.deg2rad((40.0, 35.0))  # forwards and backwards; half of what the arm is raised sideways
_TRUNK = np.deg2rad((15.0, 12.0, 10.0))  # yaw, pitch, roll while arms swing
_TRUNK_HZ = np.array((0.65, 0.5, 0.37))
BOW = np.deg2rad(45.0)
BOW_AXIS_STD = np.deg2rad(3.5)  # from the torso's y: such axes repeat within 2 to 5 deg (Luinge 2007, de Vries 2010)
# How people hold the T-pose, each their own: assumptions, held to N- and T-poses in Robert-Lachaine 2017.
T_POSE = {
    "elevation": Offset(-3.0, 5.0),
    "plane": Offset(10.0, 6.0),
    "elbow": Offset(5.0, 4.0),
    "forearm_twist": Offset(0.0, 15.0),
}
_PLACE_STD = 0.033  # [m] each axis, where a person puts the palm: anywhere on it, 116 mm long (ANSUR II), over √12
_SLIP_S = 2.0  # correlation time of a palm's slip, assumption
_OWN_SLIP = 0.87  # of the palm's slip, beside what both palms share in `Motion`


class _Place(NamedTuple):
    """Where palms rest on the body and how the elbows turn about the line from shoulder to palm."""

    phase: str
    forward: float  # [m]
    aside: float  # [m] to the palm's own side
    up: float  # [m] from the root
    from_shoulders: bool  # up from the shoulders in place of the root
    swivel: tuple[float, float]  # [rad] middle and to either side


_PLACES = (
    _Place("hips", 0.09, 0.13, 0.06, False, (np.deg2rad(60.0), np.deg2rad(35.0))),
    _Place("shoulders", 0.06, -0.13, 0.0, True, (np.deg2rad(60.0), np.deg2rad(35.0))),
    _Place("head", 0.03, 0.03, 0.33, True, (np.deg2rad(140.0), np.deg2rad(35.0))),
)


class _Part(NamedTuple):
    """A piece of the session [s]."""

    kind: str
    phase: str
    start: float
    stop: float

    @property
    def led(self) -> bool:
        """True where palms are led to a point."""
        return self.kind in ("clasp", "touch_body")

    @property
    def ramp(self) -> float:
        return _LONG_RAMPS_S.get(self.kind, _RAMP_S)

    def gate(self, t: np.ndarray) -> np.ndarray:
        return make_pulse(t, self.start, self.stop, self.ramp)


class Sequence(Motion):
    """Parts of protocols in the order of `parts`; the clasp, where there is one, takes the time that is left."""

    parts: tuple[str, ...] = ("clasp",)

    def prepare(self, rng: np.random.Generator, _pose_deg: float) -> None:
        begin, end = self.clasp
        full = end - begin >= _LONG_S
        pieces = [
            (kind, place.phase if place else kind)
            for kind in self.parts
            for place in (_PLACES if kind == "touch_body" else (None,))
        ]
        seconds = [_PART_S[kind][full] if kind in _PART_S else 0.0 for kind, _ in pieces]
        changes = [_BLEND_S * (self._changes(a) + self._changes(b)) for (a, _), (b, _) in pairwise(pieces)]
        first, last = _BLEND_S * (pieces[0][0] == "t_pose"), _BLEND_S * (pieces[-1][0] == "t_pose")
        left = end - begin - sum(seconds) - sum(changes) - first - last
        shares = [kind == "clasp" for kind, _ in pieces]
        least = _LEAST_CLASP_S if any(shares) else 0.0
        if left < least:
            raise BadOption(
                f"protocol '{'+'.join(self.parts)}' needs {end - begin + least - left:.0f} s, {end - begin:g} are given"
            )
        self.schedule: list[_Part] = []
        at = begin + first
        for (kind, phase), fixed, change in zip(pieces, seconds, [*changes, last], strict=True):
            # Without a clasp the parts last longer.
            own = left / sum(shares) if kind == "clasp" else fixed + (0.0 if any(shares) else left / len(pieces))
            self.schedule.append(_Part(kind, phase, at, at + own))
            at += own + change
        self.places, self.rates, self.pose = {}, {}, {}
        for side in SIDES:
            for place in _PLACES:
                self.places[side, place.phase] = _PLACE_STD * np.clip(rng.standard_normal(3), -1.5, 1.5)
            self.rates[side] = rng.uniform(0.9, 1.1, 5)
            size = self.flaws.sizes.start_pose
            self.pose[side] = {
                name: np.deg2rad(offset.mean + size * offset.std * np.clip(rng.standard_normal(), -2.3, 2.3))
                for name, offset in T_POSE.items()
            }
        self.still = {side: [Wander(rng) for _ in range(2)] for side in SIDES}
        self.own_slip = {side: Process(rng, _SLIP_S, 3) for side in SIDES}
        self.bow_axis = self.flaws.sizes.start_pose * BOW_AXIS_STD * np.clip(rng.standard_normal(), -2.3, 2.3)

    @staticmethod
    def _changes(kind: str) -> bool:
        """Return whether time passes before and after a part: hands are led there, or arms are raised."""
        return kind in ("clasp", "touch_body", "t_pose")

    def protocol_phases(self) -> dict[str, list[tuple[float, float]]]:
        return {part.phase: [(part.start + MARGIN_S, part.stop - MARGIN_S)] for part in self.schedule}

    def _sum_gates(self, t: np.ndarray, parts: list[_Part]) -> np.ndarray:
        return sum((part.gate(t) for part in parts), np.zeros_like(t))

    def activity(self, t: np.ndarray) -> np.ndarray:
        moving = self._sum_gates(t, self.schedule)
        return moving + sum((make_pulse(t, c.start, c.stop, LIFT_S) for c in self.circles), np.zeros_like(t))

    def moving_time(self, t: np.ndarray, _segment: str = "", /) -> np.ndarray:
        moving = sum((integrate_pulse(t, p.start, p.stop, p.ramp) for p in self.schedule), np.zeros_like(t))
        return moving + sum((integrate_pulse(t, c.start, c.stop, LIFT_S) for c in self.circles), np.zeros_like(t))

    def _motion_share(self, t: np.ndarray) -> np.ndarray:
        return self._sum_gates(t, [part for part in self.schedule if part.led])

    def _weights(self, t: np.ndarray) -> list[tuple[_Part, np.ndarray]]:
        """Return each led part with the share (n,) by which the palms aim at its place."""
        led = [part for part in self.schedule if part.led]
        weights = [np.ones_like(t)]
        for before, after in pairwise(led):
            middle = 0.5 * (before.stop + after.start)
            step = make_step(t, middle - 0.4, 0.8)
            weights = [*weights[:-1], weights[-1] * (1.0 - step), step]
        return list(zip(led, weights, strict=False))

    def _target(self, part: _Part, side: str, clasp_T: np.ndarray) -> np.ndarray:
        """Return where a part brings the palm, (n, 3) or (3,) [m] in T."""
        place = next((place for place in _PLACES if place.phase == part.phase), None)
        if place is None:
            return clasp_T
        up = place.up + (self.lengths["trunk"] if place.from_shoulders else 0.0)
        return np.array((place.forward, SIDES[side] * place.aside, up)) + self.places[side, place.phase]

    def _palms(self, t: np.ndarray, _moving: np.ndarray, clasp_T: np.ndarray, _R_WT: Rotation) -> dict[str, np.ndarray]:
        weights, palm_T = self._weights(t), {}
        if not weights:
            return dict.fromkeys(SIDES, clasp_T)
        touching = self._sum_gates(t, [part for part in self.schedule if part.kind == "touch_body"])
        for side in SIDES:
            palm_T[side] = sum(w[:, None] * self._target(part, side, clasp_T) for part, w in weights)
            if self.flaws.sizes.palm_slip:
                slip = _OWN_SLIP * self.flaws.sizes.palm_slip / np.sqrt(3.0) * self.own_slip[side](t)
                palm_T[side] = palm_T[side] + touching[:, None] * slip
        return palm_T

    def _lead_share(self, t: np.ndarray, led: np.ndarray, table: np.ndarray) -> dict[str, np.ndarray]:
        share = np.zeros_like(t)
        for part in self.schedule:
            if not part.led:
                continue
            rise = led if part is self.schedule[0] else make_step(t, part.start - _BLEND_S, _BLEND_S)
            fall = 0.0 * t if part is self.schedule[-1] else make_step(t, part.stop, _BLEND_S)
            share = share + rise * (1.0 - fall)
        if self.schedule[-1].led:
            return {"left": share * (1.0 - table), "right": share}
        return {"left": share, "right": share + table}

    def _torso(self, t: np.ndarray, lean: np.ndarray) -> Rotation:
        for part in self.schedule:
            if part.kind == "swing":
                wave = np.sin(2.0 * np.pi * np.outer(t - part.start, self.rates["left"][2] * _TRUNK_HZ))
                lean += part.gate(t)[:, None] * _TRUNK * wave
        torso = super()._torso(t, lean)
        for part in self.schedule:
            if part.kind == "bow":
                torso = compose(make_bow(part.gate(t), self.bow_axis), torso)
        return torso

    def _free(self, t: np.ndarray, side: str) -> FreeArm:
        y, rates = SIDES[side], self.rates[side]
        turn, bend, start = np.zeros((len(t), 3)), np.zeros((len(t), 2)), np.ones_like(t)
        for part in self.schedule:
            gate, s = part.gate(t), 2.0 * np.pi * (t - part.start)
            if part.kind == "elbows":
                bend[:, 0] -= gate * _BEND * (1.0 - np.cos(0.45 * rates[0] * s))
                bend[:, 1] += gate * _TURN * np.sin(0.7 * rates[1] * s)
                still = np.column_stack([wander(t) for wander in self.still[side]])
                turn[:, :2] += _STILL * gate[:, None] * still
            elif part.kind == "swing":
                middle = 0.5 * (part.start + part.stop)
                first = make_pulse(t, part.start, middle, _RAMP_S)
                second = make_pulse(t, middle, part.stop, _RAMP_S)
                turn[:, 1] -= first * _SWING[0] * np.sin(0.8 * rates[2] * s)
                turn[:, 0] += y * second * _SWING[1] * (1.0 - np.cos(0.6 * rates[3] * s))
                bend[:, 0] -= gate * np.deg2rad(10.0)
            elif part.kind == "t_pose":
                held, pose = make_pulse(t, part.start - _BLEND_S, part.stop + _BLEND_S, _BLEND_S), self.pose[side]
                raised = Rotation.from_euler("zx", [0.0, y * (0.5 * np.pi + pose["elevation"])])
                raised = Rotation.from_euler("z", -y * pose["plane"]) * raised
                turn += held[:, None] * raised.as_rotvec()
                bend += held[:, None] * np.array((-pose["elbow"], pose["forearm_twist"]))
                start = start * (1.0 - held)
        return FreeArm(turn, bend, start)

    def _aim_swivel(self, t: np.ndarray, side: str, swivel: np.ndarray) -> np.ndarray:
        weights = self._weights(t)
        if not weights:
            return swivel
        total = np.zeros_like(t)
        for part, weight in weights:
            place = next((place for place in _PLACES if place.phase == part.phase), None)
            if place is None:
                total = total + weight * swivel
            else:
                middle, reach = place.swivel
                s = 2.0 * np.pi * 0.4 * self.rates[side][4] * (t - part.start)
                total = total + weight * (middle + part.gate(t) * reach * np.sin(s))
        return total


def make_bow(share: np.ndarray, axis_angle: float) -> Rotation:
    """Make a bow by shares (n,) of `BOW` about an axis that is so far [rad] from y."""
    axis = np.array((-np.sin(axis_angle), np.cos(axis_angle), 0.0))
    return Rotation.from_rotvec(BOW * share[:, None] * axis)


def make_sequence(parts: tuple[str, ...]) -> type[Sequence]:
    """Make the motion of these parts, one after another."""
    return type("Sequence", (Sequence,), {"parts": parts})
