"""CasADi functions evaluated block by block give what CasADi's own virtual machine gives."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from wepose_pin.calibration.blocks import BLOCK, evaluate, make_program
from wepose_pin.calibration.least_squares import _residual_function, residuals
from wepose_pin.calibration.priors import build_prior
from wepose_pin.calibration.problem import CalibrationProblem
from wepose_pin.calibration.protocols import load_protocol
from wepose_pin.filters.sensors import filter_recording
from wepose_pin.model import load_model
from wepose_pin.simulation import simulate, simulate_person


@pytest.mark.parametrize("name", ["clasp", "clasp+t_pose+bow", "t_pose+bow"])
def test_residuals_and_jacobians_are_bit_identical(name: str) -> None:
    person = simulate_person(3)
    recording = simulate(person.lengths, seed=3, clasp_s=20.0, circles=0, protocol=name).recording()
    filtered = filter_recording(recording)
    problem = CalibrationProblem(recording, filtered, load_protocol(name), person.prior, {}, load_model())
    observations, _ = problem.observe()
    assert len(observations) % BLOCK
    x = build_prior(problem, observations).mean + np.random.default_rng(0).normal(
        scale=0.01, size=observations.layout.size
    )
    r, J, gaps = residuals(x, observations)
    for condition, span in observations.spans():
        function = _residual_function(observations.layout, condition, 0)
        for k in range(span.start, span.stop):
            expected = [np.asarray(result) for result in function(x, observations.data[:, k])]
            for result, value in zip((r[k], J[k].T, gaps[k]), expected, strict=True):
                np.testing.assert_array_equal(result, value.reshape(result.shape))


@pytest.mark.parametrize("samples", [1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK])
def test_any_number_of_samples(samples: int) -> None:
    x, data = ca.SX.sym("x", 2), ca.SX.sym("data", 3)
    program = make_program(ca.Function("sum", [x, data], [x[0] * data + x[1], data[2]]))
    rows = np.random.default_rng(0).normal(size=(3, samples))
    first, second = evaluate(program, np.array([2.0, 3.0]), rows)
    np.testing.assert_array_equal(first, (2.0 * rows + 3.0).T)
    np.testing.assert_array_equal(second, rows[2:].T)


def test_operations_and_their_derivatives_are_bit_identical() -> None:
    x, data = ca.SX.sym("x", 3), ca.SX.sym("data", 2)
    angle = ca.fmin(ca.atan2(x[0] * data[0], -data[1]), x[2])
    values = ca.vertcat(-x[0] / data[0], 1.0 / x[0], 2.0 * x[1], 0.0, ca.exp(-angle / x[2]), ca.sqrt(x[0] ** 2 + angle))
    function = ca.Function("all", [x, data], [values, ca.densify(ca.jacobian(values, x))])
    rows, at = np.random.default_rng(0).uniform(0.1, 2.0, size=(2, 200)), np.array([0.7, 1.3, 2.2])
    results = evaluate(make_program(function), at, rows)
    for k in range(200):
        for result, expected in zip(results, function(at, rows[:, k]), strict=True):
            np.testing.assert_array_equal(result[k], np.asarray(expected).ravel(order="F"))


def test_an_operation_that_is_not_known_is_an_error() -> None:
    x, data = ca.SX.sym("x"), ca.SX.sym("data")
    with pytest.raises(NotImplementedError, match="operation"):
        make_program(ca.Function("unknown", [x, data], [ca.tanh(x)]))
