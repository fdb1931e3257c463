"""Smoother: against a textbook RTS with full matrices, against the filter it smooths, and its edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_amekf import RATE, Case, case, cov, errors, run, tilt_deg

from wepose_pin import rotations
from wepose_pin.filters import Amekf, AmekfParams, Smoother
from wepose_pin.filters.amekf import BLOCK, ERROR, STATES, fill_transition_rows

BIASES = np.r_[ERROR.gyro_bias, ERROR.motion_bias]


def part(of: Case, samples: slice) -> Case:
    return of._replace(gyro=of.gyro[samples], accel=of.accel[samples], static=of.static[samples], true=of.true[samples])


def test_the_backward_pass_is_the_textbook_s() -> None:
    """G = P Fᵀ (P⁻)⁻¹, x_s = x + G (x_s⁺ − x⁻), P_s = P + G (P_s⁺ − P⁻) Gᵀ, block by block, rest and motion."""
    of = part(case(0), slice(300, 900))
    params = AmekfParams(tilt_std=0.05)
    forward = Amekf(of.noise, RATE, of.start, params)
    P, F, P_before, correction, quats = [forward.state["P"][0, :, :STATES].copy()], [], [], [], []
    for first in range(0, 600, 25):
        at = slice(first, first + 25)
        forward.blocks = blocks = np.empty(1, BLOCK)
        quats.append(forward.run(of.gyro[at], of.accel[at], of.static[at]).quat_VS[-1])
        P.append(forward.state["P"][0, :, :STATES].copy())
        rows, whole = np.empty((7, STATES)), np.eye(STATES)
        fill_transition_rows(blocks[0], of.noise.gravity, np.eye(STATES), rows)
        whole[:7] = rows
        F.append(whole)
        measurements = blocks["measurements"][0]
        gains, innovations = (
            blocks["normalized_gain"][0, :measurements],
            blocks["normalized_innovation"][0, :measurements],
        )
        P_before.append(P[-1] + gains.T @ gains)
        correction.append(gains.T @ innovations)
    assert 0 < of.static.sum() < len(of.static)

    result = Smoother(of.noise, RATE, of.start, params).run(of.gyro, of.accel, of.static)
    deviation, P_s = np.zeros(STATES), P[-1]
    for k in range(len(F) - 1, -1, -1):
        R = Rotation.from_quat(result.quat_VS[25 * k + 24])
        turned = (R * Rotation.from_quat(quats[k]).inv()).as_rotvec()
        np.testing.assert_allclose(turned, deviation[:3], atol=1e-8)
        cov_W = R.as_matrix() @ cov(result)[25 * k + 24] @ R.as_matrix().T
        np.testing.assert_allclose(cov_W, P_s[:3, :3], atol=1e-9, rtol=1e-6)
        if k < len(F) - 1:  # the next sample's is that of the block before it
            u = Rotation.from_quat(result.quat_VS[25 * k + 25]).as_matrix()[2]
            of_bias = np.concatenate([u, u]) @ P_s[np.ix_(BIASES, BIASES)] @ np.concatenate([u, u])
            assert result.about_vertical is not None
            np.testing.assert_allclose(result.about_vertical[25 * k + 25], (0.0, 0.0, of_bias), rtol=1e-6)
        G = P[k] @ F[k].T @ np.linalg.inv(P_before[k])
        deviation = G @ (correction[k] + deviation)
        P_s = P[k] + G @ (P_s - P_before[k]) @ G.T
    assert np.abs(deviation[:3]).max() > 1e-4  # there was something to smooth


def test_a_rest_at_the_end_tells_the_bias_of_the_beginning() -> None:
    """The sensor's bias is not known at the start, and it rests only at the end."""
    for seed in range(4):
        of = part(case(seed), slice(1000, 6001))
        true_bias = of.noise.gyro_bias
        unknown = replace(
            of.noise, gyro_bias=true_bias + np.array([0.01, -0.01, 0.005]), gyro_bias_cov=1e-4 * np.eye(3)
        )
        of = of._replace(noise=unknown, start=rotations.quat_from_gravity(of.accel[:50].mean(axis=0)))
        forward, smoothed = run(of), run(of, kind=Smoother)
        wrong = [np.abs(result.gyro_bias[100] - true_bias).max() for result in (forward, smoothed)]
        assert wrong[1] < 3e-4
        assert wrong[1] < 0.2 * wrong[0]
        true = Rotation.from_quat(of.true)
        tilt = [
            tilt_deg(Rotation.from_quat(result.quat_VS) * true.inv())[:500].mean() for result in (forward, smoothed)
        ]
        assert tilt[1] < 0.5 < tilt[0]


def test_a_gap_is_bridged_from_both_sides() -> None:
    of = case(5)
    gyro = of.gyro.copy()
    gyro[2012:2040] = np.nan
    forward, smoothed = (errors(of, run(of._replace(gyro=gyro), kind=kind).quat_VS) for kind in (Amekf, Smoother))
    after = slice(2041, 2100)
    tilt = [tilt_deg(error)[after].mean() for error in (forward, smoothed)]
    print(f"tilt after 0.3 s lost: filter {tilt[0]:.2f}, smoother {tilt[1]:.2f} deg")
    assert tilt[1] < 0.5 * tilt[0]
    assert tilt_deg(smoothed)[:2000].max() < 0.5


@pytest.mark.parametrize("length", [1, 24, 25, 26, 49, 51])
def test_short_recordings_and_open_blocks(length: int) -> None:
    of = part(case(2), slice(0, length))
    forward, smoothed = run(of), run(of, kind=Smoother)
    assert all(array is not None and len(array) == length and np.isfinite(array).all() for array in smoothed)
    # After the last whole block there is nothing that the filter does not know.
    np.testing.assert_allclose(smoothed.quat_VS[-1], forward.quat_VS[-1], atol=1e-12)
    np.testing.assert_allclose(cov(smoothed)[-1], cov(forward)[-1], atol=1e-12)
