"""Random motion of both hands, each by itself, which pauses and goes on."""

from __future__ import annotations

import numpy as np

from wepose_pin.simulation.motion import Motion, aim_ray
from wepose_pin.simulation.people import SIDES, place_shoulder
from wepose_pin.simulation.signals import Wander

PAUSE_S = 20.0  # [s] from one pause to the next
# Around the middle, from the shoulder: azimuth outwards and elevation [deg], distance as a share of the arm's reach.
MIDDLE, SPREAD = (15.0, -20.0, 0.64), (35.0, 45.0, 0.2)


class FreeMotion(Motion):
    """Hands that move at random before the body, in the time of the clasp."""

    name = "free"
    closes = False  # hands that miss their aim by millimetres are as good

    def prepare(self, rng: np.random.Generator) -> None:
        self.hand = {side: [Wander(rng) for _ in MIDDLE] for side in SIDES}
        self.phases.pop(self.name)

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
            reach = (sum(self.arm[side]) * distance)[:, None]
            palms[side] = place_shoulder(y, self.lengths) + reach * aim_ray(azimuth, elevation)
        return palms
