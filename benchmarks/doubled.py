"""Two sensors on one segment beside either of them alone, on simulated people who move at random."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin.recording import DoubledSensor, Recording
from wepose_pin.simulation import MTI_3, Imperfections, Simulation, simulate_person
from wepose_pin.simulation.motion import Flaws
from wepose_pin.simulation.subject import measure_motion, spawn_streams

from .free_motion import FreeMotion
from .headings import EVERY, PRESETS, UNSCORED_S, track_in_all_ways
from .tables import Column, Section, Table

PERSONS, SECONDS = 10, 200.0
FEW_PERSONS, FEW_SECONDS = 2, 60.0
RATE_HZ = 100.0
SEGMENT, NEIGHBOUR = "left_upper_arm", "torso"
# Streams of random numbers that are a sensor's own; the person and the motion are the same for both.
SENSOR_STREAMS = (
    "strap",
    "noise",
    "soft_tissue",
    "device",
    "clock_jitter",
    "clock_offset",
    "clock_drift",
    "dropped",
    "mount",
    "tissue_gain",
    "tissue_random",
    "creep",
    "strap_slip",
    "gyro_warm_up",
)
WAYS = {"open": "open loop", "offline": "offline", "causal": "causal"}  # of `track_in_all_ways` → how it is shown


def sections(quick: bool) -> dict[str, Section]:
    """Name → a function that measures it."""
    size = (FEW_PERSONS, FEW_SECONDS) if quick else (PERSONS, SECONDS)
    return {f"doubled {name}": partial(measure_doubled, name, preset, *size) for name, preset in PRESETS.items()}


def measure_doubled(name: str, preset: Imperfections, persons: int, seconds: float) -> Table:
    """Measure persons who were not calibrated, their mounts stated."""
    table = Table(
        f"Two sensors on the {SEGMENT}: {persons} people of preset {name}, {seconds:g} s of random motion each",
        tuple(
            Column(key, f"{header} [deg]", 2)
            for key, header in (("first", "first alone"), ("second", "second alone"), ("both", "both"))
        ),
        notes=[f"Rms over persons and time of the angle by which the {SEGMENT} against the {NEIGHBOUR} is wrong."],
    )
    errors: dict[str, dict[str, list[float]]] = {way: {"first": [], "second": [], "both": []} for way in WAYS}
    for seed in range(1, persons + 1):
        first, second = simulate_two_sensors(seed, preset, seconds)
        for which, recording in choose_sensors(first, second).items():
            for way, tracked in track_in_all_ways(recording).items():
                errors[way][which].append(measure_error(first, tracked.time, tracked.quat_WL))
    for way, shown in WAYS.items():
        table.rows[shown] = {which: float(np.sqrt(np.mean(np.square(each)))) for which, each in errors[way].items()}
    return table


def simulate_two_sensors(seed: int, preset: Imperfections, seconds: float) -> tuple[Simulation, Simulation]:
    """Simulate one motion of a person twice, with other sensors on other places of the skin."""
    lengths = simulate_person(seed).lengths
    made = []
    for own in (seed, seed + 1_000_000):
        streams = spawn_streams(seed)
        flaws = Flaws(preset, streams, lengths["shoulder_width"])
        motion = FreeMotion(lengths, streams["motion"], seconds, 0, flaws)
        motion.fit_to_person(streams["task"], 0.0)
        others = spawn_streams(own)
        streams |= {stream: others[stream] for stream in SENSOR_STREAMS}
        made.append(measure_motion(motion, streams, RATE_HZ, MTI_3, preset))
    return made[0], made[1]


def choose_sensors(first: Simulation, second: Simulation) -> dict[str, Recording]:
    """Choose the sensors of `SEGMENT`: the first, the second, or both → the recording."""
    one, other = first.recording(), second.recording().sensors[SEGMENT]
    return {
        "first": one,
        "second": replace(one, sensors={**one.sensors, SEGMENT: other}),
        "both": replace(one, doubled={SEGMENT: DoubledSensor(f"{SEGMENT}_2", other)}),
    }


def measure_error(simulation: Simulation, time: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> float:
    """Measure the rms [deg] of the angle by which `SEGMENT` against `NEIGHBOUR` is wrong."""
    rows = np.flatnonzero(time > UNSCORED_S)[::EVERY]
    at = np.searchsorted(simulation.time, time[rows] - 1e-9)
    true, tracked = (
        Rotation.from_quat(quat[NEIGHBOUR][k]).inv() * Rotation.from_quat(quat[SEGMENT][k])
        for quat, k in ((simulation.quat_WL, at), (quat_WL, rows))
    )
    return float(np.degrees(np.sqrt(np.mean((true.inv() * tracked).magnitude() ** 2))))
