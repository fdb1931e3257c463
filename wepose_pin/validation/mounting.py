"""Arbitrary sensor mounting: errors of lengths, mounts and headings from a minute of joined hands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration import calibrate_lengths
from ..evaluation import evaluate
from ..model import load_table
from ..simulation import CIRCLING_POINT, MILD_PRESET, Person, Simulation, simulate, simulate_person
from ..subject import Subject, mount_rows
from ..tracking import track
from .jobs import Job, Result
from .paper import list_closed_lengths
from .tables import ARBITRARY_MOUNTING

METHODS = ("amekf", "smekf")


def list_experiments(quick: bool = False) -> dict[str, list[Job]]:
    """List the jobs of each experiment; `quick`: one trial."""
    trials = range(1 if quick else 10)
    return {ARBITRARY_MOUNTING: [Job(ARBITRARY_MOUNTING, str(k), _arbitrary_mounting, (k,)) for k in trials]}


def _arbitrary_mounting(experiment: str, trial: str, seed: int) -> list[Result]:
    """Calibrate without stated mounts, with measured shoulder width and trunk, then track six circles."""
    person = simulate_person(seed)
    simulation = simulate(person.lengths, seed=seed, imperfections=replace(MILD_PRESET, mount="any"))
    recording, truth = simulation.recording(), simulation.truth()
    results = []
    for method in METHODS:
        subject = calibrate_lengths(
            recording, measured=person.measured, prior=person.prior, method=method, measured_std=person.measured_std
        ).subject
        errors = evaluate(track(recording, subject, method=method).pose, truth, simulation.phases["circles"][0])
        figures = _compute_calibration_errors(subject, person, simulation) | {
            "hand_mm": errors.position[CIRCLING_POINT]._asdict(),
            "hand_from_shoulders_mm": errors.position_on_limb[CIRCLING_POINT]._asdict(),
        }
        results.append(Result(experiment, trial, method, figures))
    return results


def _compute_calibration_errors(subject: Subject, person: Person, simulation: Simulation) -> dict[str, float]:
    """Compute errors of the calibration, also as multiples of its standard deviations."""
    table = load_table()
    names = list_closed_lengths(table)
    lengths = np.array([subject.lengths[name] - person.lengths[name] for name in names])
    order = list(simulation.quat_LS)
    mounts = np.array(
        [
            (Rotation.from_quat(subject.mounts[name]) * Rotation.from_quat(quat).inv()).as_rotvec()
            for name, quat in simulation.quat_LS.items()
        ]
    )
    stated = np.array([[subject.std(row) for row in mount_rows(name)] for name in order])
    by_std = [*(lengths / [subject.std(name) for name in names]), *(mounts / stated).ravel()]
    return {
        "lengths_rms_mm": 1e3 * _rms(lengths),
        "headings_rms_deg": float(np.degrees(_rms(mounts[:, 2]))),
        f"{table.reference}_heading_rms_deg": float(np.degrees(abs(mounts[order.index(table.reference), 2]))),
        "tilts_rms_deg": float(np.degrees(_rms(mounts[:, :2]))),
        "errors_by_std_rms": _rms(np.array(by_std)),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
