"""What the correction of headings is worth against none, for simulated people who do different things."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin.body.kinematics import Pose
from wepose_pin.rotations import heading
from wepose_pin.simulation import (
    MTI_3,
    NOISE_FREE,
    PRESETS,
    Imperfections,
    ImuNoise,
    Simulation,
    simulate,
    simulate_activity,
    simulate_person,
)
from wepose_pin.simulation.activities import ACTIVITIES
from wepose_pin.tracking import TrackResult, track

from .tables import Column, Section, Table, rms

GOOD = MTI_3  # 0.007 deg/s/√Hz, 10 deg/h
POOR = replace(MTI_3, gyro_density=np.deg2rad(0.03), gyro_bias_instability=np.deg2rad(100.0) / 3600.0)
GYROSCOPES = {"good": GOOD, "poor": POOR, "perfect": NOISE_FREE}
# With perfect gyroscopes nothing else of a sensor is wrong either: what remains of a heading's error is the person's.
_SENSOR = ("gyro_", "accel_", "misalignment", "g_sensitivity", "bits", "clock_", "dropped")
PERFECT_SENSOR = {name: size for name, size in vars(Imperfections()).items() if name.startswith(_SENSOR)}
WAYS = ("open", "offline", "causal")
SECONDS = 60.0
SCORED_FROM_S = 8.0  # the activity has begun
EVERY_S = 0.1
# A correction does no harm within these: of the open loop's error, and beside it [deg].
HARMLESS_RATIO, HARMLESS_DEG = 1.2, 0.5
LARGE_DEG = 5.0  # of the open loop, from which on it is to be halved


class Case(NamedTuple):
    """What is simulated in one row of the table."""

    preset: str
    activity: str  # of `ACTIVITIES`, or clasp, the protocol
    gyroscope: str
    averaged: bool  # the accelerometer averages over its sample
    rate_hz: float

    @property
    def name(self) -> str:
        accelerometer = "averaged" if self.averaged else "instant"
        return f"{self.preset} {self.activity}, {self.gyroscope} gyroscopes, {accelerometer}, {self.rate_hz:g} Hz"


def sections(quick: bool) -> list[Section]:
    """List the functions that measure; `quick`: one seed, 100 Hz, no ideal people, no sitting."""
    activities = ("walk", "run", "throw", "tasks", "clasp", *(() if quick else ("sit",)))
    cases = [
        Case(preset, activity, gyroscope, averaged, rate_hz)
        for preset in (("mild", "people") if quick else PRESETS)
        for activity in activities
        for gyroscope in GYROSCOPES
        for averaged in (False, True)
        for rate_hz in ((100.0,) if quick else (50.0, 100.0, 400.0))
        if gyroscope != "perfect" or (preset == "people" and rate_hz == 100.0 and not averaged)
        if not quick or gyroscope == "perfect" or averaged == (activity in ("run", "throw"))
    ]
    return [partial(measure_harm, cases, range(1, 2 if quick else 4))]


def measure_harm(cases: list[Case], seeds: range) -> Table:
    """Measure each case by each way of tracking."""
    table = Table(
        f"Headings with and without correction: {len(seeds)} people a row, {SECONDS:g} s each",
        (
            Column("open", "open loop [deg]", 2),
            Column("offline", "default [deg]", 2),
            Column("causal", "causal [deg]", 2),
            Column("open_by_std", "open loop by its std", 2),
            Column("offline_by_std", "default by its std", 2),
            Column("causal_by_std", "causal by its std", 2),
        ),
        notes=["Rms of the headings of all segments; mounts stated, nothing calibrated, no phase but the start."],
    )
    harmed, small = [], []
    for case in cases:
        row = measure_case(case, seeds)
        table.rows[case.name] = row
        for way in ("offline", "causal"):
            if row[way] > HARMLESS_RATIO * row["open"] + HARMLESS_DEG:
                harmed.append(f"{case.name} ({way})")
            elif case.gyroscope != "perfect" and row["open"] > LARGE_DEG and row[way] > 0.5 * row["open"]:
                small.append(f"{case.name} ({way})")
    limit = f"{HARMLESS_RATIO:g} times the open loop and {HARMLESS_DEG:g} deg"
    table.notes += [
        f"Above {limit}: {len(harmed)} of {2 * len(cases)}{': ' if harmed else ''}{'; '.join(harmed)}.",
        f"Open loop above {LARGE_DEG:g} deg and not halved: {len(small)}{': ' if small else ''}{'; '.join(small)}.",
    ]
    return table


def measure_case(case: Case, seeds: range) -> dict[str, float]:
    """Rms of the headings [deg] and of their errors over the stated std, by each way."""
    figures: dict[str, list[float]] = {}
    for seed in seeds:
        simulation = simulate_case(case, seed)
        recording = simulation.recording()
        recording = replace(recording, phases={"start": recording.phases["start"]})
        body = ACTIVITIES[case.activity].body if case.activity in ACTIVITIES else None
        truth = simulation.truth()
        for way in WAYS:
            tracked = track(recording, model=body, open_loop=way == "open", causal=way == "causal")
            errors, stds = find_heading_errors(truth, tracked)
            figures.setdefault(way, []).append(float(np.degrees(rms(errors))))
            figures.setdefault(f"{way}_by_std", []).append(rms(errors / stds))
    return {name: rms(np.array(values)) for name, values in figures.items()}


def simulate_case(case: Case, seed: int) -> Simulation:
    """Simulate one person of a case."""
    noise: ImuNoise = GYROSCOPES[case.gyroscope]
    sizes = replace(PRESETS[case.preset], accel_average=1.0 if case.averaged else 0.0)
    if case.gyroscope == "perfect":
        sizes = replace(sizes, **PERFECT_SENSOR)
    if case.activity in ACTIVITIES:
        return simulate_activity(
            case.activity, seed=seed, rate_hz=case.rate_hz, noise=noise, imperfections=sizes, seconds=SECONDS
        )
    lengths = simulate_person(seed).lengths
    return simulate(
        lengths, seed=seed, rate_hz=case.rate_hz, noise=noise, imperfections=sizes, clasp_s=SECONDS, circles=0
    )


def find_heading_errors(truth: Pose, tracked: TrackResult) -> tuple[np.ndarray, np.ndarray]:
    """Find the errors of all segments' headings over time and their stated standard deviations, both (m,) [rad].

    Both poses are in the W whose x is where the torso faces in the start pose.
    """
    time = tracked.time
    step = max(1, round(EVERY_S * tracked.recording.rate_hz))
    rows = np.flatnonzero(time > SCORED_FROM_S)[::step]
    at = np.searchsorted(truth.time, time[rows] - 1e-9)
    errors, stds = [], []
    for name, quat_WL in tracked.quat_WL.items():
        error = Rotation.from_quat(truth.quat_WL[name][at]) * Rotation.from_quat(quat_WL[rows]).inv()
        errors.append(heading(error.as_quat()))
        stds.append(np.sqrt(tracked.pose.segment_cov[name][rows, 2, 2]))
    return np.concatenate(errors), np.concatenate(stds)
