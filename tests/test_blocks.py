"""CasADi functions evaluated block by block give what CasADi's own virtual machine gives."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from wepose_pin.calibration.blocks import BLOCK, evaluate, make_program
from wepose_pin.calibration.conditions import StartPose, find_hinges, find_twists, resolve_conditions
from wepose_pin.calibration.least_squares import Layout, _residual_function
from wepose_pin.calibration.protocols import PROTOCOLS, load_protocol
from wepose_pin.model import load_model

SENSORS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")


@pytest.mark.parametrize("name", [name for name in PROTOCOLS if name != "tip"])  # that is of a robot's arm
def test_every_protocols_residuals_and_jacobians_are_bit_identical(name: str) -> None:
    model, protocol, start = load_model(), load_protocol(name), StartPose({})
    conditions = resolve_conditions(protocol, model, start, SENSORS)
    hinges, twists = find_hinges(model, start, SENSORS), find_twists(model, start, SENSORS)
    points = {kind: sum(closure.kind == kind for closure in protocol.closures) for kind in ("fixed_point", "plane")}
    layout = Layout(tuple(model.lengths), SENSORS, hinges, twists, *points.values(), protocol.distances, ("torso",))
    rng, n = np.random.default_rng(0), 2 * BLOCK + 1
    quats = rng.normal(size=(len(SENSORS), 4, n))
    turns = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).reshape(-1, n)
    data = np.vstack([turns, rng.integers(0, 2, size=(1, n)), rng.uniform(0.0, 60.0, size=(1, n))])
    x = rng.normal(scale=0.2, size=layout.size)
    x[layout.length] = list(model.lengths.values())
    for condition in conditions:
        function = _residual_function(layout, condition, 0)
        program = make_program(function)
        for samples in (1, BLOCK - 1, BLOCK, n):
            results = evaluate(program, x, data[:, :samples])
            for k in {0, samples // 2, samples - 1}:
                for result, expected in zip(results, function(x, data[:, k]), strict=True):
                    np.testing.assert_array_equal(result[k], np.asarray(expected).ravel(order="F"))


def test_an_operation_that_is_not_known_is_an_error() -> None:
    x, data = ca.SX.sym("x", 2), ca.SX.sym("data", 1)
    known = ca.Function("known", [x, data], [ca.vertcat(-x[0] / x[1], 1.0 / x[0], 2.0 * x[1], 0.0, data)])
    [result] = evaluate(make_program(known), np.array([3.0, 4.0]), np.array([[5.0, 6.0]]))
    np.testing.assert_array_equal(result, [[-0.75, 1.0 / 3.0, 8.0, 0.0, 5.0], [-0.75, 1.0 / 3.0, 8.0, 0.0, 6.0]])
    with pytest.raises(NotImplementedError, match="operation"):
        make_program(ca.Function("unknown", [x, data], [ca.tanh(x)]))
