"""What the figure of the page does to show a step of the guide: poses that nobody took."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import DEFAULT_BODY, BodyModel
from ..body.kinematics import KinematicsSolver
from ..calibration import Protocol
from ..errors import BadOption
from ..simulation import simulate
from .state import GuideView, LivePose, StreamInfo

RATE_HZ = 30.0
MOTION_S = 14.0  # [s] of the motion of a protocol's part; it is drawn again and again
LEAD_S = 2.0  # [s] before the phase in which the figure takes its place
SHAKE_HZ, SHAKE_ANGLE = 2.5, 0.45  # of a shaken segment; angle in rad


class Demonstration:
    """Poses of a figure for each view of the guide; those of a body without a simulated protocol stand still."""

    def __init__(self, model: BodyModel, protocol: Protocol) -> None:
        shown, lengths = None, tuple(model.lengths.items())
        if model.table.name == DEFAULT_BODY:  # a protocol of one's own is shown as a clasp
            shown = _simulate(lengths, protocol.name) or _simulate(lengths, "clasp")
        self._motion, self._phases = shown or ({}, {})
        self.segments = tuple(model.table.needed)
        self._kinematics = KinematicsSolver(model, self.segments)
        self.info = StreamInfo(self.segments, self._kinematics.points, RATE_HZ)  # of the poses

    def pose(self, view: GuideView, time: float) -> LivePose:
        """The figure at a time [s]: the start pose, the motion of a phase, or one segment that is shaken."""
        quat_WL = np.tile([0.0, 0.0, 0.0, 1.0], (len(self.segments), 1))
        dimmed = np.zeros(len(self.segments), dtype=bool)
        if view.demonstration in self._phases:
            first, last = self._phases[view.demonstration]
            row = round(RATE_HZ * (first - LEAD_S + time % (last - first + LEAD_S)))
            quat_WL = np.array([self._motion[name][row] for name in self.segments])
        elif view.highlight in self.segments:
            angle = SHAKE_ANGLE * np.sin(2.0 * np.pi * SHAKE_HZ * time) * (time % 2.0 < 1.2)
            k = self.segments.index(view.highlight)
            quat_WL[k] = Rotation.from_rotvec([0.0, -abs(angle), 0.0]).as_quat()
            dimmed[:] = True
            dimmed[k] = False
        points = self._kinematics.compute_points(quat_WL)
        return LivePose(time, quat_WL, points, np.full(len(quat_WL), np.nan), dimmed, 0.0)


@lru_cache(maxsize=4)
def _simulate(
    lengths: tuple[tuple[str, float], ...], task: str
) -> tuple[Mapping[str, np.ndarray], Mapping[str, tuple[float, float]]] | None:
    """Segment → (n, 4) xyzw at `RATE_HZ`, and phase → its interval [s]; None where that cannot be simulated."""
    try:
        motion_s = MOTION_S * len(task.split("+"))
        motion = simulate(dict(lengths), seed=1, rate_hz=RATE_HZ, clasp_s=motion_s, circles=0, protocol=task)
    except BadOption:
        return None
    return motion.quat_WL, {name: spans[0] for name, spans in motion.phases.items() if spans}
