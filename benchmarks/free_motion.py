"""Random motion of both hands, each by itself, which pauses and goes on."""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from wepose_pin.simulation.motion import SIDES, Motion
from wepose_pin.simulation.signals import Wander

PAUSE_S = 20.0  # [s] from one pause to the next
# Around the middle, from the shoulder: azimuth outwards and elevation [deg], distance as a share of the arm's reach.
MIDDLE, SPREAD = (15.0, -20.0, 0.64), (35.0, 45.0, 0.2)


class FreeMotion(Motion):
    """Hands that move at random before the body, in the time of the clasp."""

    phase = "free"

    def fit_to_person(self, rng: np.random.Generator) -> None:
        """Prepare the motion: hands that miss their aim by millimetres are as good."""
        self.prepare(deepcopy(rng))
        if self.flaws.iterates:
            time = np.arange(*self.clasp, 0.05)
            moving = self._motion_share(time)
            distance = np.linalg.norm(self._clasp_point(time, moving), axis=1)
            self.flaws.wrists.fit(time, moving, np.column_stack((distance, distance)))

    def prepare(self, rng: np.random.Generator) -> None:
        self.hand = {side: [Wander(rng) for _ in MIDDLE] for side in SIDES}

    def protocol_phases(self) -> dict[str, list[tuple[float, float]]]:
        return {}

    def _palms(self, t: np.ndarray, motion_share: np.ndarray, _clasp_T: np.ndarray) -> dict[str, np.ndarray]:
        omega = 2.0 * np.pi / PAUSE_S
        own_time = t + np.sin(omega * t) / omega  # stands still in a pause
        palms = {}
        for side, y in SIDES.items():
            azimuth, elevation, distance = (
                middle + spread * motion_share * wander(own_time)
                for middle, spread, wander in zip(MIDDLE, SPREAD, self.hand[side], strict=True)
            )
            azimuth, elevation = y * np.deg2rad(azimuth), np.deg2rad(elevation)
            ray = np.column_stack(
                (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
            )
            shoulder_T = np.array((0.0, y * self.half_width, self.lengths["trunk"]))
            palms[side] = shoulder_T + (sum(self.arm[side]) * distance)[:, None] * ray
        return palms
