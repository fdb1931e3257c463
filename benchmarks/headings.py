"""Relative headings of simulated people who move at random, with and without their correction."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin.recording import Recording
from wepose_pin.rotations import heading
from wepose_pin.simulation import MILD_PRESET, PEOPLE_PRESET, Imperfections, Simulation, simulate, simulate_person
from wepose_pin.simulation.motion import TASKS
from wepose_pin.tracking import TrackResult, track

from .free_motion import FreeMotion
from .tables import Column, Section, Table

PERSONS, SECONDS = 5, 600.0
FEW_PERSONS, FEW_SECONDS = 2, 120.0
UNSCORED_S = 10.0  # [s] at the beginning, in which causal tracking knows little more than the start pose
EVERY = 25  # samples from one that is scored to the next
LIMBS = (("torso", "left_upper_arm", "left_forearm"), ("torso", "right_upper_arm", "right_forearm"))
# The torso's turn against W is none of the headings': W's x is where it faces.
PRESETS = {"people": replace(PEOPLE_PRESET, start_heading_deg=0.0), "mild": MILD_PRESET}


def sections(quick: bool) -> dict[str, Section]:
    """Name → a function that measures it."""
    size = (FEW_PERSONS, FEW_SECONDS) if quick else (PERSONS, SECONDS)
    return {f"headings {name}": partial(measure_headings, name, preset, *size) for name, preset in PRESETS.items()}


def measure_headings(name: str, preset: Imperfections, persons: int, seconds: float) -> Table:
    """Persons who were not calibrated, their mounts stated."""
    table = Table(
        f"Relative headings: {persons} people of preset {name}, {seconds / 60.0:g} min of random motion each",
        (
            Column("open", "open loop [deg]", 2),
            Column("offline", "offline [deg]", 2),
            Column("offline_by_std", "by its std", 2),
            Column("causal", "causal [deg]", 2),
            Column("causal_by_std", "by its std", 2),
            Column("segment_open", "segments, open loop [deg]", 2),
            Column("segment_offline", "segments, offline [deg]", 2),
            Column("segment_offline_by_std", "by its std", 2),
            Column("segment_causal", "segments, causal [deg]", 2),
            Column("segment_causal_by_std", "by its std", 2),
        ),
        notes=[
            "Rms over persons and time of the heading of a sensor's world against its neighbour's, soft tissue left "
            "out; those of the segments include soft tissue and start pose, which no heading corrects. No clasp, no "
            "static phase, no calibration."
        ],
    )
    squares: dict[str, dict[str, list[float]]] = {}
    for seed in range(1, persons + 1):
        simulation = simulate_free_motion(seed, preset, seconds)
        tracked = track_in_all_ways(simulation.recording())
        for kind, of in tracked.items():
            for row, figures in compare_headings(simulation, of).items():
                for key, value in figures.items():
                    column = key.replace("sensor", kind).replace("segment", f"segment_{kind}")
                    squares.setdefault(row, {}).setdefault(column, []).append(value**2)
    for row, columns in squares.items():
        table.rows[row] = {column: float(np.sqrt(np.mean(values))) for column, values in columns.items()}
    return table


def simulate_free_motion(seed: int, preset: Imperfections, seconds: float) -> Simulation:
    """Simulate a person whose hands move at random, each by itself."""
    TASKS.setdefault(FreeMotion.name, FreeMotion)
    person = simulate_person(seed)
    return simulate(
        person.lengths, seed=seed, imperfections=preset, clasp_s=seconds, circles=0, protocol=FreeMotion.name
    )


def track_in_all_ways(recording: Recording) -> dict[str, TrackResult]:
    """Track a recording with its start phase alone: in open loop, and with headings corrected offline and causally."""
    recording = replace(recording, phases={"start": recording.phases["start"]})
    return {
        "open": track(recording, open_loop=True),
        "offline": track(recording),
        "causal": track(recording, causal=True),
    }


def compare_headings(simulation: Simulation, tracked: TrackResult) -> dict[str, dict[str, float]]:
    """Each segment against its neighbour: rms of the heading [deg] of sensor and segment, and of error over std."""
    time = tracked.time
    rows = np.flatnonzero(time > UNSCORED_S)[::EVERY]
    at = np.searchsorted(simulation.time, time[rows] - 1e-9)
    sensor, segment = {}, {}
    for name, quat_WL in tracked.quat_WL.items():
        R_WL = Rotation.from_quat(quat_WL[rows])
        R_WS = R_WL * Rotation.from_quat(tracked.segments.quat_LS[name])
        sensor[name] = heading((Rotation.from_quat(simulation.quat_WS[name][at]) * R_WS.inv()).as_quat())
        segment[name] = heading((Rotation.from_quat(simulation.quat_WL[name][at]) * R_WL.inv()).as_quat())
    result = {}
    for limb in LIMBS:
        for near, far in pairwise(limb):
            error = np.angle(np.exp(1j * (sensor[near] - sensor[far])))
            of_segment = np.angle(np.exp(1j * (segment[near] - segment[far])))
            figures = {"sensor": np.degrees(_rms(error)), "segment": np.degrees(_rms(of_segment))}
            if tracked.correction is not None:
                relative_std = tracked.correction.relative_std(near, far, time[rows])
                figures["sensor_by_std"] = _rms(error / relative_std)
                # As a user would add what the result states: a drift that both have in common counts twice.
                stated = sum(tracked.pose.segment_cov[name][rows, 2, 2] for name in (near, far))
                figures["segment_by_std"] = _rms(of_segment / np.sqrt(stated))
            result[f"{far} to {near}"] = figures
    return result


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
