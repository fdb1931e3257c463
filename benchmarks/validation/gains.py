"""Gains of NCF and GDC: a grid search on trials that no experiment scores.

Each setting has its own grid search, so that no filter runs with gains of another kind of motion. The score is the mean
over trials of the total RMSE over the motion, which the experiments report too. Heading, bias, noise and initial tilt
are those of the static phase. `STATED` holds the results of the search (a test and the experiment "gains" repeat it).
Each half of BROAD is run with the gains of the other half, and other recordings with those of all of it. The drift
experiment runs with those of "simulated 1 kHz": a search of its own lowers the total RMSE there by 3 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin import rotations
from wepose_pin.errors import BadOption
from wepose_pin.filters import Gdc, GdcParams, Ncf, NcfParams
from wepose_pin.filters.noise import SensorNoise, estimate_noise
from wepose_pin.filters.static import StaticTest
from wepose_pin.simulation import simulate, simulate_paper_dynamic

from ..trials import read_broad
from .experiment import Job, Result, align_rotation
from .presets import PRESETS, UPPER_BODY, Preset

# The grid: zero, which leaves the term out, and steps of a quarter or half a decade.
PROPORTIONAL = (0.0, *np.logspace(-3.0, 0.5, 15))  # [1/s] k_P
INTEGRAL = (0.0, *np.logspace(-6.0, -1.0, 11))  # [1/s²] k_I
DESCENT = (0.0, *np.logspace(-5.0, -0.5, 19))  # [1/s] β

DYNAMIC_SEEDS = range(100, 106)  # the experiments have 0 to 11
PERSON_SEEDS = range(100, 103)  # of five sensors each; the experiments have 0 to 9
HALVES = ({"01", "05", "09", "14", "21", "27", "31", "35"}, {"03", "07", "11", "16", "25", "29", "33"})  # of BROAD
RATES = {"simulated 100 Hz": 100.0, "simulated 1 kHz": 1000.0}
PEOPLE = {f"{UPPER_BODY}, {label}": preset for label, preset in PRESETS.items()}
BROAD = {"BROAD, first half": HALVES[0], "BROAD, second half": HALVES[1], "BROAD": HALVES[0] | HALVES[1]}

_SCORED_HZ = 25.0  # [Hz] rate of the scored samples: errors are slow


class Gains(NamedTuple):
    """The gains of a setting, from a grid search."""

    ncf: NcfParams
    gdc: GdcParams


def _grid_points(proportional: float, integral: float, descent: float) -> Gains:
    """Find the grid points of these rounded values."""
    nearest = [
        float(min(axis, key=lambda point: abs(point - rounded)))
        for axis, rounded in ((PROPORTIONAL, proportional), (INTEGRAL, integral), (DESCENT, descent))
    ]
    return Gains(NcfParams(*nearest[:2]), GdcParams(nearest[2]))


# Sensor noise alone and a minute without rest: with the bias removed the accelerometer has next to nothing to add, and
# GDC is best without it, that is with the gyroscope integrated.
STATED = {
    "simulated 100 Hz": _grid_points(0.0032, 1e-4, 0.0),
    "simulated 1 kHz": _grid_points(0.0032, 3.2e-5, 0.0),
    "upper body, ideal": _grid_points(0.032, 1e-5, 5.6e-4),
    "upper body, mild": _grid_points(0.1, 0.0, 1.8e-3),
    "upper body, people": _grid_points(0.32, 0.0, 0.01),
    "BROAD, first half": _grid_points(0.1, 1e-3, 0.018),
    "BROAD, second half": _grid_points(0.056, 3.2e-4, 0.01),
    "BROAD": _grid_points(0.1, 1e-3, 0.018),
}


class TuningTrial(NamedTuple):
    """A trial and its truth; samples for alignment and score are decimated to `_SCORED_HZ`."""

    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s²]
    rate_hz: float
    noise: SensorNoise
    samples: np.ndarray  # (m,) indices of the decimated samples
    R_WS: Rotation  # (m,) true orientation at these samples
    static: np.ndarray  # (m,) bool, where the heading is aligned
    scored: np.ndarray  # (m,) bool


class Score(NamedTuple):
    """A point of the grid: gains and the mean total RMSE [deg] over the trials."""

    gains: NcfParams | GdcParams
    total_rmse: float


def make_gains(setting: str, trial: str = "") -> Gains:
    """Return the stated gains of a `setting`: a key of `STATED`, or "real".

    `trial`: its name; one of BROAD gets what was found on the half that it is not in.
    """
    if setting != "real":
        return STATED[setting]
    number = trial.split("_")[0]
    if number in HALVES[0]:
        return STATED["BROAD, second half"]
    return STATED["BROAD, first half" if number in HALVES[1] else "BROAD"]


def search_gains(trials: Sequence[TuningTrial]) -> tuple[list[Score], list[Score]]:
    """Score every grid point of NCF and GDC on these trials."""
    ncf = [NcfParams(float(p), float(i)) for p, i in product(PROPORTIONAL, INTEGRAL)]
    gdc = [GdcParams(float(gain)) for gain in DESCENT]
    return (
        [Score(params, float(np.mean([compute_rmse(trial, params) for trial in trials]))) for params in ncf],
        [Score(params, float(np.mean([compute_rmse(trial, params) for trial in trials]))) for params in gdc],
    )


def find_best(scores: Sequence[Score]) -> Score:
    return min(scores, key=lambda score: score.total_rmse)


def compute_rmse(trial: TuningTrial, params: NcfParams | GdcParams) -> float:
    """Compute the total RMSE [deg] over the scored samples of a trial."""
    quat_start = rotations.quat_from_gravity(trial.accel_S[: StaticTest().samples(trial.rate_hz)].mean(axis=0))
    filter_ = (Ncf if isinstance(params, NcfParams) else Gdc)(trial.noise, trial.rate_hz, quat_start, params)  # type: ignore[arg-type]
    quat = filter_.run(trial.gyro_S, trial.accel_S, np.zeros(len(trial.gyro_S), dtype=bool)).quat_VS
    R_VS = align_rotation(Rotation.from_quat(quat[trial.samples]), trial.R_WS, trial.static)
    angle = (R_VS[trial.scored] * trial.R_WS[trial.scored].inv()).magnitude()
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def list_trials(setting: str, data: Path | None = None) -> list[TuningTrial]:
    """List the tuning trials of a key of `STATED`; `data` is the folder of the real recordings."""
    if setting in RATES:
        return [_make_dynamic_trial(seed, RATES[setting]) for seed in DYNAMIC_SEEDS]
    if setting in PEOPLE:
        return [trial for seed in PERSON_SEEDS for trial in _make_person_trials(seed, PEOPLE[setting])]
    if data is None:
        raise BadOption(f"{setting}: its trials need the folder of the real recordings")
    paths = sorted((data / "broad").glob("*.mat"))
    return [_make_broad_trial(path) for path in paths if path.stem.split("_")[0] in BROAD[setting]]


def _make_dynamic_trial(seed: int, rate_hz: float) -> TuningTrial:
    sensor = simulate_paper_dynamic(seed, rate_hz)
    static = (sensor.time >= sensor.static[0][0] + 0.5) & (sensor.time <= sensor.static[0][1] - 0.5)
    moving = (sensor.time >= sensor.moving[0]) & (sensor.time <= sensor.moving[1])
    return _make_trial(sensor.gyro_S, sensor.accel_S, rate_hz, sensor.quat_WS, static, moving)


def _make_person_trials(seed: int, preset: Preset) -> list[TuningTrial]:
    """Make the trials of a person's sensors over clasp and circles; the truth is the sensors' own orientation."""
    simulation = simulate(preset.sample_person(seed).lengths, seed=seed, imperfections=preset.imperfections)
    recording = simulation.recording()
    static, moving = (np.zeros(len(recording.time), dtype=bool) for _ in range(2))
    static[recording.span(recording.phases["start"][0])] = True
    for phase in ("clasp", "circles"):
        moving[recording.span(recording.phases[phase][0])] = True
    trials = []
    for segment, sensor in recording.imus.items():
        true = simulation.quat_WS[segment]
        trials.append(_make_trial(sensor.gyro_S, sensor.accel_S, recording.rate_hz, true, static, moving))
    return trials


def _make_broad_trial(path: Path) -> TuningTrial:
    trial = read_broad(path)
    static = np.zeros(len(trial.scored), dtype=bool)
    static[trial.static] = True
    known = np.isfinite(trial.quat_true).all(axis=1)
    return _make_trial(trial.gyro_S, trial.accel_S, trial.rate_hz, trial.quat_true, static, trial.scored, known)


def _make_trial(
    gyro_S: np.ndarray,
    accel_S: np.ndarray,
    rate_hz: float,
    quat_WS: np.ndarray,
    static: np.ndarray,
    scored: np.ndarray,
    known: np.ndarray | bool = True,
) -> TuningTrial:
    decimated = np.zeros(len(gyro_S), dtype=bool)
    decimated[:: max(1, round(rate_hz / _SCORED_HZ))] = True
    samples = np.flatnonzero(decimated & (static | scored) & known)
    noise = estimate_noise(gyro_S[static], accel_S[static], rate_hz)
    return TuningTrial(
        gyro_S, accel_S, rate_hz, noise, samples, Rotation.from_quat(quat_WS[samples]), static[samples], scored[samples]
    )


def list_experiments(data: Path | None = None) -> dict[str, list[Job]]:
    """List the grid searches as jobs, one a setting: best gains, their score, and that of the stated ones."""
    settings = [*RATES, *PEOPLE, *(BROAD if data is not None and any((data / "broad").glob("*.mat")) else ())]
    return {"gains": [Job(setting, _search_experiment, (setting, data)) for setting in settings]}


def _search_experiment(setting: str, data: Path | None) -> list[Result]:
    results = []
    stated = STATED[setting]
    for name, scores, params in zip(("ncf", "gdc"), search_gains(list_trials(setting, data)), stated, strict=True):
        gains, rmse = find_best(scores)
        at_stated = next(score.total_rmse for score in scores if score.gains == params)
        gain, integral = (*vars(gains).values(), 0.0)[:2]
        figures = {"k_P or β [1/s]": gain, "k_I [1/s²]": integral, "best [deg]": rmse, "stated [deg]": at_stated}
        results.append(Result(f"{name}, {setting}", figures))
    return results
