"""How wrong the estimates are: the paper's experiments on simulated subjects, and real recordings with optical truth.

Everything is seeded: two runs give the same numbers. In every experiment the bias measured in the still phase is
removed for every filter, and the heading is aligned once, in that phase, and never fitted to the truth afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from . import so3
from .calibration import calibrate
from .errors import MissingFile
from .evaluation import AttitudeError, attitude_error, evaluate
from .filters import METHODS, run_filter
from .noise import noise_of
from .readers.trials import Trial, read_authors_trial, read_broad
from .simulation import PERFECT_WORLD, REALISTIC, SingleSensor, paper_drift, paper_dynamic, simulate, simulated_person
from .tracking import track

# Lisini Baldi 2019: roll, pitch, yaw [deg] as mean ± std by rate [Hz]; right hand [mm].
PAPER_DYNAMIC = {
    ("ncf", 100): ((2.23, 2.25), (2.70, 2.90), (2.42, 2.62)),
    ("gdc", 100): ((1.38, 1.37), (2.28, 2.43), (2.11, 2.24)),
    ("smekf", 100): ((1.10, 1.30), (1.46, 1.71), (1.35, 1.62)),
    ("ncf", 1000): ((1.89, 1.41), (1.93, 2.09), (2.05, 2.03)),
    ("gdc", 1000): ((0.96, 0.81), (1.48, 1.43), (1.57, 1.50)),
    ("smekf", 1000): ((0.71, 0.79), (0.73, 0.75), (0.86, 0.82)),
}
PAPER_HAND = {"ncf": (17.71, 10.75), "gdc": (17.96, 10.82), "smekf": (12.05, 6.20)}
WORLDS = {"MTi-3 noise alone": PERFECT_WORLD, "realistic": REALISTIC}


class Result(NamedTuple):
    """One filter in one trial."""

    experiment: str
    trial: str
    method: str
    figures: dict[str, Any]


def experiments(quick: bool = False, data: Path | None = None) -> dict[str, tuple[int, Callable[[], Iterator[Result]]]]:
    """Name → (how many trials, a generator of their results); `data`: the folder of the real recordings."""
    few = 2 if quick else None
    found: dict[str, tuple[int, Callable[[], Iterator[Result]]]] = {
        "dynamic 100 Hz": (few or 12, lambda: _dynamic(few or 12, 100.0)),
        "dynamic 1 kHz": (few or 12, lambda: _dynamic(few or 12, 1000.0)),
        "drift": (few or 10, lambda: _drift(few or 10)),
    }
    for world in WORLDS:
        found[f"upper body, {world}"] = (few or 10, lambda world=world: _upper_body(few or 10, world))  # type: ignore[misc]
    if data is not None:
        paths = sorted((data / "broad").glob("*.mat"))
        authors = data / "wepose_hr" / "prova_HR.txt"
        if not paths and not authors.is_file():
            raise MissingFile(f"{data}: neither broad/*.mat nor wepose_hr/prova_HR.txt in it; see the data's README")
        if paths:
            found["BROAD"] = (len(paths), lambda: _broad(paths))
        if authors.is_file():
            found["the authors' trial"] = (1, lambda: _authors(authors))
    return found


def _dynamic(trials: int, rate_hz: float) -> Iterator[Result]:
    """5 s still, 50 s of free motion, 5 s still; errors over the motion."""
    for seed in range(trials):
        for method, error, _ in _single(paper_dynamic(seed, rate_hz)):
            yield Result(f"dynamic {'1 kHz' if rate_hz == 1000.0 else '100 Hz'}", str(seed), method, error._asdict())


def _drift(trials: int) -> Iterator[Result]:
    """25 s still, 10 s of shaking and turning, 25 s still; the heading error after the motion, against before it."""
    for seed in range(trials):
        sensor = paper_drift(seed)
        for method, _, error in _single(sensor):
            after = sensor.time > sensor.moving[1] + 1.0
            yaw, pitch, roll = np.abs(error.as_euler("ZYX", degrees=True)[after]).T
            figures = {"roll": roll.mean(), "pitch": pitch.mean(), "yaw": yaw.mean()}
            slope = np.polyfit(sensor.time[after], np.degrees(np.unwrap(so3.heading(error[after].as_quat()))), 1)[0]
            figures["yaw_drift_deg_min"] = 60.0 * abs(slope)
            yield Result("drift", str(seed), method, {name: float(value) for name, value in figures.items()})


def _single(sensor: SingleSensor) -> Iterator[tuple[str, AttitudeError, Rotation]]:
    """Method, its error over the motion, and the error rotation of each sample; the heading aligned at rest."""
    rest = (sensor.time >= sensor.still[0][0] + 0.5) & (sensor.time <= sensor.still[0][1] - 0.5)
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    true = Rotation.from_quat(sensor.quat_WS)
    noise = noise_of(sensor.gyro_S[rest], sensor.accel_S[rest], sensor.rate_hz)
    for method in METHODS:
        quat = run_filter(sensor.gyro_S, sensor.accel_S, sensor.rate_hz, noise, method, measured_start=True).quat_WS
        aligned = _aligned(Rotation.from_quat(quat), true, rest)
        yield method, attitude_error(aligned[moving], true[moving], sensor.time[moving]), aligned * true.inv()


def _aligned(R_VS: Rotation, R_WS: Rotation, where: np.ndarray) -> Rotation:
    """R_VS turned about the vertical such that its heading is that of R_WS where `where`."""
    psi = so3.heading((R_WS[where] * R_VS[where].inv()).mean().as_quat())
    return Rotation.from_rotvec([0.0, 0.0, float(psi)]) * R_VS


def _upper_body(subjects: int, world: str) -> Iterator[Result]:
    """Clasp calibration by each filter with a taped shoulder width, then six circles; mounts as stated."""
    for seed in range(subjects):
        person = simulated_person(seed)
        simulation = simulate(person.lengths, seed=seed, imperfections=WORLDS[world])
        recording, truth = simulation.recording(), simulation.truth()
        for method in METHODS:
            subject = calibrate(
                recording, gauge=person.taped, prior=person.average, method=method, gauge_std=person.taped_std
            )
            errors = evaluate(track(recording, subject, method=method), truth, simulation.phases["circles"][0])
            figures = {
                "hand_mm": errors.position["right_hand"]._asdict(),
                "hand_from_shoulders_mm": errors.position_from_shoulders["right_hand"]._asdict(),
            }
            yield Result(f"upper body, {world}", str(seed), method, figures)


def _broad(paths: list[Path]) -> Iterator[Result]:
    """Errors over the marked motion, the heading aligned in the still phase."""
    for path in paths:
        trial = read_broad(path)
        seen = np.isfinite(trial.quat_true).all(axis=1)
        at_rest = np.zeros(len(seen), dtype=bool)
        at_rest[trial.still] = seen[trial.still]
        true = Rotation.from_quat(np.where(seen[:, None], trial.quat_true, [0.0, 0.0, 0.0, 1.0]))
        for method, R_VS in _filtered(trial):
            yield Result("BROAD", trial.name, method, _scored(_aligned(R_VS, true, at_rest), true, trial))


def _authors(path: Path) -> Iterator[Result]:
    """Vicon's world is not level to a degree: aligned in full, on the world's side, at the first Vicon sample."""
    trial = read_authors_trial(path)
    first = int(np.argmax(trial.scored))
    true = Rotation.from_quat(np.where(trial.scored[:, None], trial.quat_true, [0.0, 0.0, 0.0, 1.0]))
    for method, R_VS in _filtered(trial):
        figures = _scored((true[first] * R_VS[first].inv()) * R_VS, true, trial)
        yield Result("the authors' trial", trial.name, method, figures)


def _filtered(trial: Trial) -> Iterator[tuple[str, Rotation]]:
    noise = noise_of(trial.gyro_S[trial.still], trial.accel_S[trial.still], trial.rate_hz)
    for method in METHODS:
        run = run_filter(trial.gyro_S, trial.accel_S, trial.rate_hz, noise, method, measured_start=True)
        yield method, Rotation.from_quat(run.quat_WS)


def _scored(aligned: Rotation, true: Rotation, trial: Trial) -> dict[str, Any]:
    time = np.arange(len(trial.scored)) / trial.rate_hz
    error = attitude_error(aligned[trial.scored], true[trial.scored], time[trial.scored])
    angle = np.degrees((aligned[trial.scored] * true[trial.scored].inv()).magnitude())
    return error._asdict() | {"mean_angle": float(angle.mean())}


def summary(results: list[Result]) -> list[tuple[str, str, dict[str, float], str]]:
    """A row a filter and experiment: experiment, method, mean figures over trials, the paper's figures as text."""
    rows = []
    for experiment in dict.fromkeys(result.experiment for result in results):
        for method in METHODS:
            of = [r.figures for r in results if r.experiment == experiment and r.method == method]
            rows.append((experiment, method, *_mean(experiment, method, of)))
    return rows


