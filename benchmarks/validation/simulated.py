"""The paper's three experiments on simulated sensors and people with exact truth, arbitrary mounting, error budget.

The bias measured in the static phase is removed for every filter, and the heading is aligned once, in that phase, and
never fitted to the truth afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from wepose_pin import rotations
from wepose_pin.body import ROOT, BodyTable, load_table
from wepose_pin.body.subject import Subject, mount_rows
from wepose_pin.calibration import Formulation, calibrate
from wepose_pin.evaluation import AttitudeError, Evaluation, attitude_error, evaluate
from wepose_pin.filters.phases import estimate_noise
from wepose_pin.recording import OrientationSensor, Recording
from wepose_pin.simulation import (
    CIRCLING_POINT,
    IDEAL_PRESET,
    MEASURED_LENGTHS,
    MEASURED_STD,
    PEOPLE_MEASURED_STD,
    PEOPLE_PRESET,
    Imperfections,
    Person,
    Simulation,
    simulate,
    simulate_person,
)
from wepose_pin.simulation import PRESETS as SIZES
from wepose_pin.tracking import track

from ..tables import rms
from .contenders import DEFAULT, OURS, Contender, list_contenders
from .experiment import Job, Result, align_rotation
from .single import SingleSensor, simulate_paper_drift, simulate_paper_dynamic

UPPER_BODY = "upper body"  # the experiment, one of each preset: "upper body, mild"
ARBITRARY_MOUNTING, ERROR_BUDGET = "arbitrary sensor mounting", "error budget"
# W's x is where the torso faces in the start pose: one who faces elsewhere than the feet turns W and nothing else.
PRESETS = SIZES | {"people": replace(PEOPLE_PRESET, start_heading_deg=0.0)}
# Rows of the upper body that are no filters of their own.
WITH_TRUNK = ", trunk measured"  # beside the shoulder width
AS_COMMANDED = f"{DEFAULT}, mounts as stated"  # by the session, to the next axis, and the start pose
ORIENTATIONS_ALONE = f"{DEFAULT}, orientations alone"  # without joint accelerations and covariance, as others enter
CAUSAL = f"{DEFAULT}, causal"  # tracked as live, with past samples only
LENGTHS_ALONE = f"{OURS}, lengths alone"  # calibrated in the paper's formulation
OPEN_LOOP = f"{OURS}, open loop"  # tracked without heading correction
PROTOCOL = f"{OURS}, the paper's protocol"  # both, and mounts by the session and the start pose

AXES = ("roll", "pitch", "yaw")
RATES = {"100 Hz": 100.0, "1 kHz": 1000.0}
MEASURED, MEASURED_WITH_TRUNK = MEASURED_LENGTHS[:1], MEASURED_LENGTHS  # lengths that are measured beforehand
KNOWN_MOUNT_STD = np.deg2rad(0.5)  # stated standard deviation of exact mounts
TRIALS = {"dynamic": 12, "drift": 10, UPPER_BODY: 10, ARBITRARY_MOUNTING: 10, ERROR_BUDGET: 10}  # the paper's; ours
# Parts of the error budget: parts of the chain known exactly, or not as well; then groups of imperfections switched
# off, by how their names begin. An imperfection that is in none of them is a group of its own.
CHAIN_PARTS = ("all on", "orientations exact", "lengths exact", "trunk measured", "mounts as stated")
GROUPS = {
    "soft tissue off": ("tissue_",),
    "shoulder girdle off": ("girdle",),
    "palm slip off": ("palm_slip",),
    "wrists straight": ("wrists",),
    "elbows as hinges": ("elbow",),
    "start pose exact": ("start_",),
    "sway and breath off": ("sway",),
    "gyro and accel errors off": (
        *("gyro_scale", "accel_scale", "misalignment_deg", "g_sensitivity_deg_s"),
        *("gyro_range_deg_s", "accel_range_g", "bits", "gyro_warm_up_deg_s"),
    ),
    "clocks exact, none lost": ("clock_", "dropped"),
}


def list_experiments(quick: bool = False) -> dict[str, list[Job]]:
    """List the jobs of each experiment; `quick`: one trial of each, and no error budget."""
    experiments = {}

    def add(name: str, kind: str, function: Callable[..., list[Result]], *arguments: object) -> None:
        trials = range(1 if quick else TRIALS[kind])
        experiments[name] = [Job(str(seed), function, (seed, *arguments)) for seed in trials]

    for rate, rate_hz in RATES.items():
        add(f"dynamic {rate}", "dynamic", _dynamic, rate, rate_hz)
    add("drift", "drift", _drift)
    for preset in PRESETS:
        add(f"{UPPER_BODY}, {preset}", UPPER_BODY, _upper_body, preset)
    for preset in ("mild", "people"):
        add(f"{ARBITRARY_MOUNTING}, {preset}", ARBITRARY_MOUNTING, _arbitrary_mounting, preset)
        if not quick:
            add(f"{ERROR_BUDGET}, {preset}", ERROR_BUDGET, _error_budget, preset)
    return experiments


def switch_off(imperfections: Imperfections) -> dict[str, Imperfections]:
    """Switch off each group of imperfections that is on: label → the others."""
    on = [
        field.name
        for field in fields(imperfections)
        if field.name != "sensor_place"  # which is no imperfection
        and getattr(imperfections, field.name) != getattr(IDEAL_PRESET, field.name)
    ]
    groups = {label: [name for name in on if name.startswith(starts)] for label, starts in GROUPS.items()}
    grouped = {name for names in groups.values() for name in names}
    groups |= {f"{name} off": [name] for name in on if name not in grouped}
    return {
        label: replace(imperfections, **{name: getattr(IDEAL_PRESET, name) for name in names})
        for label, names in groups.items()
        if names
    }


def _dynamic(seed: int, rate: str, rate_hz: float) -> list[Result]:
    """Run the dynamic experiment: 5 s static, 50 s of free motion, 5 s static; errors over the motion."""
    sensor = simulate_paper_dynamic(seed, rate_hz)
    return [
        Result(label, {f"{axis} [deg]": getattr(scored, axis) for axis in AXES})
        for label, scored, _ in _run_single(sensor, f"simulated {rate}")
    ]


def _drift(seed: int) -> list[Result]:
    """Run the drift experiment: 25 s static, 10 s of shaking and rotating, 25 s static.

    The heading error is the change from before the motion to after it.
    """
    sensor = simulate_paper_drift(seed)
    after = sensor.time > sensor.moving[1] + 1.0
    results = []
    for label, _, error in _run_single(sensor, "simulated 1 kHz"):
        angles = np.abs(error.as_euler("ZYX", degrees=True)[after, ::-1]).mean(axis=0)
        heading = np.degrees(np.unwrap(rotations.heading(error.as_quat())))
        slope = 60.0 * abs(float(np.polyfit(sensor.time[after], heading[after], 1)[0]))
        figures = {f"{axis} [deg]": float(angle) for axis, angle in zip(AXES, angles, strict=True)}
        results.append(Result(label, {**figures, "drift [deg/min]": slope}))
    return results


def _run_single(sensor: SingleSensor, setting: str) -> Iterator[tuple[str, AttitudeError, Rotation]]:
    """Run the contenders; iterates over label, error over the motion, and error rotation of each sample.

    Headings are aligned in the static phase.
    """
    rest = (sensor.time >= sensor.static[0][0] + 0.5) & (sensor.time <= sensor.static[0][1] - 0.5)
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    true = Rotation.from_quat(sensor.quat_WS)
    noise = estimate_noise(sensor.gyro_S[rest], sensor.accel_S[rest], sensor.rate_hz)
    for contender in list_contenders(setting):
        quat = contender.orient(sensor.gyro_S, sensor.accel_S, sensor.rate_hz, noise)
        R_WS = align_rotation(Rotation.from_quat(quat), true, rest)
        yield contender.label, attitude_error(R_WS[moving], true[moving], sensor.time[moving]), R_WS * true.inv()


@lru_cache(maxsize=1)
def _simulate_person(seed: int, preset: str, imperfections: Imperfections) -> tuple[Person, Simulation]:
    person = simulate_person(seed, PEOPLE_MEASURED_STD if preset == "people" else MEASURED_STD)
    return person, simulate(person.lengths, seed=seed, imperfections=imperfections)


def _upper_body(seed: int, preset: str) -> list[Result]:
    """Calibrate by each filter with a measured shoulder width and known mounts, then track six circles.

    smekf has a row for each part of the paper's protocol, one for the whole of it, and one with a measured trunk;
    amekf, the default, has one with the mounts that a session states, one as live, and one that enters as the filters
    of other packages do.
    """
    person, simulation = _simulate_person(seed, preset, PRESETS[preset])
    recorded, truth = simulation.recording(), simulation.truth()
    circles = simulation.phases["circles"][0]
    exact, stated = set_exact_mounts(person.prior, simulation), person.prior
    results = []

    def score(label: str, recording: Recording, subject: Subject, method: str, **options: Any) -> None:
        pose = track(recording, subject, method=method, **options).pose
        figures = collect_hand_errors(evaluate(pose, truth, circles)) | compare_lengths(subject, person)
        results.append(Result(label, figures))

    for contender in list_contenders(f"{UPPER_BODY}, {preset}"):
        recording, method = orient_recording(recorded, contender)
        subject = calibrate_person(recording, person, method, exact)
        score(contender.label, recording, subject, method)
        if contender.label == DEFAULT:
            score(AS_COMMANDED, recording, calibrate_person(recording, person, DEFAULT, stated), DEFAULT)
            score(CAUSAL, recording, subject, DEFAULT, causal=True)
            alone, _ = orient_recording(recorded, contender._replace(method=None))
            score(ORIENTATIONS_ALONE, alone, calibrate_person(alone, person, DEFAULT, exact), DEFAULT)
        if contender.label == OURS:
            with_trunk = calibrate_person(recording, person, OURS, exact, measured=MEASURED_WITH_TRUNK)
            score(OURS + WITH_TRUNK, recording, with_trunk, OURS)
            lengths_alone = calibrate_person(recording, person, OURS, exact, formulation="paper")
            score(LENGTHS_ALONE, recording, lengths_alone, OURS)
            score(OPEN_LOOP, recording, subject, OURS, open_loop=True)
            as_in_paper = calibrate_person(recording, person, OURS, stated, formulation="paper")
            score(PROTOCOL, recording, as_in_paper, OURS, open_loop=True)
    return results


def _arbitrary_mounting(seed: int, preset: str) -> list[Result]:
    """Calibrate without stated mounts, then track six circles."""
    person, simulation = _simulate_person(seed, preset, replace(PRESETS[preset], mount="any"))
    recording, truth = simulation.recording(), simulation.truth()
    results = []
    for method, extra in ((DEFAULT, ""), (DEFAULT, WITH_TRUNK), (OURS, "")):
        measured = MEASURED_WITH_TRUNK if extra else MEASURED
        subject = calibrate_person(recording, person, method, person.prior, measured=measured)
        errors = evaluate(track(recording, subject, method=method).pose, truth, simulation.phases["circles"][0])
        figures = collect_hand_errors(errors) | compare_lengths(subject, person)
        results.append(Result(method + extra, figures | _compare_mounts(subject, person, simulation)))
    return results


def _compare_mounts(subject: Subject, person: Person, simulation: Simulation) -> dict[str, float]:
    """Compute errors of the mounts, and of mounts and lengths as multiples of their standard deviations."""
    errors = compute_mount_errors(subject, simulation)
    stated = [[subject.std(row) for row in mount_rows(name)] for name in simulation.quat_LS]
    lengths = [(subject.lengths[n] - person.lengths[n]) / subject.std(n) for n in list_closed_lengths(load_table())]
    return {
        "headings rms [deg]": float(np.degrees(rms(errors[:, 2]))),
        "tilts rms [deg]": float(np.degrees(rms(errors[:, :2]))),
        "error / ± rms": rms(np.concatenate([lengths, (errors / stated).ravel()])),
    }


def compute_mount_errors(subject: Subject, simulation: Simulation) -> np.ndarray:
    """Compute the errors (sensors, 3) [rad] of the mounts in L, the heading last.

    A mount's heading is relative to the start pose, however the person turned the segment in it: no closure shows that
    turn, and it is in the ± of what is tracked.
    """
    start = simulation.time <= simulation.phases["start"][0][1]
    facing = rotations.heading(Rotation.from_quat(simulation.quat_WL[load_table().reference][start]).mean().as_quat())
    turn = Rotation.from_rotvec([0.0, 0.0, -float(facing)])
    errors = []
    for name, quat_LS in simulation.quat_LS.items():
        R_LS = Rotation.from_quat(subject.mounts[name])
        error = (R_LS * Rotation.from_quat(quat_LS).inv()).as_rotvec()
        R_WS_start = turn * Rotation.from_quat(simulation.quat_WS[name][start]).mean()
        errors.append([*error[:2], (R_LS * R_WS_start.inv()).as_rotvec()[2]])
    return np.array(errors)


def _error_budget(seed: int, preset: str) -> list[Result]:
    """Run smekf with one group of imperfections switched off, or one part known exactly, at a time."""
    results = []
    full = PRESETS[preset]
    for label, imperfections in (dict.fromkeys(CHAIN_PARTS, full) | switch_off(full)).items():
        person, simulation = _simulate_person(seed, preset, imperfections)
        recording = simulation.recording()
        prior = person.prior if label == "mounts as stated" else set_exact_mounts(person.prior, simulation)
        if label == "orientations exact":
            sensors = {
                name: OrientationSensor(simulation.quat_WS[name], sensor.stated_quat_LS, sensor.gap)
                for name, sensor in recording.sensors.items()
            }
            recording = replace(recording, sensors=sensors)
        measured = MEASURED_WITH_TRUNK if label == "trunk measured" else MEASURED
        subject = calibrate_person(recording, person, OURS, prior, measured=measured)
        if label == "lengths exact":
            subject = replace(subject, lengths=person.lengths)
        errors = evaluate(
            track(recording, subject, method=OURS).pose, simulation.truth(), simulation.phases["circles"][0]
        )
        results.append(Result(label, collect_hand_errors(errors) | compare_lengths(subject, person)))
    return results


def calibrate_person(
    recording: Recording,
    person: Person,
    method: str,
    prior: Subject,
    *,
    measured: Sequence[str] = MEASURED,
    formulation: Formulation = "full",
) -> Subject:
    """Calibrate with the person's measured lengths of these names; a failed calibration is scored as any other."""
    subject = calibrate(
        recording,
        measured={name: person.measured[name] for name in measured},
        prior=prior,
        method=method,
        measured_std=person.measured_std,
        formulation=formulation,
    ).subject
    return replace(subject, quality="")


