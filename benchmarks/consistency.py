"""Whether stated standard deviations hold on simulated people: root mean square of error over standard deviation.

One person after another is drawn, calibrated with arbitrary mounts and tracked on six circles of the right hand after
the clasp. A value of 1 is exact, above it the statement is too small, below it too large.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.validation.contenders import list_contenders
from benchmarks.validation.simulated import compute_mount_errors, orient_recording
from wepose_pin.body.covariance import compute_axis_std
from wepose_pin.body.subject import Subject, mount_rows
from wepose_pin.calibration import assess, calibrate
from wepose_pin.errors import WeposeError
from wepose_pin.simulation import (
    MEASURED_STD,
    PEOPLE_MEASURED_STD,
    PRESETS,
    Person,
    Simulation,
    simulate,
    simulate_person,
)
from wepose_pin.tracking import TrackResult, track

FIRST_SEED = 5000  # of persons that no other measurement or test draws
CLOSED = ("left_upper_arm", "left_forearm", "left_hand", "right_upper_arm", "right_forearm", "right_hand")


def measure_sessions(seed: int, preset: str, sessions: int) -> list[dict[str, Any]]:
    """As `measure_person`, of sessions one after another, each with new mounts and the last subject as its prior."""
    person = simulate_person(seed, PEOPLE_MEASURED_STD if preset == "people" else MEASURED_STD)
    results, prior, measured = [], person.prior, dict(person.measured)
    for session in range(sessions):
        simulation = simulate(
            person.lengths, seed=seed, imperfections=replace(PRESETS[preset], mount="any"), session=session, circles=0
        )
        recording = replace(simulation.recording(), remounted=session > 0)
        subject = calibrate(recording, measured=measured, prior=prior, measured_std=person.measured_std).subject
        results.append({"seed": seed, **compare_subject(subject, person, simulation)})
        prior, measured = subject, {}  # a length is measured once
    return results


def measure_person(seed: int, preset: str, protocol: str = "clasp", trackers: bool = False) -> dict[str, Any]:
    """Errors [m, rad] and standard deviations of a person, by quantity: lists of pairs; of `trackers` as `run`."""
    person = simulate_person(seed, PEOPLE_MEASURED_STD if preset == "people" else MEASURED_STD)
    simulation = simulate(
        person.lengths, seed=seed, imperfections=replace(PRESETS[preset], mount="any"), protocol=protocol
    )
    return {"seed": seed, **measure_simulation(person, simulation, protocol, trackers)}


def measure_simulation(
    person: Person, simulation: Simulation, protocol: str = "clasp", trackers: bool = False
) -> dict[str, Any]:
    """As `measure_person`, of what was simulated."""
    recording = simulation.recording()
    if trackers:
        recording, _ = orient_recording(recording, list_contenders("real")[0]._replace(method=None))
    try:
        calibration = calibrate(
            replace(recording, remounted=True),  # all mounts are unknown
            measured=person.measured,
            prior=person.prior,
            measured_std=person.measured_std,
            protocol=protocol,
        )
    except WeposeError as error:
        return {"error": str(error)}
    compared = {
        "quality": assess(calibration).quality,
        **compare_subject(calibration.subject, person, simulation),
    }
    if not {"circles", "tasks"} & set(recording.phases):
        return compared
    return compared | _compare_pose(track(recording, calibration.subject), simulation)


def compare_subject(subject: Subject, person: Person, simulation: Simulation) -> dict[str, Any]:
    """Errors and standard deviations of a calibrated subject, by quantity: lists of pairs."""
    tilts, headings = [], []
    for name, error in zip(simulation.quat_LS, compute_mount_errors(subject, simulation), strict=True):
        std = [subject.std(row) for row in mount_rows(name)]
        tilts += list(zip(error[:2], std[:2], strict=True))
        headings.append((error[2], std[2]))
    torso = headings[list(simulation.quat_LS).index("torso")]
    mounts = {"mounts, tilt": tilts, "mounts, heading": headings, "torso, heading": [torso]}
    return compare_lengths(subject, person) | mounts


def compare_lengths(subject: Subject, person: Person) -> dict[str, Any]:
    """Errors and standard deviations [m] of a subject's lengths, by quantity: lists of pairs."""
    lengths = [(subject.lengths[name] - person.lengths[name], subject.std(name)) for name in CLOSED]
    arms = []
    for side in ("left", "right"):
        names = [name for name in CLOSED if name.startswith(side)]
        error = sum(subject.lengths[name] - person.lengths[name] for name in names)
        arms.append((error, float(np.sqrt(subject.lengths_covariance(names).sum()))))
    return {"lengths": lengths, "whole arms": arms}