def _mean(experiment: str, method: str, figures: list[dict[str, Any]]) -> tuple[dict[str, float], str]:
    def over(*path: Any) -> float:
        values = []
        for figure in figures:
            value: Any = figure
            for key in path:
                value = value[key]
            values.append(value)
        return float(np.mean(values))

    if experiment.startswith("dynamic"):
        paper = PAPER_DYNAMIC[method, 1000 if "1 kHz" in experiment else 100]
        mean = {f"{name}{' std' * k}": over(name, k) for name in ("roll", "pitch", "yaw") for k in (0, 1)}
        return mean, "  ".join(f"{m:.2f} ± {s:.2f}" for m, s in paper)
    if experiment == "drift":
        return {name: over(name) for name in figures[0]}, "smekf negligible, gdc little, ncf in yaw"
    if experiment.startswith("upper body"):
        mean = {"hand": over("hand_mm", "mean"), "hand std": over("hand_mm", "std")}
        mean |= {"from shoulders": over("hand_from_shoulders_mm", "mean")}
        mean |= {"from shoulders std": over("hand_from_shoulders_mm", "std")}
        return mean, "{:.2f} ± {:.2f}".format(*PAPER_HAND[method])
    names = ("inclination_rmse", "heading_rmse", "total_rmse", "mean_angle")
    return {name.replace("_", " "): over(name) for name in names}, ""
