"""The least squares of a calibration beside SciPy's: the same residuals, weights, prior and start."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy import optimize

from wepose_pin.calibration import least_squares
from wepose_pin.calibration.contact import find_contact_start
from wepose_pin.calibration.least_squares import Gaussian, Observations, evaluate_into, residuals, solve
from wepose_pin.calibration.priors import build_prior
from wepose_pin.calibration.problem import SAMPLE_RATE_HZ, CalibrationProblem
from wepose_pin.calibration.protocols import load_protocol
from wepose_pin.calibration.weights import solve_reweighted
from wepose_pin.filters.sensors import filter_recording
from wepose_pin.recording import Recording
from wepose_pin.simulation import MILD_PRESET, Person, simulate, simulate_person

from .tables import Column, Section, Table, time_in_turn

OURS = "Gauss-Newton, ours"
_STATUS = Path("/proc/self/status")


class LeastSquares(NamedTuple):
    """Σ w r² + (x − c)ᵀ Λ (x − c), to be made least from a start."""

    observations: Observations
    prior: Gaussian  # c, Λ
    weights: np.ndarray  # (n, 5)
    start: np.ndarray  # (m,)


def sections(quick: bool) -> dict[str, Section]:
    """Name → a function that measures it; a full run solves at 100 samples a second too."""
    rates_hz = (SAMPLE_RATE_HZ,) if quick else (SAMPLE_RATE_HZ, 100.0)
    return {"calibration": partial(calibration, 60.0, rates_hz, 3)}


def calibration(clasp_s: float, rates_hz: tuple[float, ...], rounds: int) -> Table:
    """The solve of a hands-together calibration beside SciPy's, at each rate of samples."""
    person = simulate_person(3)
    made = simulate(person.lengths, seed=3, imperfections=MILD_PRESET, clasp_s=clasp_s, circles=0)
    table = Table(
        f"Calibration: {clasp_s:g} s of joined hands, one least squares from one start",
        (
            Column("seconds", "solve [s]", 3),
            Column("spread_s", "± [s]", 3),
            Column("ratio", "ratio to ours", 2, True),
            Column("cost", "cost to ours", 4),
            Column("megabytes", "memory [MB]"),
        ),
        notes=[
            "Processor time of all threads, medians; no compiler. Memory: by how much a new process grows at most.",
            "least_squares: trf, scaled by the Jacobian, default tolerances. Whole: search for a start, all rounds of",
            "weights, the last solve, without the filters. Building: CasADi's functions, once for a number of samples.",
        ],
    )
    for posed, calibrate in pose_problems(made.recording(), person, rates_hz):
        samples = f"{len(posed.weights)} samples"
        table.rows[f"{samples}: building"] = {"seconds": building(posed)}
        costs: dict[str, float] = {}

        def keep_cost(name: str, run: Callable[[], float], costs: dict[str, float] = costs) -> None:
            costs[name] = run()

        cases: dict[str, Callable[[], Any]] = {n: partial(keep_cost, n, run) for n, run in solvers(posed).items()}
        timings = time_in_turn(cases | {"whole": calibrate}, rounds, OURS, time.process_time)
        for name, timing in timings.items():
            row = {"seconds": timing.median, "spread_s": timing.spread, "ratio": timing.ratio}
            if name in cases:
                row |= {"cost": costs[name] / costs[OURS], "megabytes": 1e-6 * peak_memory(posed, name)}
            table.rows[f"{samples}: {name}"] = row
    table.rows = table.known_rows()
    return table


def pose_problems(
    recording: Recording, person: Person, rates_hz: tuple[float, ...]
) -> list[tuple[LeastSquares, Callable[[], LeastSquares]]]:
    """The last problem of a hands-together calibration at each rate of samples, and the calibration without filters."""
    measured = {name: (metres, person.measured_std) for name, metres in person.measured.items()}
    filtered, protocol = filter_recording(recording), load_protocol("clasp")
    problem = CalibrationProblem(recording, filtered, protocol, person.prior, measured)
    posed: list[tuple[LeastSquares, Callable[[], LeastSquares]]] = []
    for rate_hz in rates_hz:
        observations, _ = problem.observe(rate_hz)

        def calibrate(observations: Observations = observations) -> LeastSquares:
            prior = build_prior(problem, observations)
            start, contact = find_contact_start(observations, lambda some: build_prior(problem, some).mean)
            weights = solve_reweighted(observations, prior, start, contact).weights
            return LeastSquares(observations, prior, weights, start)

        posed.append((calibrate(), calibrate))
    return posed


def building(posed: LeastSquares) -> float:
    """Seconds that CasADi's functions take to build, once for a number of samples."""
    least_squares._residual_function.cache_clear()
    least_squares._mapped_residuals.cache_clear()
    begin = time.perf_counter()
    least_squares._mapped_residuals(
        posed.observations.layout, posed.observations.conditions[0], 0, len(posed.observations)
    )
    return time.perf_counter() - begin


def solvers(posed: LeastSquares) -> dict[str, Callable[[], float]]:
    """Name → a function that solves it and gives the cost."""
    observations, prior, weights, start = posed
    root_w, root_prior = np.sqrt(weights), np.linalg.cholesky(prior.information).T
    n, m = len(weights), len(prior.mean)
    sample = least_squares._residual_function(observations.layout, observations.conditions[0], 0)
    one = [ca.SX.sym("x", m), ca.SX.sym("data", observations.data.shape[0])]
    alone = ca.Function("alone", one, sample(*one)[:1])  # without the Jacobian that `residuals` gives as well
    x, data = ca.MX.sym("x", m), ca.MX.sym("data", *observations.data.shape)
    every = ca.Function("all", [x, data], [alone.map(n)(ca.repmat(x, 1, n), data)])
    columns, r = np.ascontiguousarray(observations.data.T), np.empty((n, 5))

    def value(x: np.ndarray) -> np.ndarray:
        evaluate_into(every, (np.ascontiguousarray(x), columns), (r,))
        return np.concatenate(((root_w * r).ravel(), root_prior @ (x - prior.mean)))

    def slope(x: np.ndarray) -> np.ndarray:
        J = root_w[:, :, None] * residuals(x, observations)[1]
        return np.concatenate((J.reshape(-1, m), root_prior))

    def by_scipy(jacobian: Callable[[np.ndarray], np.ndarray] | str) -> float:
        return 2.0 * float(optimize.least_squares(value, start, jacobian, method="trf", x_scale="jac").cost)

    return {
        OURS: lambda: solve(observations, prior, weights, start).cost,
        "least_squares, our Jacobian": lambda: by_scipy(slope),
        "least_squares, 2-point": lambda: by_scipy("2-point"),
    }


def peak_memory(posed: LeastSquares, name: str) -> float:
    """By how much solving it raises a new process's resident memory at its highest [bytes]; NaN but on Linux."""
    if not _STATUS.exists():
        return float("nan")
    root = Path(__file__).resolve().parents[1]  # where `benchmarks` is found
    code = f"import sys; from {__name__} import _peak; _peak(sys.stdin.buffer, {name!r})"
    run = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(posed), cwd=root, capture_output=True, check=True
    )
    return float(run.stdout)


def _peak(file: object, name: str) -> None:
    posed = pickle.load(file)  # type: ignore[arg-type]
    run = solvers(posed)[name]
    residuals(posed.start, posed.observations.take(np.arange(10)))  # libraries have loaded what they load
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the highest so far is forgotten
    run()
    print(1024.0 * (_resident("VmHWM") - before))


def _resident(key: str) -> float:
    """[kB]"""
    lines = _STATUS.read_text(encoding="ascii").splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(key)))
