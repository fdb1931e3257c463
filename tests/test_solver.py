"""`nlpsol` on the least squares of calibrations: the solution, the bounds, the steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bodies import LENGTHS

from wepose_pin.calibration import calibrate, weights
from wepose_pin.calibration.least_squares import MIN_LENGTH, LeastSquares, solve
from wepose_pin.errors import WeposeError
from wepose_pin.simulation import MILD_PRESET, simulate, simulate_person


@pytest.fixture(scope="module")
def cases() -> dict[str, LeastSquares]:
    """Mounts of a person's clasp → the last least squares of the calibration, from where the first one starts."""
    person, cases = simulate_person(3), {}
    for mount in ("stated", "any"):
        sizes, posed = replace(MILD_PRESET, mount=mount), list[LeastSquares]()

        def record(problem: LeastSquares, *args: Any, posed: list = posed, **options: Any) -> LeastSquares:
            posed.append(problem)
            return solve(problem, *args, **options)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(weights, "solve", record)
            made = simulate(person.lengths, seed=3, imperfections=sizes, clasp_s=15.0, circles=0)
            calibrate(made.recording(), prior=person.prior)
        size = max(len(each.observations) for each in posed)
        full = [each for each in posed if len(each.observations) == size]
        cases[mount] = replace(full[-1], x=full[0].x)
    return cases


@pytest.mark.parametrize("mount", ["stated", "any"])
def test_the_solution_is_the_minimum_from_wherever_it_starts(cases: dict[str, LeastSquares], mount: str) -> None:
    """A Newton step from it is a thousandth of a standard deviation, and no way of a tenth of one leads down."""
    problem = cases[mount]
    found = solve(problem)
    std = np.sqrt(np.diag(found.covariance))
    assert found.remaining < 1e-3
    assert np.sqrt(found.gradient @ np.linalg.solve(found.information, found.gradient)) < 1e-3
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert replace(problem, x=found.x + 0.1 * std * rng.standard_normal(len(std))).cost > found.cost
    again = solve(replace(problem, x=found.x + std * rng.standard_normal(len(std))))
    assert np.abs((again.x - found.x) / std).max() < 1e-2


def test_a_length_stays_above_its_bound(cases: dict[str, LeastSquares]) -> None:
    """The prior wants a hand of −5 cm, and the samples cannot tell."""
    problem = cases["stated"]
    mean, information = (each.copy() for each in problem.prior)
    k = len(LENGTHS) - 1
    mean[k] = -0.05
    information[k, :], information[:, k], information[k, k] = 0.0, 0.0, 1e8
    estimate = solve(replace(problem, prior=(mean, information)))
    assert estimate.x[k] == pytest.approx(MIN_LENGTH, abs=1e-6)
    assert np.all(estimate.x[: len(LENGTHS)] >= MIN_LENGTH)
    assert estimate.remaining < 1e-3  # all else is the best that this length allows
    assert estimate.gradient[k] > 0.0


def test_steps_that_do_not_suffice(cases: dict[str, LeastSquares]) -> None:
    problem = cases["any"]
    with pytest.raises(WeposeError, match=r"the lengths did not converge \(.* standard deviations to go\)"):
        solve(problem, 1)
    assert solve(problem, 1, strict=False).cost < problem.cost


def test_casadi_prints_nothing(cases: dict[str, LeastSquares], capfd: pytest.CaptureFixture[str]) -> None:
    solve(cases["any"])
    assert capfd.readouterr() == ("", "")
