"""The least squares of a calibration by `nlpsol` and by a Gauss-Newton loop in NumPy, from the same start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from wepose_pin.calibration import alternatives, calibrate, weights
from wepose_pin.calibration.least_squares import LOOSE_TOLERANCE, STEPS, Estimate, LeastSquares, solve
from wepose_pin.calibration.weights import FINAL_STEPS
from wepose_pin.errors import NoSolution
from wepose_pin.recording import Recording
from wepose_pin.simulation import MILD_PRESET, simulate, simulate_person

from .tables import Column, Section, Table, time_in_turn

NLPSOL, LOOP = "nlpsol", "Gauss-Newton loop"
FINE = 3e-7  # standard deviations to go, at which the loop is done
# Marquardt's damping at the start, as a share of the Hessian's diagonal, by how much it changes, and within what.
DAMPING, DAMPING_FACTOR = 1e-4, 8.0
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e8


def solve_without_bounds(
    problem: LeastSquares, start: np.ndarray, steps: int = STEPS, *, strict: bool = True
) -> Estimate:
    """The minimiser by Gauss-Newton, damped where a step does not lower the cost; parameters and errors as `solve`."""
    now, damping = Estimate(problem, start), DAMPING
    for _ in range(steps):
        if measure_remaining(now) < FINE:
            return now
        before, H = now, now.information
        while True:
            step = np.linalg.solve(H + damping * np.diag(np.diag(H)), before.gradient)
            now = Estimate(problem, before.x - step)
            if now.cost <= before.cost * (1.0 + 1e-12) or damping > MOST_DAMPING:
                break
            damping *= DAMPING_FACTOR
        damping = max(damping / DAMPING_FACTOR, LEAST_DAMPING)
    if strict and measure_remaining(now) > LOOSE_TOLERANCE:
        raise NoSolution(f"the lengths did not converge ({measure_remaining(now):.2g} standard deviations to go)")
    return now


def measure_remaining(estimate: Estimate) -> float:
    """What is left to go without bounds [standard deviations]."""
    return float(np.sqrt(estimate.gradient @ np.linalg.solve(estimate.information, estimate.gradient)))


SOLVERS: dict[str, Callable[..., Estimate]] = {NLPSOL: solve, LOOP: solve_without_bounds}


def exchange_solver(run: Callable[..., Estimate]) -> None:
    """Solve the least squares of calibrations by `run` from now on; its parameters are those of `solve`."""
    weights.solve = alternatives.solve = run  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Posed:
    """A least squares and the x (m,) to start from."""

    problem: LeastSquares
    start: np.ndarray


def sections(quick: bool) -> dict[str, Section]:
    """Name → a function that measures it."""
    return {"calibration": partial(solvers_by_case, 30.0 if quick else 60.0, 1 if quick else 3)}


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
            Column("difference", "difference [1e-3 std]", 3),
        ),
        notes=[
            f"Processor time, medians of {rounds}; the loop goes on to {FINE:g} standard deviations. Difference: the",
            "largest over all unknowns, in units of their own standard deviations.",
        ],
    )
    for name, posed in pose_cases(seconds).items():
        runs: dict[str, Callable[[], Any]] = {
            solver: partial(run, posed.problem, posed.start, FINAL_STEPS) for solver, run in SOLVERS.items()
        }
        timings = time_in_turn(runs, rounds, LOOP)
        estimates = {solver: run() for solver, run in runs.items()}
        std = np.sqrt(np.diag(estimates[LOOP].covariance))
        table.rows[name] = {
            "unknowns": len(posed.start),
            "samples": len(posed.problem.observations),
            "nlpsol_s": timings[NLPSOL].median,
            "loop_s": timings[LOOP].median,
            "ratio": timings[NLPSOL].ratio,
            "difference": 1e3 * float(np.abs((estimates[NLPSOL].x - estimates[LOOP].x) / std).max()),
        }
    return table


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
    return {
        name: record_last(recording, protocol=protocol, prior=person.prior)
        for name, (protocol, recording) in recordings.items()
    }


def record_last(recording: Recording, **options: Any) -> Posed:
    """The last least squares of a calibration that must converge, from where the first one starts."""
    posed: list[Posed] = []

    def solve_and_record(
        problem: LeastSquares, start: np.ndarray, steps: int = STEPS, *, strict: bool = True
    ) -> Estimate:
        posed.append(Posed(problem, start))
        return solve(problem, start, steps, strict=strict)

    exchange_solver(solve_and_record)
    try:
        calibrate(recording, **options)
    finally:
        exchange_solver(solve)
    size = max(len(each.problem.observations) for each in posed)
    full = [each for each in posed if len(each.problem.observations) == size]
    return Posed(full[-1].problem, full[0].start)
