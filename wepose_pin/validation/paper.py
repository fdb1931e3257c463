"""The paper's three experiments on simulated sensors and people with exact truth.

The bias measured in the static phase is removed for every filter, and the heading is aligned once, in that phase, and
never fitted to the truth afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from .. import rotations
from ..calibration import Formulation, calibrate
from ..evaluation import AttitudeError, Evaluation, attitude_error, evaluate
from ..filters.noise import estimate_noise
from ..model import ROOT, BodyTable, load_table
from ..recording import OrientationSensor, Recording
from ..simulation import (
    CIRCLING_POINT,
    IDEAL_PRESET,
    MEASURED_LENGTHS,
    Imperfections,
    Person,
    Simulation,
    SingleSensor,
    simulate,
    simulate_paper_drift,
    simulate_paper_dynamic,
)
from ..subject import Subject, mount_rows
from ..tracking import track
from .contenders import Contender, list_contenders
from .jobs import Job, Result
from .presets import PRESETS, Preset
from .series import align_rotation, decimate_curves
from .tables import (
    AS_COMMANDED,
    CAUSAL,
    DEFAULT,
    ERROR_BUDGET,
    LENGTHS_ALONE,
    OPEN_LOOP,
    ORIENTATIONS_ALONE,
    OURS,
    PROTOCOL,
    UPPER_BODY,
    WITH_TRUNK,
)

RATES = {"100 Hz": 100.0, "1 kHz": 1000.0}
MEASURED, MEASURED_WITH_TRUNK = MEASURED_LENGTHS[:1], MEASURED_LENGTHS  # lengths that are measured beforehand
KNOWN_MOUNT_STD = np.deg2rad(0.5)  # stated standard deviation of exact mounts
TRIALS = {"dynamic": 12, "drift": 10, UPPER_BODY: 10, ERROR_BUDGET: 10}  # the paper's numbers; the budget's is ours
# Parts of the error budget: parts of the chain known exactly, or not as well; then groups of imperfections switched
# off, by how their names begin. An imperfection that is in none of them is a group of its own.
CHAIN_PARTS = ("all on", "orientations exact", "lengths exact", "trunk measured", "mounts as stated")
GROUPS = {
    "soft tissue off": ("soft_tissue_deg", "tissue_", "wobble_deg"),
    "breath, creep and slip of straps off": ("breath_deg", "creep_deg", "strap_slip_deg"),
    "shoulder girdle off": ("shoulder_wander", "girdle"),
    "palm slip off": ("palm_slip", "handle_slip"),
    "wrists straight": ("wrist_",),
    "elbows as hinges": ("carrying_angle", "elbow_abduction_deg"),
    "start pose exact": ("start_",),
    "sway off": ("sway_",),
    "gyro and accel errors off": (
        *("gyro_scale", "accel_scale", "misalignment_deg", "g_sensitivity_deg_s"),
        *("gyro_range_deg_s", "accel_range_g", "bits", "gyro_warm_up_deg_s"),
    ),
    "clocks exact, none lost": ("clock_", "dropped"),
}


def list_experiments(quick: bool = False, trials: int | None = None) -> dict[str, list[Job]]:
    """List the jobs of each experiment.

    `quick`: one trial of each, and no error budget; `trials`: at most so many of each.
    """

    def count(kind: str) -> range:
        return range(1 if quick else min(TRIALS[kind], trials or TRIALS[kind]))

    jobs = {}
    for rate, rate_hz in RATES.items():
        name = f"dynamic {rate}"
        jobs[name] = [Job(name, str(k), _dynamic, (k, rate, rate_hz)) for k in count("dynamic")]
    jobs["drift"] = [Job("drift", str(k), _drift, (k,)) for k in count("drift")]
    for label, preset in PRESETS.items():
        name = f"{UPPER_BODY}, {label}"
        jobs[name] = [Job(name, str(k), _upper_body, (k, preset)) for k in count(UPPER_BODY)]
    for label, preset in PRESETS.items():
        if not quick and preset.imperfections != IDEAL_PRESET:
            name = f"{ERROR_BUDGET}, {label}"
            jobs[name] = [Job(name, str(k), _error_budget, (k, preset)) for k in count(ERROR_BUDGET)]
    return jobs


def switch_off(imperfections: Imperfections) -> dict[str, Imperfections]:
    """Switch off each group of imperfections that is on: label → the others."""
    on = [field.name for field in fields(imperfections) if _is_on(imperfections, field.name)]
    groups = {label: [name for name in on if name.startswith(starts)] for label, starts in GROUPS.items()}
    grouped = {name for names in groups.values() for name in names}
    groups |= {f"{name} off": [name] for name in on if name not in grouped}
    return {
        label: replace(imperfections, **{name: getattr(IDEAL_PRESET, name) for name in names})
        for label, names in groups.items()
        if names
    }


def _is_on(imperfections: Imperfections, name: str) -> bool:
    places = ("upper_arm_place", "forearm_place")  # where sensors sit is no imperfection
    return name not in places and bool(getattr(imperfections, name) != getattr(IDEAL_PRESET, name))


def _dynamic(experiment: str, trial: str, seed: int, rate: str, rate_hz: float) -> list[Result]:
    """Run the dynamic experiment: 5 s static, 50 s of free motion, 5 s static; errors over the motion."""
    sensor = simulate_paper_dynamic(seed, rate_hz)
    results = []
    for method, scored, error in _run_single(sensor, f"simulated {rate}"):
        series = decimate_curves(sensor.time, total_deg=np.degrees(error.magnitude())) if seed == 0 else {}
        results.append(Result(experiment, trial, method, scored._asdict(), series))
    return results


def _drift(experiment: str, trial: str, seed: int) -> list[Result]:
    """Run the drift experiment: 25 s static, 10 s of shaking and rotating, 25 s static.

    The heading error is the change from before the motion to after it.
    """
    sensor = simulate_paper_drift(seed)
    after = sensor.time > sensor.moving[1] + 1.0
    results = []
    for method, _, error in _run_single(sensor, "simulated 1 kHz"):
        yaw, pitch, roll = np.abs(error.as_euler("ZYX", degrees=True)[after]).T
        heading = np.degrees(np.unwrap(rotations.heading(error.as_quat())))
        slope = np.polyfit(sensor.time[after], heading[after], 1)[0]
        figures = {"roll": roll.mean(), "pitch": pitch.mean(), "yaw": yaw.mean(), "drift_deg_min": 60.0 * abs(slope)}
        series = decimate_curves(sensor.time, heading_deg=heading) if seed == 0 else {}
        results.append(Result(experiment, trial, method, {k: float(v) for k, v in figures.items()}, series))
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
def _simulate_person(seed: int, preset: Preset) -> tuple[Person, Simulation]:
    person = preset.sample_person(seed)
    return person, simulate(person.lengths, seed=seed, imperfections=preset.imperfections)


def _upper_body(experiment: str, trial: str, seed: int, preset: Preset) -> list[Result]:
    """Calibrate by each filter with a measured shoulder width and known mounts, then track six circles.

    smekf has a row for each part of the paper's protocol, one for the whole of it, and one with a measured trunk;
    amekf, the default, has one with the mounts that a session states, one as live, and one that enters as the filters
    of other packages do.
    """
    person, simulation = _simulate_person(seed, preset)
    recorded, truth = simulation.recording(), simulation.truth()
    circles = simulation.phases["circles"][0]
    exact, stated = set_exact_mounts(person.prior, simulation), person.prior
    results = []

    def score(
        label: str,
        recording: Recording,
        subject: Subject,
        method: str,
        *,
        open_loop: bool = False,
        causal: bool = False,
    ) -> None:
        tracked = track(recording, subject, method=method, open_loop=open_loop, causal=causal)
        recording, pose = tracked.recording, tracked.pose  # causal: from the end of the start pose on
        series = {}
        if seed == 0:
            inside = recording.span(circles)
            true_path = truth.points[CIRCLING_POINT][recorded.span(circles)]
            off = pose.points[CIRCLING_POINT][inside] - true_path
            paths = {f"{axis}_mm": 1e3 * pose.points[CIRCLING_POINT][inside, k] for k, axis in enumerate("xyz")}
            paths |= {f"true_{axis}_mm": 1e3 * true_path[:, k] for k, axis in enumerate("xyz")}
            series = decimate_curves(recording.time[inside], error_mm=1e3 * np.linalg.norm(off, axis=1), **paths)
        figures = collect_hand_errors(evaluate(pose, truth, circles)) | {
            "lengths_rms_mm": _compute_lengths_rms(subject, person)
        }
        results.append(Result(experiment, trial, label, figures, series))

    for contender in list_contenders(experiment):
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
            score(WITH_TRUNK, recording, with_trunk, OURS)
            lengths_alone = calibrate_person(recording, person, OURS, exact, formulation="paper")
            score(LENGTHS_ALONE, recording, lengths_alone, OURS)
            score(OPEN_LOOP, recording, subject, OURS, open_loop=True)
            as_in_paper = calibrate_person(recording, person, OURS, stated, formulation="paper")
            score(PROTOCOL, recording, as_in_paper, OURS, open_loop=True)
    return results


def _error_budget(experiment: str, trial: str, seed: int, preset: Preset) -> list[Result]:
    """Run smekf with one group of imperfections switched off, or one part known exactly, at a time."""
    results = []
    full = preset.imperfections
    for label, imperfections in (dict.fromkeys(CHAIN_PARTS, full) | switch_off(full)).items():
        person, simulation = _simulate_person(seed, preset._replace(imperfections=imperfections))
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
        figures = collect_hand_errors(errors) | {"lengths_rms_mm": _compute_lengths_rms(subject, person)}
        results.append(Result(experiment, trial, label, figures))
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
    """Calibrate with the person's measured lengths of these names."""
    return calibrate(
        recording,
        measured={name: person.measured[name] for name in measured},
        prior=prior,
        method=method,
        measured_std=person.measured_std,
        formulation=formulation,
    ).subject


