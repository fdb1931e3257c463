"""Arbitrary sensor mounting: errors of lengths, mounts and headings from a minute of joined hands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..evaluation import evaluate
from ..model import load_table
from ..rotations import heading
from ..simulation import IDEAL_PRESET, Person, Simulation, simulate
from ..subject import Subject, mount_rows
from ..tracking import track
from .jobs import Job, Result
from .paper import MEASURED, MEASURED_WITH_TRUNK, calibrate_person, collect_hand_errors, list_closed_lengths
from .presets import PRESETS, Preset
from .tables import ARBITRARY_MOUNTING, DEFAULT, DEFAULT_WITH_TRUNK, OURS

TRIALS = 10
ROWS = {DEFAULT: (DEFAULT, MEASURED), DEFAULT_WITH_TRUNK: (DEFAULT, MEASURED_WITH_TRUNK), OURS: (OURS, MEASURED)}


def list_experiments(quick: bool = False, trials: int | None = None) -> dict[str, list[Job]]:
    """List the jobs of each experiment; `quick`: one trial; `trials`: at most so many."""
    count = 1 if quick else min(TRIALS, trials or TRIALS)
    jobs = {}
    for label, preset in PRESETS.items():
        name = f"{ARBITRARY_MOUNTING}, {label}"
        if preset.imperfections != IDEAL_PRESET:
            jobs[name] = [Job(name, str(k), _arbitrary_mounting, (k, preset)) for k in range(count)]
    return jobs


def _arbitrary_mounting(experiment: str, trial: str, seed: int, preset: Preset) -> list[Result]:
    """Calibrate without stated mounts, then track six circles."""
    person = preset.sample_person(seed)
    simulation = simulate(person.lengths, seed=seed, imperfections=replace(preset.imperfections, mount="any"))
    recording, truth = simulation.recording(), simulation.truth()
    results = []
    for label, (method, measured) in ROWS.items():
        subject = calibrate_person(recording, person, method, person.prior, measured=measured)
        errors = evaluate(track(recording, subject, method=method).pose, truth, simulation.phases["circles"][0])
        figures = collect_hand_errors(errors) | _compute_calibration_errors(subject, person, simulation)
        results.append(Result(experiment, trial, label, figures))
    return results


def _compute_calibration_errors(subject: Subject, person: Person, simulation: Simulation) -> dict[str, float]:
    """Compute errors of the calibration, also as multiples of its standard deviations."""
    table = load_table()
    names = list_closed_lengths(table)
    lengths = np.array([subject.lengths[name] - person.lengths[name] for name in names])
    order = list(simulation.quat_LS)
    mounts = compute_mount_errors(subject, simulation)
    stated = np.array([[subject.std(row) for row in mount_rows(name)] for name in order])
    by_std = [*(lengths / [subject.std(name) for name in names]), *(mounts / stated).ravel()]
    return {
        "lengths_rms_mm": 1e3 * _rms(lengths),
        "headings_rms_deg": float(np.degrees(_rms(mounts[:, 2]))),
        f"{table.reference}_heading_rms_deg": float(np.degrees(abs(mounts[order.index(table.reference), 2]))),
        "tilts_rms_deg": float(np.degrees(_rms(mounts[:, :2]))),
        "errors_by_std_rms": _rms(np.array(by_std)),
    }


def compute_mount_errors(subject: Subject, simulation: Simulation) -> np.ndarray:
    """Compute the errors (sensors, 3) [rad] of the mounts in L, the heading last.

    A mount's heading is relative to the start pose, however the person turned the segment in it: no closure shows that
    turn, and it is in the ± of what is tracked.
    """
    start = simulation.time <= simulation.phases["start"][0][1]
    facing = float(heading(Rotation.from_quat(simulation.quat_WL[load_table().reference][start]).mean().as_quat()))
    turn = Rotation.from_rotvec([0.0, 0.0, -facing])
    errors = []
    for name, quat_LS in simulation.quat_LS.items():
        R_LS = Rotation.from_quat(subject.mounts[name])
        error = (R_LS * Rotation.from_quat(quat_LS).inv()).as_rotvec()
        R_WS_start = turn * Rotation.from_quat(simulation.quat_WS[name][start]).mean()
        errors.append([*error[:2], (R_LS * R_WS_start.inv()).as_rotvec()[2]])
    return np.array(errors)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
