"""Motions of the protocols other than the clasp: a handle, a palm on a fixed point, poses and a bow."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadOption, one_of
from ..rotations import compose, turn_about
from .imperfections import Imperfections
from .motion import MARGIN_S, SIDES, Motion
from .sequence import make_bow, make_sequence
from .signals import Wander, make_pulse, make_step

_T_POSE_S = (7.5, 12.5)
_BOW_S = (15.5, 22.0)
_BAR_DEG = np.array((40.0, 80.0))  # paddle, steering wheel
_TURN_S = 2.5  # into the T-pose, and back


def _is_in_reach(motion: Motion, side: str, distance: np.ndarray) -> bool:
    """Return whether the arm reaches all distances (n,) [m] from shoulder to palm."""
    upper, lower = motion.arm[side]
    span = np.sqrt(upper**2 + lower**2 + 2.0 * upper * lower * np.cos(np.deg2rad((12.0, 140.0))))
    return bool(np.all((span[1] < distance) & (distance < span[0] - motion.flaws.slack)))


class Handle(Motion):
    """Both hands on a bar that tilts and rotates."""

    phase = "handle"
    length = 0.40  # [m] between the palms

    def _slip(self, sizes: Imperfections) -> float:
        return sizes.handle_slip or sizes.palm_slip

    def prepare(self, rng: np.random.Generator, _pose_deg: float) -> None:
        self.bar = [Wander(rng) for _ in range(2)]
        t = np.arange(*self.clasp, 0.05)
        moving, none = self._motion_share(t), Rotation.identity()
        for share in np.arange(1.0, 0.1, -0.05):  # the largest motion in reach of the arms
            self.share = share
            palm_T = self._palms(t, moving, self._clasp_point(t, moving), none)
            if all(
                _is_in_reach(self, side, np.linalg.norm(palm_T[side] - [0.0, y * self.half_width, 0.0], axis=1))
                for side, y in SIDES.items()
            ):
                break

    def _clasp_point(self, t: np.ndarray, moving: np.ndarray) -> np.ndarray:
        point = super()._clasp_point(t, moving)
        radius = np.linalg.norm(point, axis=1, keepdims=True)
        middle = 0.62 * self.reach
        return point / radius * (middle + self.share * (radius - middle))

    def _palms(self, t: np.ndarray, moving: np.ndarray, clasp_T: np.ndarray, _R_WT: Rotation) -> dict[str, np.ndarray]:
        angles = (
            np.deg2rad(self.share * _BAR_DEG) * moving[:, None] * np.column_stack([wander(t) for wander in self.bar])
        )
        half_T = Rotation.from_euler("ZX", angles).apply([0.0, 0.5 * self.length, 0.0])
        return {"left": clasp_T + half_T, "right": clasp_T - half_T}


class Touch(Motion):
    """One palm on a fixed point of W, from the clasp's beginning to its end; the trunk leans and rotates."""

    phase = "touch"
    side = "right"

    def prepare(self, _rng: np.random.Generator, _pose_deg: float) -> None:
        y = SIDES[self.side]
        shoulder_W = np.array((0.0, y * self.half_width, self.lengths["trunk"]))
        self.point_W = shoulder_W + self.reach * np.array((0.60, 0.05 * y, -0.35))
        # The shoulder's motion is scaled down until the palm stays in reach.
        most = np.array((25.0, 15.0, 12.0))
        t = np.arange(*self.clasp, 0.05)
        for share in np.arange(1.0, 0.2, -0.05):
            self.lean_deg = share * most
            lean = np.deg2rad(self.lean_deg) * np.column_stack([self.wander[n](t) for n in ("yaw", "pitch", "roll")])
            R_WT = turn_about("ZYX", lean)
            if _is_in_reach(self, self.side, np.linalg.norm(self.point_W - R_WT.apply(shoulder_W), axis=1)):
                break
        if self.side == "right":
            self.table_W = self.point_W

    def _palms(self, _t: np.ndarray, _moving: np.ndarray, clasp_T: np.ndarray, R_WT: Rotation) -> dict[str, np.ndarray]:
        return {"left": clasp_T, "right": clasp_T} | {self.side: R_WT.inv().apply(self.point_W)}

    def _lead_share(self, _t: np.ndarray, led: np.ndarray, _table: np.ndarray) -> dict[str, np.ndarray]:
        return {side: led if side == self.side else 0.0 * led for side in SIDES}


class TouchLeft(Touch):
    side = "left"


class Poses(Motion):
    """T-pose, then a bow, each with a person's errors."""

    leads = False

    def prepare(self, rng: np.random.Generator, pose_deg: float) -> None:
        self.clasp = (_T_POSE_S[0], _BOW_S[1])
        end = self.clasp[1]
        self.rest = [(end, end + 2.5)]
        size = np.deg2rad(pose_deg)
        self.off = {side: size * rng.standard_normal(3) for side in SIDES}  # [rad] of the raised arm, in T
        self.elbow = {side: abs(size * rng.standard_normal()) for side in SIDES}  # [rad]
        self.bow_axis = 0.75 * size * rng.standard_normal()  # [rad] from y

    def protocol_phases(self) -> dict[str, list[tuple[float, float]]]:
        return {
            "t_pose": [(_T_POSE_S[0] + MARGIN_S, _T_POSE_S[1] - MARGIN_S)],
            "bow": [(_BOW_S[0] - MARGIN_S, _BOW_S[1] + MARGIN_S)],
        }

    def _motion_share(self, t: np.ndarray) -> np.ndarray:
        return 0.0 * t

    def _torso(self, t: np.ndarray, lean: np.ndarray) -> Rotation:
        return compose(make_bow(make_pulse(t, *_BOW_S, _TURN_S), self.bow_axis), turn_about("ZYX", lean))

    def _lead_share(self, t: np.ndarray, _lead_share: np.ndarray, _table: np.ndarray) -> dict[str, np.ndarray]:
        raised = make_step(t, _T_POSE_S[0] - _TURN_S, _TURN_S) * (1.0 - make_step(t, _T_POSE_S[1], _TURN_S))
        return dict.fromkeys(SIDES, raised)

    def _arm(self, side: str, palm_T: np.ndarray, _swivel: np.ndarray) -> tuple[Rotation, np.ndarray]:
        n = len(palm_T)
        raised = Rotation.from_rotvec(self.off[side]) * Rotation.from_rotvec([SIDES[side] * np.pi / 2.0, 0.0, 0.0])
        return Rotation.from_rotvec(np.tile(raised.as_rotvec(), (n, 1))), np.full(n, self.elbow[side])


SEQUENCE_PARTS = ("bow", "clasp", "elbows", "swing", "t_pose", "touch_body")  # what a sequence may have
TASKS: dict[str, type[Motion]] = {
    "clasp": Motion,
    "handle": Handle,
    "touch_left": TouchLeft,
    "touch_right": Touch,
    "poses": Poses,
    **{part: make_sequence((part,)) for part in SEQUENCE_PARTS if part != "clasp"},
}


def find_task(protocol: str) -> type[Motion]:
    """Find the motion of a protocol, or of several that are joined by "+".

    Raises
    ------
    BadOption
        There is none.
    """
    parts = tuple(protocol.split("+"))
    if len(parts) > 1 and set(parts) <= set(SEQUENCE_PARTS) and len(set(parts)) == len(parts):
        return make_sequence(parts)
    if protocol not in TASKS:
        raise BadOption(
            f"protocol {protocol!r} is not simulated; {one_of(TASKS, protocol)}; or several of "
            f"{', '.join(SEQUENCE_PARTS)} joined by +"
        )
    return TASKS[protocol]
