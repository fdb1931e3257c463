"""Whether stated standard deviations hold on simulated people: root mean square of error over standard deviation.

One person after another is drawn, calibrated with arbitrary mounts and tracked on circles of the right hand after the
clasp. A value of 1 is exact, above it the statement is too small, below it too large.
"""

from __future__ import annotations

import argparse
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.validation.simulated import compute_mount_errors
from wepose_pin.angles import joint_angles
from wepose_pin.angles.euler import wrap
from wepose_pin.body.kinematics import compute_axis_std
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
    simulate_activity,
    simulate_person,
)
from wepose_pin.tracking import TrackResult, track

FIRST_SEED = 5000  # of persons that no other measurement or test draws
CLOSED = ("left_upper_arm", "left_forearm", "left_hand", "right_upper_arm", "right_forearm", "right_hand")
SCORED_POINTS = ("left_shoulder", "right_shoulder", "right_elbow", "right_palm")
SCORED_JOINTS, SHOULDER_SEQUENCE = ("right_shoulder", "right_elbow"), "ZXY"  # whose lock a working arm is far from
FREE = "free"  # no closure: reaches, rests and typing


def measure_person(seed: int, preset: str, own: dict[str, Any], protocol: str, seconds: float) -> dict[str, Any]:
    """Errors [m, rad] and standard deviations of a person, by quantity: lists of pairs; or why there are none."""
    person = simulate_person(seed, PEOPLE_MEASURED_STD if preset == "people" else MEASURED_STD)
    sizes = replace(PRESETS[preset], mount="any", **own)
    try:
        if protocol == FREE:
            simulation = simulate_activity(
                "tasks", seed=seed, imperfections=sizes, seconds=seconds, lengths=person.lengths
            )
        else:
            simulation = simulate(person.lengths, seed=seed, imperfections=sizes, protocol=protocol, clasp_s=seconds)
        recording = simulation.recording()
        calibration = calibrate(
            replace(recording, remounted=True),  # all mounts are unknown
            measured=person.measured,
            prior=person.prior,
            measured_std=person.measured_std,
            protocol=protocol,
        )
    except WeposeError as error:
        return {"seed": seed, "error": str(error)}
    return {
        "seed": seed,
        "quality": assess(calibration).quality,
        **compare_subject(calibration.subject, person, simulation),
        **compare_pose(track(recording, calibration.subject, accept_failed=True), simulation),
    }


def compare_subject(subject: Subject, person: Person, simulation: Simulation) -> dict[str, Any]:
    """Errors and standard deviations of a calibrated subject, by quantity: lists of pairs."""
    off = {name: subject.lengths[name] - person.lengths[name] for name in CLOSED}
    arms = []
    for side in ("left", "right"):
        names = [name for name in CLOSED if name.startswith(side)]
        arms.append((sum(off[name] for name in names), float(np.sqrt(subject.lengths_covariance(names).sum()))))
    tilts, headings = [], {}
    for name, error in zip(simulation.quat_LS, compute_mount_errors(subject, simulation), strict=True):
        std = [subject.std(row) for row in mount_rows(name)]
        tilts += list(zip(error[:2], std[:2], strict=True))
        headings[name] = (error[2], std[2])
    return {
        "lengths": [(error, subject.std(name)) for name, error in off.items()],
        "whole arms": arms,
        "mounts, tilt": tilts,
        "mounts, heading": list(headings.values()),
        "torso, heading": [headings["torso"]],
    }


