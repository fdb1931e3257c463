"""The filters that are compared: none is handicapped, and each gives an orientation in our convention."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation.contenders import Contender, list_contenders
from benchmarks.validation.experiment import align_rotation
from benchmarks.validation.single import SingleSensor, simulate_paper_dynamic
from wepose_pin.evaluation import attitude_error
from wepose_pin.filters.noise import estimate_noise

SETTING = "simulated 100 Hz"
ALL = list_contenders(SETTING)
NAMES = [contender.label for contender in ALL]


@pytest.fixture(scope="module")
def sensor() -> SingleSensor:
    return simulate_paper_dynamic(50, 100.0)


def at_rest(sensor: SingleSensor) -> np.ndarray:
    return (sensor.time >= 0.5) & (sensor.time <= 4.5)


@pytest.mark.parametrize("contender", ALL, ids=NAMES)
def test_orientations_are_xyzw_from_sensor_to_a_world_with_z_up(contender: Contender, sensor: SingleSensor) -> None:
    """Another order or the inverse is off by tens of degrees."""
    rest = at_rest(sensor)
    noise = estimate_noise(sensor.gyro_S[rest], sensor.accel_S[rest], sensor.rate_hz)
    quat = contender.orient(sensor.gyro_S, sensor.accel_S, sensor.rate_hz, noise)
    assert quat.shape == (len(sensor.time), 4)
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-12)
    true = Rotation.from_quat(sensor.quat_WS)
    error = attitude_error(align_rotation(Rotation.from_quat(quat), true, rest), true, sensor.time)
    print(f"{contender.label}: {error.total_rmse:.2f} deg")
    assert error.total_rmse < (8.0 if "default gains" in contender.label else 3.0)
