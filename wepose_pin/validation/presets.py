"""The presets of simulated people that the experiments run on, and what a user measures of such a person."""

from __future__ import annotations

from typing import NamedTuple

from .. import simulation
from ..simulation import Imperfections, Person, simulate_person


class Preset(NamedTuple):
    """Imperfections of people and sensors, and the error of measured lengths."""

    imperfections: Imperfections
    measured_std: float  # [m] one standard deviation

    def sample_person(self, seed: int) -> Person:
        return simulate_person(seed, self.measured_std)


MEASURED_STD = 0.003  # [m] of a careful measurement between the centres of the joints themselves
PRESETS = {name: Preset(imperfections, MEASURED_STD) for name, imperfections in simulation.PRESETS.items()}
