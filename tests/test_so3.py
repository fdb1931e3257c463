"""Rotations: group axioms, small angles, the compiled step against SciPy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from wepose_pin import so3

ANGLES = np.concatenate(
    [[0.0], np.logspace(-16, 0, 33), 2 * so3.SERIES_HALF_ANGLE * (1 + np.array([-1e-3, 1e-3])), [3.0, np.pi - 1e-9]]
)


def cross_matrix(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    axis = np.array([0.36, -0.48, 0.8])
    matrix = expm(cross_matrix(angle * axis))
    np.testing.assert_allclose(Rotation.from_quat(so3.exp(angle * axis)).as_matrix(), matrix, atol=1e-14)
    quat = np.array([0.0, 0.0, 0.0, 1.0])
    so3.rotate_by_vector(quat, *(angle * axis))
    np.testing.assert_allclose(Rotation.from_quat(quat).as_matrix(), matrix, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle: float) -> None:
    vector = angle * np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(so3.log(so3.exp(vector)), vector, atol=1e-12)


def test_the_compiled_step_keeps_relative_precision_on_both_sides_of_its_switch() -> None:
    for half in so3.SERIES_HALF_ANGLE * np.array([1e-15, 1e-8, 1e-4, 0.1, 0.5, 0.99, 0.999999, 1.000001, 1.01, 3.0]):
        quat = np.array([0.0, 0.0, 0.0, 1.0])
        so3.rotate_by_vector(quat, 2.0 * half, 0.0, 0.0)
        assert quat[0] == pytest.approx(np.sin(half), rel=1e-15, abs=0.0)
        assert quat[3] == pytest.approx(np.cos(half), rel=1e-15, abs=1e-16)


@pytest.mark.parametrize("scale", [1e-3, 0.9, 1 - 1e-8, 1 - 1e-9, 1 + 1e-9, 1 + 1e-8, 1.1, 1e3])
def test_the_compiled_step_renormalises_on_both_sides_of_its_switch(scale: float) -> None:
    start = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_quat()
    quat, unit = scale * start, start.copy()
    so3.rotate_by_vector(quat, 0.1, 0.2, -0.3)
    so3.rotate_by_vector(unit, 0.1, 0.2, -0.3)
    assert np.linalg.norm(quat) == pytest.approx(1.0, rel=1e-15, abs=0.0)
    np.testing.assert_allclose(quat, unit, rtol=1e-15)


def test_a_million_steps_stay_on_the_sphere() -> None:
    steps = np.random.default_rng(3).normal(scale=0.05, size=(1_000_000, 3))
    assert np.abs(np.linalg.norm(so3.integrate(steps), axis=1) - 1.0).max() < 1e-15


def test_the_compiled_step_multiplies_on_the_right() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        start, turn = Rotation.random(random_state=rng), rng.normal(size=3)
        quat = start.as_quat()
        so3.rotate_by_vector(quat, *turn)
        expected = start * Rotation.from_rotvec(turn)
        assert (expected.inv() * Rotation.from_quat(quat)).magnitude() < 1e-14
        np.testing.assert_allclose(so3.up_in_sensor(quat), expected.as_matrix()[2], atol=1e-14)


_FIRST_USE = """
import numpy as np
from wepose_pin import so3
print(so3.integrate(np.zeros((3, 3)))[-1].tolist())
"""
_FULL_DISK = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
"""


def _fresh(code: str, **environment: str) -> str:
    run = subprocess.run(
        [sys.executable, "-B", "-c", code], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    assert run.stderr == ""
    return run.stdout


def test_compiled_once_and_kept(tmp_path: Path) -> None:
    assert _fresh(_FIRST_USE, NUMBA_CACHE_DIR=str(tmp_path)) == "[0.0, 0.0, 0.0, 1.0]\n"
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")}
    assert kept
    assert _fresh(_FIRST_USE, NUMBA_CACHE_DIR=str(tmp_path)) == "[0.0, 0.0, 0.0, 1.0]\n"
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")} == kept


def test_a_full_disk_is_no_error(tmp_path: Path) -> None:
    assert _fresh(_FULL_DISK + _FIRST_USE, NUMBA_CACHE_DIR=str(tmp_path)) == "[0.0, 0.0, 0.0, 1.0]\n"


def test_nowhere_to_keep_what_is_compiled_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_a_folder(**options: Any) -> Any:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(so3, "njit", without_a_folder)
    for decorator in (so3.compiled, so3.kernel):
        assert decorator(lambda x: x + 1.0)(1.0) == 2.0


def test_orders_of_the_quaternion() -> None:
    xyzw = np.array([[0.1, 0.2, 0.3, 0.9], [0.0, 0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(so3.wxyz_from_xyzw(xyzw)[0], [0.9, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(so3.xyzw_from_wxyz(so3.wxyz_from_xyzw(xyzw)), xyzw)


@pytest.mark.parametrize(
    "up_S", [[0, 0, 1], [1, 0, 0], [0, -1, 0], [0, 0, -1], [1e-9, 0, -1], [0.3, -0.5, -0.9], [0, 1e-17, 1]]
)
def test_tilt_takes_accel_to_the_vertical_without_heading(up_S: list[float]) -> None:
    accel = 9.81 * np.array(up_S, dtype=float)
    quat = so3.tilt(accel)
    up_W = Rotation.from_quat(quat).apply(accel / np.linalg.norm(accel))
    np.testing.assert_allclose(up_W, [0, 0, 1], atol=1e-7)
    assert np.linalg.norm(quat) == pytest.approx(1.0)
    assert quat[2] == 0.0


def test_tilt_of_nothing_is_an_error() -> None:
    with pytest.raises(ValueError, match="zero acceleration"):
        so3.tilt([0.0, 0.0, 0.0])


def test_heading_is_the_twist_about_the_vertical() -> None:
    for psi in np.linspace(-3.1, 3.1, 13):
        for tilt in ([0, 0, 0], [0.4, 0, 0], [0.3, -1.2, 0]):
            rotation = Rotation.from_rotvec([0, 0, psi]) * Rotation.from_rotvec(tilt)
            assert so3.heading(rotation.as_quat()) == pytest.approx(psi)
            assert so3.heading(-rotation.as_quat()) == pytest.approx(psi)


def test_continuous_changes_signs_and_nothing_else() -> None:
    quat = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, 0, 12.0], 500)).as_quat()
    flipped = quat * np.where(np.random.default_rng(1).random(500) < 0.5, -1.0, 1.0)[:, None]
    smooth = so3.continuous(flipped)
    np.testing.assert_array_equal(np.abs(smooth), np.abs(flipped))
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.02


def test_integrate_turns_step_by_step() -> None:
    steps = np.random.default_rng(2).normal(scale=0.1, size=(50, 3))
    total = Rotation.identity()
    for step in steps:
        total = total * Rotation.from_rotvec(step)
    assert (total.inv() * Rotation.from_quat(so3.integrate(steps)[-1])).magnitude() < 1e-13