def collect_hand_errors(errors: Evaluation) -> dict[str, float | tuple[float, float]]:
    """Collect the errors of the hand that circles, and how far its ± is right: nees is 3 then."""
    figures: dict[str, float | tuple[float, float]] = {
        "hand from shoulders [mm]": errors.position_on_limb[CIRCLING_POINT][:2],
        "hand from root [mm]": errors.position[CIRCLING_POINT][:2],
    }
    if CIRCLING_POINT in errors.position_uncertainty:
        figures["hand nees"] = errors.position_uncertainty[CIRCLING_POINT].nees
    return figures


def compare_lengths(subject: Subject, person: Person) -> dict[str, float]:
    """Compute the error of the lengths that the closed chain observes."""
    errors = [subject.lengths[name] - person.lengths[name] for name in list_closed_lengths(load_table())]
    return {"lengths rms [mm]": 1e3 * rms(np.array(errors))}


def list_closed_lengths(table: BodyTable) -> list[str]:
    """List the lengths that joined hands observe: all but those from the root, as the trunk's."""
    return [name for name, length in table.lengths.items() if ROOT not in length.start]


def set_exact_mounts(subject: Subject, simulation: Simulation) -> Subject:
    """Return the subject with the simulation's exact mounts and the standard deviation `KNOWN_MOUNT_STD`."""
    rows = [row for segment in simulation.quat_LS for row in mount_rows(segment)]
    covariance = block_diag(subject.covariance, KNOWN_MOUNT_STD**2 * np.eye(len(rows)))
    return replace(subject, mounts=simulation.quat_LS, order=(*subject.order, *rows), covariance=covariance)


def orient_recording(recording: Recording, contender: Contender) -> tuple[Recording, str]:
    """Prepare a contender for `track`: the recording and a method, or a recording of measured orientations."""
    if contender.method is not None:
        return recording, contender.method
    sensors = {}
    rest = recording.span(recording.phases["start"][0])
    for segment, sensor in recording.imus.items():
        noise = estimate_noise(sensor.gyro_S[rest], sensor.accel_S[rest], recording.rate_hz)
        quat_VS = contender.orient(sensor.gyro_S, sensor.accel_S, recording.rate_hz, noise)
        sensors[segment] = OrientationSensor(quat_VS, sensor.stated_quat_LS)
    return replace(recording, sensors=sensors), "smekf"