def _compare_pose(tracked: TrackResult, simulation: Simulation) -> dict[str, Any]:
    truth = simulation.truth()
    quat_WL, true_points = truth.quat_WL, truth.points
    begin, end = simulation.phases["tasks" if "tasks" in simulation.phases else "circles"][0]
    rows = np.flatnonzero((tracked.time >= begin) & (tracked.time <= end))[::10]
    segments, points, out = [], {}, {}
    for name, quat in quat_WL.items():
        error = (Rotation.from_quat(tracked.quat_WL[name][rows]) * Rotation.from_quat(quat[rows]).inv()).as_rotvec()
        std = compute_axis_std(tracked.pose.segment_cov[name][rows])
        segments += list(zip(np.sqrt(np.mean(error**2, axis=1)), std, strict=True))
        out[f"segment {name}"] = list(zip(np.sqrt(np.mean(error**2, axis=1)), std, strict=True))
    for name in ("left_shoulder", "right_shoulder", "right_elbow", "right_palm"):
        error = tracked.points[name][rows] - true_points[name][rows]
        std = compute_axis_std(tracked.pose.point_cov[name][rows])
        points[f"point {name}"] = list(zip(np.sqrt(np.mean(error**2, axis=1)), std, strict=True))
    middle = {
        source: 0.5 * (p["left_shoulder"][rows] + p["right_shoulder"][rows])
        for source, p in (("estimated", tracked.points), ("true", true_points))
    }
    from_shoulders = (tracked.points["right_palm"][rows] - middle["estimated"]) - (
        true_points["right_palm"][rows] - middle["true"]
    )
    out["palm from shoulders"] = [(float(e), np.nan) for e in np.sqrt(np.mean(from_shoulders**2, axis=1))]
    return {"segments": segments, **points, **out}


def summarize(results: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Quantity → rms of the error [m or rad], of the standard deviation, and of error over standard deviation."""
    rows: dict[str, dict[str, float]] = {}
    good = [result for result in results if "error" not in result]
    for quantity in good[0] if good else ():
        if not isinstance(good[0][quantity], list):
            continue
        # A person counts as one, however many samples: errors of a person's samples are alike.
        each = [np.array(result[quantity]) for result in good]
        by_std = np.sqrt([np.mean((pairs[:, 0] / pairs[:, 1]) ** 2) for pairs in each])
        rows[quantity] = {
            "error": float(np.sqrt(np.mean([np.mean(pairs[:, 0] ** 2) for pairs in each]))),
            "std": float(np.sqrt(np.mean([np.mean(pairs[:, 1] ** 2) for pairs in each]))),
            "by_std": float(np.sqrt(np.mean(by_std**2))),
            "largest": float(np.max(by_std)),
        }
    return rows


def print_summary(preset: str, results: list[dict[str, Any]]) -> None:
    """Print the table of a preset."""
    failed = [result for result in results if "error" in result]
    grades = [result["quality"] for result in results if "quality" in result]
    counts = ", ".join(f"{grades.count(grade)} {grade}" for grade in sorted(set(grades)))
    print(f"\n{preset}: {len(results)} persons; {counts}; {len(failed)} without a result")
    print(f"{'':24}{'error rms':>12}{'std rms':>12}{'error/std':>12}{'worst person':>14}")
    for quantity, row in summarize(results).items():
        length = quantity.startswith(("lengths", "whole", "point", "palm"))
        factor, unit = (1e3, "mm") if length else (float(np.degrees(1.0)), "deg")
        print(
            f"{quantity:24}{factor * row['error']:9.2f} {unit:3}{factor * row['std']:8.2f} {unit:3}"
            f"{row['by_std']:12.2f}{row['largest']:14.2f}"
        )


def run_sessions(presets: list[str], persons: int, first: int, workers: int, sessions: int) -> None:
    """Measure and print what each later session of a person adds."""
    for preset in presets:
        with ProcessPoolExecutor(workers) as pool:
            seeds = range(first, first + persons)
            results = list(pool.map(measure_sessions, seeds, [preset] * persons, [sessions] * persons))
        for session in range(sessions):
            print_summary(f"{preset}, session {session + 1}", [person[session] for person in results])


def run(
    presets: list[str],
    persons: int,
    first: int = FIRST_SEED,
    workers: int = 2,
    protocol: str = "clasp",
    trackers: bool = False,
) -> None:
    """Measure and print; `trackers`: sensors measure orientations, by the default filter, and no accelerations."""
    for preset in presets:
        with ProcessPoolExecutor(workers) as pool:
            seeds = range(first, first + persons)
            results = list(
                pool.map(measure_person, seeds, *zip(*[(preset, protocol, trackers)] * persons, strict=True))
            )
        print_summary(preset, results)


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(prog="python -m benchmarks.consistency", description=__doc__)
    parser.add_argument("--preset", action="append", choices=sorted(PRESETS), help="of people; may be repeated")
    parser.add_argument("--persons", type=int, default=60, help="number of persons")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first person")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--sessions", type=int, default=1, help="of each person, each with the last subject as prior")
    parser.add_argument("--protocol", default="clasp", help="of the calibration")
    parser.add_argument("--trackers", action="store_true", help="sensors measure orientations and no accelerations")
    options = parser.parse_args()
    if options.sessions > 1:
        chosen = options.preset or list(PRESETS)
        run_sessions(chosen, options.persons, options.first, options.workers, options.sessions)
        raise SystemExit
    presets = options.preset or list(PRESETS)
    run(presets, options.persons, options.first, options.workers, options.protocol, options.trackers)
