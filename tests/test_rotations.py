"""Rotations: group axioms, small angles, the compiled step against SciPy."""

import numpy as np
import pytest
from numba import njit
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from wepose_pin import rotations

SWITCH = 2.0 * rotations.SERIES_HALF_ANGLE
ANGLES = np.concatenate([[0.0], np.logspace(-16, 0, 33), [0.999 * SWITCH, 1.001 * SWITCH, 3.0, np.pi - 1e-9]])


def cross_matrix(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    axis = np.array([0.36, -0.48, 0.8])
    matrix = expm(cross_matrix(angle * axis))
    np.testing.assert_allclose(Rotation.from_quat(rotations.exp(angle * axis)).as_matrix(), matrix, atol=1e-14)
    quat = np.array([0.0, 0.0, 0.0, 1.0])
    rotations.rotate_by_vector(quat, *(angle * axis))
    np.testing.assert_allclose(Rotation.from_quat(quat).as_matrix(), matrix, atol=1e-14)


@pytest.mark.parametrize("scale", [1 - 1e-9, 1 + 1e-9])
def test_the_compiled_step_renormalises(scale: float) -> None:
    start = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_quat()
    quat, unit = scale * start, start.copy()
    rotations.rotate_by_vector(quat, 0.1, 0.2, -0.3)
    rotations.rotate_by_vector(unit, 0.1, 0.2, -0.3)
    assert np.linalg.norm(quat) == pytest.approx(1.0, rel=1e-15, abs=0.0)
    np.testing.assert_allclose(quat, unit, rtol=1e-15)


@pytest.mark.parametrize(
    "up_S", [[0, 0, 1], [1, 0, 0], [0, -1, 0], [0, 0, -1], [1e-9, 0, -1], [0.3, -0.5, -0.9], [0, 1e-17, 1]]
)
def test_tilt_takes_accel_to_the_vertical_without_heading(up_S: list[float]) -> None:
    accel = 9.81 * np.array(up_S, dtype=float)
    quat = rotations.quat_from_gravity(accel)
    up_W = Rotation.from_quat(quat).apply(accel / np.linalg.norm(accel))
    np.testing.assert_allclose(up_W, [0, 0, 1], atol=1e-7)
    assert np.linalg.norm(quat) == pytest.approx(1.0)
    assert quat[2] == 0.0


def test_heading_is_the_twist_about_the_vertical() -> None:
    for psi in np.linspace(-3.1, 3.1, 13):
        for tilt in ([0, 0, 0], [0.4, 0, 0], [0.3, -1.2, 0]):
            rotation = Rotation.from_rotvec([0, 0, psi]) * Rotation.from_rotvec(tilt)
            assert rotations.heading(rotation.as_quat()) == pytest.approx(psi)
            assert rotations.heading(-rotation.as_quat()) == pytest.approx(psi)


def test_continuous_changes_signs_and_nothing_else() -> None:
    quat = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, 0, 12.0], 500)).as_quat()
    flipped = quat * np.where(np.random.default_rng(1).random(500) < 0.5, -1.0, 1.0)[:, None]
    smooth = rotations.unwrap_signs(flipped)
    np.testing.assert_array_equal(np.abs(smooth), np.abs(flipped))
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.02


def test_products_of_arrays_are_scipys() -> None:
    rng = np.random.default_rng(4)
    a, b = Rotation.random(20, random_state=rng), Rotation.random(20, random_state=rng)
    product = rotations.multiply(a.as_quat(), b.as_quat())
    assert ((a * b).inv() * Rotation.from_quat(product)).magnitude().max() < 1e-14
    np.testing.assert_array_equal(rotations.multiply(a.as_quat(), b.as_quat()[0])[0], product[0])
    back = rotations.multiply(rotations.conjugate(a.as_quat()), a.as_quat())
    np.testing.assert_allclose(back, np.tile([0.0, 0.0, 0.0, 1.0], (20, 1)), atol=1e-15)
    axis, angle = np.array([0.36, -0.48, 0.8]), np.array([-7.0, 0.0, 1e-12, 2.0])
    turned = rotations.rotation_about(axis, angle)
    np.testing.assert_allclose(
        Rotation.from_quat(turned).as_matrix(), Rotation.from_rotvec(angle[:, None] * axis).as_matrix(), atol=1e-14
    )


@njit
def _rotate_in_world(quat, x, y, z):  # type: ignore[no-untyped-def]
    """Call the kernel that is a part of others and cannot be called from here."""
    rotations.rotate_by_world_vector(quat, x, y, z)


@pytest.mark.parametrize("angle", ANGLES)
def test_kernels_on_both_sides_of_their_switches(angle: float) -> None:
    axis, start = np.array([0.36, -0.48, 0.8]), Rotation.from_rotvec([0.3, -0.5, 0.9])
    in_sensor, in_world, R = start.as_quat(), start.as_quat(), np.empty((3, 3))
    rotations.rotate_by_vector(in_sensor, *(angle * axis))
    _rotate_in_world(in_world, *(angle * axis))
    rotations.fill_matrix(start.as_quat(), R)
    turn = Rotation.from_rotvec(angle * axis)
    np.testing.assert_allclose(Rotation.from_quat(in_sensor).as_matrix(), (start * turn).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(Rotation.from_quat(in_world).as_matrix(), (turn * start).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(R, start.as_matrix(), atol=1e-15)
