"""The least squares of a calibration by `nlpsol`, by a loop in NumPy and by SciPy, from the same start."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
from scipy import optimize

from wepose_pin.calibration import alternatives, least_squares, solver, weights
from wepose_pin.calibration.blocks import evaluate, make_program
from wepose_pin.calibration.contact import find_initial_guess
from wepose_pin.calibration.least_squares import Observations, residuals
from wepose_pin.calibration.priors import build_prior
from wepose_pin.calibration.problem import SAMPLE_RATE_HZ, CalibrationProblem
from wepose_pin.calibration.protocols import load_protocol
from wepose_pin.calibration.solver import (
    DAMPING,
    DAMPING_FACTOR,
    LEAST_DAMPING,
    MOST_DAMPING,
    STEPS,
    TOLERANCE,
    Fit,
    LeastSquares,
    accept,
    solve,
)
from wepose_pin.calibration.weights import FINAL_STEPS, solve_reweighted
from wepose_pin.filters.sensors import filter_recording
from wepose_pin.model import load_model
from wepose_pin.recording import Recording
from wepose_pin.simulation import MILD_PRESET, Person, simulate, simulate_person

from .tables import Column, Section, Table, time_in_turn

NLPSOL, LOOP = "nlpsol", "Gauss-Newton loop"


def solve_without_bounds(
    problem: LeastSquares,
    start: np.ndarray | Fit,
    steps: int = STEPS,
    strict: bool = True,
    tolerance: float = TOLERANCE,
) -> Fit:
    """The minimiser by Gauss-Newton, damped where a step does not lower the cost; parameters and errors as `solve`."""
    now = problem.evaluate_start(start)
    damping = DAMPING
    for _ in range(steps):
        if now.remaining() < tolerance:
            return now.fit()
        before, H = now, now.information
        while True:
            now = problem.evaluate(before.x - np.linalg.solve(H + damping * np.diag(np.diag(H)), before.gradient))
            if now.cost <= before.cost * (1.0 + 1e-12) or damping > MOST_DAMPING:
                break
            damping *= DAMPING_FACTOR
        damping = max(damping / DAMPING_FACTOR, LEAST_DAMPING)
    return accept(now, now.remaining(), strict)


SOLVERS = {NLPSOL: solve, LOOP: solve_without_bounds}
FINE = 3e-7  # standard deviations to go, at which solutions are compared
_STATUS = Path("/proc/self/status")


def exchange_solver(run: Callable[..., Fit]) -> None:
    """Solve the least squares of calibrations by `run` from now on; its parameters are those of `solve`."""
    weights.solve = alternatives.solve = run  # type: ignore[attr-defined]


def calibrate_by(run: Callable[..., Fit], calibrate: Callable[[], Any]) -> None:
    """Calibrate by the solver `run`."""
    exchange_solver(run)
    calibrate()
    exchange_solver(solve)


@dataclass(frozen=True)
class Posed:
    """A least squares and the x (m,) to start from."""

    problem: LeastSquares
    start: np.ndarray


def sections(quick: bool) -> dict[str, Section]:
    """Name → a function that measures it; a full run solves at 100 samples a second too."""
    rates_hz = (SAMPLE_RATE_HZ,) if quick else (SAMPLE_RATE_HZ, 100.0)
    return {
        "calibration": partial(calibration, 60.0, rates_hz, 3),
        "solvers": partial(solvers_by_case, 30.0 if quick else 60.0, 1 if quick else 3),
    }


def solvers_by_case(seconds: float, rounds: int) -> Table:
    """`nlpsol` beside the loop on the last least squares of several calibrations."""
    table = Table(
        f"Calibration: nlpsol beside the Gauss-Newton loop, {seconds:g} s of each",
        (
            Column("unknowns", "unknowns", 0),
            Column("samples", "samples", 0),
            Column("nlpsol_s", "nlpsol [s]", 3),
            Column("loop_s", "loop [s]", 3),
            Column("ratio", "ratio", 2, True),
            Column("nlpsol_evaluations", "nlpsol: evaluations", 0),
            Column("loop_evaluations", "loop: evaluations", 0),
            Column("difference", "difference [1e-6 std]", 3),
        ),
        notes=[
            f"Processor time from the first start to 1e-4 standard deviations, medians of {rounds}. Difference: of the",
            f"solutions to {FINE:g} standard deviations, the largest over all unknowns, in units of their own.",
        ],
    )
    for name, posed in pose_cases(seconds).items():
        runs: dict[str, Callable[[], Any]] = {
            solver: partial(run, posed.problem, posed.start, FINAL_STEPS) for solver, run in SOLVERS.items()
        }
        timings = time_in_turn(runs, rounds, LOOP)
        fine = {solver: run(posed.problem, posed.start, FINAL_STEPS, False, FINE) for solver, run in SOLVERS.items()}
        std = np.sqrt(np.diag(np.linalg.inv(fine[LOOP].information)))
        table.rows[name] = {
            "unknowns": len(posed.start),
            "samples": len(posed.problem.observations),
            "nlpsol_s": timings[NLPSOL].median,
            "loop_s": timings[LOOP].median,
            "ratio": timings[NLPSOL].ratio,
            "nlpsol_evaluations": count_evaluations(runs[NLPSOL]),
            "loop_evaluations": count_evaluations(runs[LOOP]),
            "difference": 1e6 * float(np.abs((fine[NLPSOL].x - fine[LOOP].x) / std).max()),
        }
    return table


def count_evaluations(run: Callable[[], Fit]) -> int:
    """How many times it evaluates the residuals of all samples."""
    calls = 0

    def counted(x: np.ndarray, observations: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nonlocal calls
        calls += 1
        return residuals(x, observations)

    solver.residuals = counted  # type: ignore[attr-defined]
    try:
        run()
    finally:
        solver.residuals = residuals  # type: ignore[attr-defined]
    return calls


def pose_cases(seconds: float) -> dict[str, Posed]:
    """What a calibration meets → its least squares."""
    person = simulate_person(3)

    def recorded(protocol: str = "clasp", mount: Literal["stated", "any"] = "stated") -> Recording:
        world = replace(MILD_PRESET, mount=mount)
        return simulate(
            person.lengths, seed=3, imperfections=world, clasp_s=seconds, circles=0, protocol=protocol
        ).recording()

    free = recorded(mount="any")
    begin = free.phases["clasp"][0][0]
    still = replace(free, phases={**free.phases, "clasp": ((begin, begin + 5.0),)})
    recordings = {
        "clasp": ("clasp", recorded()),
        "clasp, unknown mounts": ("clasp", free),
        "clasp, 5 s": ("clasp", still),
        "t_pose+bow": ("t_pose+bow", recorded("t_pose+bow")),
    }
    posed = {}
    for name, (protocol, recording) in recordings.items():
        filtered = filter_recording(recording)
        problem = CalibrationProblem(recording, filtered, load_protocol(protocol), person.prior, {}, load_model())
        posed[name] = pose(problem, SAMPLE_RATE_HZ)
    return posed


def pose(problem: CalibrationProblem, rate_hz: float) -> Posed:
    """The last least squares of a calibration."""
    observations, _ = problem.observe(rate_hz)
    prior = build_prior(problem, observations)
    guess, contact = find_initial_guess(observations, prior.mean, lambda some: build_prior(problem, some).mean)
    weights = solve_reweighted(observations, prior, guess, contact).weights
    return Posed(LeastSquares(observations, prior, weights), guess)


def calibration(clasp_s: float, rates_hz: tuple[float, ...], rounds: int) -> Table:
    """The solve of a hands-together calibration by each solver, at each rate of samples."""
    person = simulate_person(3)
    made = simulate(person.lengths, seed=3, imperfections=MILD_PRESET, clasp_s=clasp_s, circles=0)
    table = Table(
        f"Calibration: {clasp_s:g} s of joined hands, one least squares from one start",
        (
            Column("seconds", "solve [s]", 3),
            Column("spread_s", "± [s]", 3),
            Column("ratio", "ratio to nlpsol", 2, True),
            Column("cost", "cost to nlpsol", 4),
            Column("megabytes", "memory [MB]"),
        ),
        notes=[
            "Processor time of all threads, medians; no compiler. Memory: by how much a new process grows at most.",
            "least_squares: trf, scaled by the Jacobian, default tolerances. Whole: search for a start, all rounds of",
            "weights, the last solve, without the filters. Building: CasADi's functions, once.",
        ],
    )
    for posed, calibrate in pose_problems(made.recording(), person, rates_hz):
        samples = f"{len(posed.problem.weights)} samples"
        table.rows[f"{samples}: building"] = {"seconds": building(posed)}
        costs: dict[str, float] = {}

        def keep_cost(name: str, run: Callable[[], float], costs: dict[str, float] = costs) -> None:
            costs[name] = run()

        cases: dict[str, Callable[[], Any]] = {n: partial(keep_cost, n, run) for n, run in solvers(posed).items()}
        whole = {f"whole, {name}": partial(calibrate_by, run, calibrate) for name, run in SOLVERS.items()}
        timings = time_in_turn(cases | whole, rounds, NLPSOL, time.process_time)
        for name, timing in timings.items():
            row = {"seconds": timing.median, "spread_s": timing.spread, "ratio": timing.ratio}
            if name in cases:
                row |= {"cost": costs[name] / costs[NLPSOL], "megabytes": 1e-6 * peak_memory(posed, name)}
            table.rows[f"{samples}: {name}"] = row
    table.rows = table.known_rows()
    return table


def pose_problems(
    recording: Recording, person: Person, rates_hz: tuple[float, ...]
) -> list[tuple[Posed, Callable[[], Posed]]]:
    """The last problem of a hands-together calibration at each rate of samples, and the calibration without filters."""
    measured = {name: (metres, person.measured_std) for name, metres in person.measured.items()}
    problem = CalibrationProblem(
        recording, filter_recording(recording), load_protocol("clasp"), person.prior, measured, load_model()
    )
    return [(pose(problem, rate_hz), partial(pose, problem, rate_hz)) for rate_hz in rates_hz]


def building(posed: Posed) -> float:
    """Seconds that CasADi's functions take to build, once."""
    least_squares._residual_program.cache_clear()
    observations, begin = posed.problem.observations, time.perf_counter()
    least_squares._residual_program(observations.layout, observations.conditions[0], 0)
    return time.perf_counter() - begin


