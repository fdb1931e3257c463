"""Motions of protocols in turn: joined hands, a T-pose, a bow."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadOption, one_of
from ..rotations import compose
from .motion import MARGIN_S, SIDES, FreeArm, Motion
from .people import Offset
from .signals import make_pulse, make_step

_LONG_S = 45.0  # [s] of a session, from which on parts have their full length
_PART_S = {"bow": (5.0, 6.0), "t_pose": (4.0, 5.0)}  # short, full
_LEAST_CLASP_S = 5.0
_BLEND_S = 1.5  # between hanging arms and hands that are led, or arms held sideways
_RAMP_S = {"bow": 2.0, "clasp": 2.0, "t_pose": 1.0}  # in which a part's motion grows and dies away
BOW = np.deg2rad(45.0)
BOW_AXIS_STD = np.deg2rad(3.5)  # from the torso's y: such axes repeat within 2 to 5 deg (Luinge 2007, de Vries 2010)
# How people hold the T-pose, each their own: assumptions, held to N- and T-poses in Robert-Lachaine 2017.
T_POSE = {
    "elevation": Offset(-3.0, 5.0),
    "plane": Offset(10.0, 6.0),
    "elbow": Offset(5.0, 4.0),
    "forearm_twist": Offset(0.0, 15.0),
}


class _Part(NamedTuple):
    """A piece of the session [s]."""

    kind: str  # the protocol, whose phase has its name
    start: float
    stop: float

    @property
    def led(self) -> bool:
        """True where palms are led to a point."""
        return self.kind == "clasp"

    @property
    def pulse(self) -> tuple[float, float, float]:
        """Begin, end and ramp [s] of its motion."""
        return self.start, self.stop, _RAMP_S[self.kind]


class Sequence(Motion):
    """Parts of protocols in the order of `parts`; the clasp, where there is one, takes the time that is left."""

    parts: tuple[str, ...] = ("clasp",)

    def prepare(self, rng: np.random.Generator) -> None:
        begin, end = self.clasp
        full = end - begin >= _LONG_S
        seconds = [_PART_S[kind][full] if kind in _PART_S else 0.0 for kind in self.parts]
        # Time passes before and after a part but a bow: hands are led there, or arms are raised.
        changes = [_BLEND_S * ((a != "bow") + (b != "bow")) for a, b in pairwise(self.parts)]
        first, last = _BLEND_S * (self.parts[0] == "t_pose"), _BLEND_S * (self.parts[-1] == "t_pose")
        left = end - begin - sum(seconds) - sum(changes) - first - last
        least = _LEAST_CLASP_S if "clasp" in self.parts else 0.0
        if left < least:
            raise BadOption(
                f"protocol '{'+'.join(self.parts)}' needs {end - begin + least - left:.0f} s, {end - begin:g} are given"
            )
        self.schedule: list[_Part] = []
        at = begin + first
        for kind, fixed, change in zip(self.parts, seconds, [*changes, last], strict=True):
            # Without a clasp the parts last longer.
            own = left if kind == "clasp" else fixed + (0.0 if "clasp" in self.parts else left / len(self.parts))
            self.schedule.append(_Part(kind, at, at + own))
            at += own + change
        self.pose = {}
        for side in SIDES:
            rng.standard_normal(9), rng.uniform(size=5)  # of parts that there were: a seed keeps its person
            size = self.flaws.sizes.start_pose
            self.pose[side] = {
                name: np.deg2rad(offset.mean + size * offset.std * np.clip(rng.standard_normal(), -2.3, 2.3))
                for name, offset in T_POSE.items()
            }
        self.bow_axis = self.flaws.sizes.start_pose * BOW_AXIS_STD * np.clip(rng.standard_normal(), -2.3, 2.3)

    def protocol_phases(self) -> dict[str, list[tuple[float, float]]]:
        return {part.kind: [(part.start + MARGIN_S, part.stop - MARGIN_S)] for part in self.schedule}

    def protocol_pulses(self) -> list[tuple[float, float, float]]:
        return [part.pulse for part in self.schedule]

    def _motion_share(self, t: np.ndarray) -> np.ndarray:
        return sum((make_pulse(t, *part.pulse) for part in self.schedule if part.led), np.zeros_like(t))

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
        torso = super()._torso(t, lean)
        for part in self.schedule:
            if part.kind == "bow":
                torso = compose(make_bow(make_pulse(t, *part.pulse), self.bow_axis), torso)
        return torso

    def _free(self, t: np.ndarray, side: str) -> FreeArm:
        y = SIDES[side]
        turn, bend, start = super()._free(t, side)
        for part in self.schedule:
            if part.kind == "t_pose":
                held, pose = make_pulse(t, part.start - _BLEND_S, part.stop + _BLEND_S, _BLEND_S), self.pose[side]
                raised = Rotation.from_euler("zx", [0.0, y * (0.5 * np.pi + pose["elevation"])])
                raised = Rotation.from_euler("z", -y * pose["plane"]) * raised
                turn += held[:, None] * raised.as_rotvec()
                bend += held[:, None] * np.array((-pose["elbow"], pose["forearm_twist"]))
                start = start * (1.0 - held)
        return FreeArm(turn, bend, start)


def make_bow(share: np.ndarray, axis_angle: float) -> Rotation:
    """Make a bow by shares (n,) of `BOW` about an axis that is so far [rad] from y."""
    axis = np.array((-np.sin(axis_angle), np.cos(axis_angle), 0.0))
    return Rotation.from_rotvec(BOW * share[:, None] * axis)


PARTS = ("bow", "clasp", "t_pose")
TASKS: dict[str, type[Motion]] = {"clasp": Motion}  # that are no `Sequence`


def find_task(protocol: str) -> type[Motion]:
    """Find the motion of a protocol, or of several that are joined by "+".

    Raises
    ------
    BadOption
        There is none.
    """
    if protocol in TASKS:
        return TASKS[protocol]
    parts = tuple(protocol.split("+"))
    if not set(parts) <= set(PARTS) or len(set(parts)) < len(parts):
        names = dict.fromkeys((*TASKS, *PARTS))
        raise BadOption(f"protocol {protocol!r} is not simulated; {one_of(names, protocol)}; or several joined by +")
    return type("Sequence", (Sequence,), {"parts": parts})
