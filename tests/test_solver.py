"""`nlpsol` beside the Gauss-Newton loop on the same least squares: the solution, the bounds, the steps."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import LENGTHS

from benchmarks.calibration import Posed, pose_cases, solve_without_bounds
from wepose_pin.calibration.least_squares import MIN_LENGTH, Estimate, Gaussian, solve
from wepose_pin.errors import NoSolution


@pytest.fixture(scope="module")
def cases() -> dict[str, Posed]:
    return pose_cases(15.0)


@pytest.mark.parametrize("name", ["clasp", "clasp, unknown mounts", "clasp, 5 s", "t_pose+bow"])
def test_both_solvers_find_the_same(cases: dict[str, Posed], name: str) -> None:
    problem, start = cases[name].problem, cases[name].start
    fine, usual = solve_without_bounds(problem, start, 300), solve(problem, start)
    assert np.abs((usual.x - fine.x) / np.sqrt(np.diag(fine.covariance))).max() < 1e-3
    assert usual.cost == pytest.approx(fine.cost, rel=1e-6)
    assert usual.remaining < 1e-3


def test_a_length_stays_above_its_bound(cases: dict[str, Posed]) -> None:
    """The prior wants a hand of −5 cm, the samples cannot tell: the loop goes there, `nlpsol` to the bound."""
    problem, start = cases["clasp"].problem, cases["clasp"].start
    mean, information = problem.prior.mean.copy(), problem.prior.information.copy()
    k = len(LENGTHS) - 1
    mean[k] = -0.05
    information[k, :], information[:, k], information[k, k] = 0.0, 0.0, 1e8
    problem = problem._replace(prior=Gaussian(mean, information))
    assert solve_without_bounds(problem, start).x[k] < 0.0
    estimate = solve(problem, start)
    assert estimate.x[k] == pytest.approx(MIN_LENGTH, abs=1e-6)
    assert np.all(estimate.x[: len(LENGTHS)] >= MIN_LENGTH)
    assert estimate.remaining < 1e-3  # all else is the best that this length allows
    assert estimate.gradient[k] > 0.0


def test_steps_that_do_not_suffice(cases: dict[str, Posed]) -> None:
    problem, start = cases["clasp, unknown mounts"].problem, cases["clasp, unknown mounts"].start
    with pytest.raises(NoSolution, match=r"the lengths did not converge \(.* standard deviations to go\)"):
        solve(problem, start, 1)
    assert solve(problem, start, 1, strict=False).cost < Estimate(problem, start).cost


def test_casadi_prints_nothing(cases: dict[str, Posed], capfd: pytest.CaptureFixture[str]) -> None:
    solve(cases["clasp, unknown mounts"].problem, cases["clasp, unknown mounts"].start)
    assert capfd.readouterr() == ("", "")