def solvers(posed: Posed) -> dict[str, Callable[[], float]]:
    """Name → a function that solves it and gives the cost."""
    problem, start = posed.problem, posed.start
    observations, prior, weights = problem.observations, problem.prior, problem.weights
    root_w, root_prior = np.sqrt(weights), np.linalg.cholesky(prior.information).T
    m = len(prior.mean)
    sample = least_squares._residual_function(observations.layout, observations.conditions[0], 0)
    one = [ca.SX.sym("x", m), ca.SX.sym("data", observations.data.shape[0])]
    # Without the Jacobian that `residuals` gives as well.
    alone = make_program(ca.Function("alone", one, sample(*one)[:1]))

    def value(x: np.ndarray) -> np.ndarray:
        (r,) = evaluate(alone, x, observations.data)
        return np.concatenate(((root_w * r).ravel(), root_prior @ (x - prior.mean)))

    def slope(x: np.ndarray) -> np.ndarray:
        J = root_w[:, :, None] * residuals(x, observations)[1]
        return np.concatenate((J.reshape(-1, m), root_prior))

    def by_scipy(jacobian: Callable[[np.ndarray], np.ndarray] | str) -> float:
        return 2.0 * float(optimize.least_squares(value, start, jacobian, method="trf", x_scale="jac").cost)

    return {
        NLPSOL: lambda: solve(problem, start).cost,
        LOOP: lambda: solve_without_bounds(problem, start).cost,
        "least_squares, our Jacobian": lambda: by_scipy(slope),
        "least_squares, 2-point": lambda: by_scipy("2-point"),
    }


def peak_memory(posed: Posed, name: str) -> float:
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
    residuals(posed.start, posed.problem.observations.take(np.arange(10)))  # libraries have loaded what they load
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the highest so far is forgotten
    run()
    print(1024.0 * (_resident("VmHWM") - before))


def _resident(key: str) -> float:
    """[kB]"""
    lines = _STATUS.read_text(encoding="ascii").splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(key)))
