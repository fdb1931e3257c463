"""`nlpsol` on the least squares of calibrations: the solution, the bounds, the steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from bodies import LENGTHS

from wepose_pin.calibration import calibrate, weights
from wepose_pin.calibration.least_squares import MIN_LENGTH, Estimate, Gaussian, LeastSquares, solve
from wepose_pin.errors import WeposeError
from wepose_pin.simulation import MILD_PRESET, simulate, simulate_person


class Posed(NamedTuple):
    """A least squares and the x (m,) to start from."""

    problem: LeastSquares
    start: np.ndarray


@pytest.fixture(scope="module")
def cases() -> dict[str, Posed]:
    """Mounts of a person's clasp → the last least squares of the calibration, from where the first one starts."""
    person, cases = simulate_person(3), {}
    for mount in ("stated", "any"):
        sizes, posed = replace(MILD_PRESET, mount=mount), list[Posed]()

        def record(problem: LeastSquares, start: np.ndarray, *args: Any, posed: list = posed, **options: Any) -> Any:
            posed.append(Posed(problem, start))
            return solve(problem, start, *args, **options)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(weights, "solve", record)
            made = simulate(person.lengths, seed=3, imperfections=sizes, clasp_s=15.0, circles=0)
            calibrate(made.recording(), prior=person.prior)
        size = max(len(each.problem.observations) for each in posed)
        full = [each for each in posed if len(each.problem.observations) == size]
        cases[mount] = Posed(full[-1].problem, full[0].start)
    return cases


@pytest.mark.parametrize("mount", ["stated", "any"])
def test_the_solution_is_the_minimum_from_wherever_it_starts(cases: dict[str, Posed], mount: str) -> None:
    """A Newton step from it is a thousandth of a standard deviation, and no way of a tenth of one leads down."""
    problem, start = cases[mount]
    found = solve(problem, start)
    std = np.sqrt(np.diag(found.covariance))
    assert found.remaining < 1e-3
    assert np.sqrt(found.gradient @ np.linalg.solve(found.information, found.gradient)) < 1e-3
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert Estimate(problem, found.x + 0.1 * std * rng.standard_normal(len(std))).cost > found.cost
    again = solve(problem, found.x + std * rng.standard_normal(len(std)))
    assert np.abs((again.x - found.x) / std).max() < 1e-2


def test_a_length_stays_above_its_bound(cases: dict[str, Posed]) -> None:
    """The prior wants a hand of −5 cm, and the samples cannot tell."""
    problem, start = cases["stated"]
    mean, information = problem.prior.mean.copy(), problem.prior.information.copy()
    k = len(LENGTHS) - 1
    mean[k] = -0.05
    information[k, :], information[:, k], information[k, k] = 0.0, 0.0, 1e8
    estimate = solve(problem._replace(prior=Gaussian(mean, information)), start)
    assert estimate.x[k] == pytest.approx(MIN_LENGTH, abs=1e-6)
    assert np.all(estimate.x[: len(LENGTHS)] >= MIN_LENGTH)
    assert estimate.remaining < 1e-3  # all else is the best that this length allows
    assert estimate.gradient[k] > 0.0


def test_steps_that_do_not_suffice(cases: dict[str, Posed]) -> None:
    problem, start = cases["any"]
    with pytest.raises(WeposeError, match=r"the lengths did not converge \(.* standard deviations to go\)"):
        solve(problem, start, 1)
    assert solve(problem, start, 1, strict=False).cost < Estimate(problem, start).cost


def test_casadi_prints_nothing(cases: dict[str, Posed], capfd: pytest.CaptureFixture[str]) -> None:
    solve(*cases["any"])
    assert capfd.readouterr() == ("", "")
