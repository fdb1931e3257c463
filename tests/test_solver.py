"""`nlpsol` beside the Gauss-Newton loop on the same least squares: the solution, the bounds, the steps, errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import LENGTHS

from benchmarks.calibration import Posed, count_evaluations, pose_cases, solve_without_bounds
from wepose_pin.calibration import solver
from wepose_pin.calibration.least_squares import Gaussian
from wepose_pin.calibration.solver import MIN_LENGTH, TOLERANCE, LeastSquares, solve
from wepose_pin.errors import NoSolution


@pytest.fixture(scope="module")
def cases() -> dict[str, Posed]:
    return pose_cases(15.0)


def largest_difference(problem: LeastSquares, a: np.ndarray, b: np.ndarray) -> float:
    """[standard deviations of the solution]"""
    return float(np.abs((a - b) / np.sqrt(np.diag(np.linalg.inv(problem.evaluate(a).information)))).max())


CASES = ["clasp", "clasp, unknown mounts", "clasp, 5 s", "t_pose+bow"]


@pytest.mark.parametrize("name", CASES)
def test_both_solvers_find_the_same(cases: dict[str, Posed], name: str) -> None:
    problem, start = cases[name].problem, cases[name].start
    fine = [run(problem, start, 300, True, 3e-7) for run in (solve, solve_without_bounds)]
    assert largest_difference(problem, fine[0].x, fine[1].x) < 1e-6
    assert fine[0].cost == pytest.approx(fine[1].cost, rel=1e-12)
    usual = solve(problem, start)
    assert largest_difference(problem, usual.x, fine[1].x) < 1e-3
    np.testing.assert_array_equal(usual.closure, problem.evaluate(usual.x).r[:, :3])
    assert problem.evaluate(usual.x).remaining() < 1e-4


def test_a_length_stays_above_its_bound(cases: dict[str, Posed]) -> None:
    """The prior wants a hand of −5 cm, the samples cannot tell: the loop goes there, `nlpsol` to the bound."""
    problem, start = cases["clasp"].problem, cases["clasp"].start
    mean, information = problem.prior.mean.copy(), problem.prior.information.copy()
    k = len(LENGTHS) - 1
    mean[k] = -0.05
    information[k, :], information[:, k], information[k, k] = 0.0, 0.0, 1e8
    problem = replace(problem, prior=Gaussian(mean, information))
    assert solve_without_bounds(problem, start).x[k] < 0.0
    fit = solve(problem, start)
    assert fit.x[k] == pytest.approx(MIN_LENGTH, abs=1e-6)
    assert np.all(fit.x[: len(LENGTHS)] >= MIN_LENGTH - 1e-6)
    # All else is the best that this length allows.
    others = np.arange(len(start)) != k
    gradient = problem.evaluate(fit.x).gradient
    left = np.linalg.solve(fit.information[np.ix_(others, others)], gradient[others])
    assert np.sqrt(gradient[others] @ left) < 1e-3
    assert gradient[k] > 0.0


def test_steps_that_do_not_suffice(cases: dict[str, Posed]) -> None:
    problem, start = cases["clasp, unknown mounts"].problem, cases["clasp, unknown mounts"].start
    with pytest.raises(NoSolution, match=r"the lengths did not converge \(.* standard deviations to go\)"):
        solve(problem, start, 1)
    loose = solve(problem, start, 1, strict=False)
    assert loose.cost < problem.evaluate(start).cost
    assert count_evaluations(lambda: solve(problem, start, 3, strict=False)) <= 3 * 3


def test_many_small_ways_to_go_are_gone(cases: dict[str, Posed], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each number of the gradient is below what `nlpsol` looks for, all together are more than may be left."""
    problem, minimise, calls = cases["clasp"].problem, solver._minimise, 0
    best = solve(problem, cases["clasp"].start, tolerance=1e-7)
    z = np.full(len(best.x), 0.4 * TOLERANCE)
    start = problem.evaluate(best.x + np.linalg.solve(np.linalg.cholesky(best.information).T, z))
    assert start.remaining() > TOLERANCE

    def counted(*arguments: object) -> object:
        nonlocal calls
        calls += 1
        return minimise(*arguments)

    monkeypatch.setattr(solver, "_minimise", counted)
    fit = solve(problem, start.x)
    assert problem.evaluate(fit.x).remaining() < TOLERANCE
    assert calls <= 3


def test_a_solution_is_not_evaluated_again(cases: dict[str, Posed]) -> None:
    problem, start = cases["clasp, 5 s"].problem, cases["clasp, 5 s"].start
    fit = solve(problem, start)
    assert count_evaluations(lambda: solve(problem, fit)) == 0
    assert solve(problem, fit).x is fit.x


def test_an_interruption_passes_through_casadi(cases: dict[str, Posed], monkeypatch: pytest.MonkeyPatch) -> None:
    problem, start = cases["t_pose+bow"].problem, cases["t_pose+bow"].start
    calls = 0

    def interrupted(*arguments: object) -> object:
        nonlocal calls
        calls += 1
        if calls > 1:
            raise KeyboardInterrupt
        return residuals(*arguments)

    residuals = solver.residuals
    monkeypatch.setattr(solver, "residuals", interrupted)
    with pytest.raises(KeyboardInterrupt):
        solve(problem, start)
    assert calls == 2


@pytest.mark.parametrize("factor", [np.nan, 0.0, -1.0])
def test_where_a_quadratic_program_has_no_solution_it_goes_on_from_the_last_step(
    cases: dict[str, Posed], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], factor: float
) -> None:
    """CasADi writes nothing meanwhile: a program that raises would print its matrices."""
    problem, start = cases["clasp, unknown mounts"].problem, cases["clasp, unknown mounts"].start
    curvature, calls = solver._Oracle.curvature, 0

    def broken_once(oracle: solver._Oracle, z: np.ndarray) -> tuple[np.ndarray, ...]:
        nonlocal calls
        calls += 1
        (H,) = curvature(oracle, z)
        return (factor * H if calls == 3 else H,)

    monkeypatch.setattr(solver._Oracle, "curvature", broken_once)
    fit = solve(problem, start)
    assert calls > 3
    assert capfd.readouterr() == ("", "")
    assert largest_difference(problem, fit.x, solve_without_bounds(problem, start).x) < 1e-3
