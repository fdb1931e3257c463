"""The presets of simulated people that the experiments run on, and what a user measures of such a person."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from wepose_pin import simulation
from wepose_pin.simulation import (
    MEASURED_STD,
    PEOPLE_MEASURED_STD,
    PEOPLE_PRESET,
    Imperfections,
    Person,
    simulate_person,
)

UPPER_BODY = "upper body"  # the experiment, one of each preset: "upper body, mild"


class Preset(NamedTuple):
    """Imperfections of people and sensors, and the error of measured lengths."""

    imperfections: Imperfections
    measured_std: float  # [m] one standard deviation

    def sample_person(self, seed: int) -> Person:
        return simulate_person(seed, self.measured_std)


PRESETS = {name: Preset(imperfections, MEASURED_STD) for name, imperfections in simulation.PRESETS.items()}
# W's x is where the torso faces in the start pose: one who faces elsewhere than the feet turns W and nothing else.
PRESETS["people"] = Preset(replace(PEOPLE_PRESET, start_heading_deg=0.0), PEOPLE_MEASURED_STD)