def collect_hand_errors(errors: Evaluation) -> dict[str, dict[str, float]]:
    """Collect the errors of the hand that circles, from the shoulders first, and how far its ± is right."""
    figures = {
        "hand_from_shoulders_mm": errors.position_on_limb[CIRCLING_POINT]._asdict(),
        "hand_mm": errors.position[CIRCLING_POINT]._asdict(),
    }
    if CIRCLING_POINT in errors.position_uncertainty:
        figures["hand_uncertainty"] = errors.position_uncertainty[CIRCLING_POINT]._asdict()
    return figures


def _compute_lengths_rms(subject: Subject, person: Person) -> float:
    """Compute the rms error [mm] of the lengths that the closed chain observes."""
    errors = [subject.lengths[name] - person.lengths[name] for name in list_closed_lengths(load_table())]
    return 1e3 * float(np.sqrt(np.mean([error**2 for error in errors])))


def list_closed_lengths(table: BodyTable) -> list[str]:
    """List the lengths that joined hands observe: all but those from the root, as the trunk's."""
    return [name for name, length in table.lengths.items() if all(ROOT not in part.start for part in length.stretches)]


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
        quat_WS = contender.orient(sensor.gyro_S, sensor.accel_S, recording.rate_hz, noise)
        sensors[segment] = OrientationSensor(quat_WS, sensor.stated_quat_LS)
    return replace(recording, sensors=sensors), "smekf"