def compare_pose(tracked: TrackResult, simulation: Simulation) -> dict[str, Any]:
    """Errors and standard deviations of a tracked person during circles or tasks, by quantity: lists of pairs."""
    truth = simulation.truth()
    begin, end = simulation.phases["tasks" if "tasks" in simulation.phases else "circles"][0]
    rows = np.flatnonzero((tracked.time >= begin) & (tracked.time <= end))[::10]

    def pair(error: np.ndarray, cov: np.ndarray) -> list[tuple[float, float]]:
        return list(zip(np.sqrt(np.mean(error**2, axis=1)), compute_axis_std(cov[rows]), strict=True))

    segments = {}
    for name, quat in truth.quat_WL.items():
        error = (Rotation.from_quat(tracked.quat_WL[name][rows]) * Rotation.from_quat(quat[rows]).inv()).as_rotvec()
        segments[f"segment {name}"] = pair(error, tracked.pose.segment_cov[name])
    errors = {name: tracked.points[name][rows] - truth.points[name][rows] for name in SCORED_POINTS}
    points = {f"point {name}": pair(error, tracked.pose.point_cov[name]) for name, error in errors.items()}
    from_shoulders = errors["right_palm"] - 0.5 * (errors["left_shoulder"] + errors["right_shoulder"])
    palm = [(float(error), np.nan) for error in np.sqrt(np.mean(from_shoulders**2, axis=1))]
    whole = [each for pairs in segments.values() for each in pairs]
    angles = {}
    estimated, true = (joint_angles(pose, SHOULDER_SEQUENCE) for pose in (tracked.pose, truth))
    for joint in SCORED_JOINTS:
        std = estimated[joint].std
        assert std is not None  # the filter has a covariance
        read = rows[~(estimated[joint].near_lock | true[joint].near_lock)[rows]]
        for k, angle in enumerate(estimated[joint]):
            off = wrap(estimated[joint][angle] - true[joint][angle])[read]
            angles[f"{joint} {angle}"] = list(zip(off, std[read, k], strict=True)) or [(np.nan, np.nan)]
    return {"segments": whole, **points, **segments, "palm from shoulders": palm, **angles}


def summarize(results: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Quantity → rms of the error [m or rad], of the standard deviation, and of error over standard deviation."""
    rows: dict[str, dict[str, float]] = {}
    good = [result for result in results if "error" not in result]
    for quantity in good[0] if good else ():
        if not isinstance(good[0][quantity], list):
            continue
        # A person counts as one, however many samples: errors of a person's samples are alike.
        each = [np.array(result[quantity]) for result in good]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a mean of NaN alone: of a quantity without a ±
            by_std = np.sqrt([np.nanmean((pairs[:, 0] / pairs[:, 1]) ** 2) for pairs in each])
            rows[quantity] = {
                "error": float(np.sqrt(np.nanmean([np.nanmean(pairs[:, 0] ** 2) for pairs in each]))),
                "std": float(np.sqrt(np.nanmean([np.nanmean(pairs[:, 1] ** 2) for pairs in each]))),
                "by_std": float(np.sqrt(np.nanmean(by_std**2))),
                "largest": float(np.nanmax(by_std)),
            }
    return rows


def print_summary(preset: str, results: list[dict[str, Any]]) -> None:
    """Print the table of a preset."""
    failed = [result for result in results if "error" in result]
    grades = [result["quality"] for result in results if "quality" in result]
    counts = ", ".join(f"{grades.count(grade)} {grade}" for grade in sorted(set(grades)))
    print(f"\n{preset}: {len(results)} persons; {counts}; {len(failed)} without a result")
    print(f"{'':32}{'error rms':>12}{'std rms':>12}{'error/std':>12}{'worst person':>14}")
    for quantity, row in summarize(results).items():
        length = quantity.startswith(("lengths", "whole", "point", "palm"))
        factor, unit = (1e3, "mm") if length else (float(np.degrees(1.0)), "deg")
        print(
            f"{quantity:32}{factor * row['error']:9.2f} {unit:3}{factor * row['std']:8.2f} {unit:3}"
            f"{row['by_std']:12.2f}{row['largest']:14.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.consistency", description=__doc__)
    parser.add_argument("--preset", action="append", choices=sorted(PRESETS), help="of people; may be repeated")
    parser.add_argument("--imperfection", action="append", default=[], help="another size of one, NAME=VALUE")
    parser.add_argument("--persons", type=int, default=60, help="number of persons")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first person")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--protocol", default="clasp", help=f"of the calibration; {FREE}: tasks without any closure")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the protocol")
    options = parser.parse_args()
    own = {name: float(size) for name, size in (each.split("=") for each in options.imperfection)}
    for name in options.preset or list(PRESETS):
        measure = partial(measure_person, preset=name, own=own, protocol=options.protocol, seconds=options.seconds)
        with ProcessPoolExecutor(options.workers) as pool:
            print_summary(name, list(pool.map(measure, range(options.first, options.first + options.persons))))
