"""Smoother: the aMEKF forward and a Rauch–Tung–Striebel pass backward, so that each sample knows the whole recording.

A rest at the end, or turns that show the gyroscope's scale, say what the bias and the scale were from the first sample
on. The backward pass is that of Rauch, Tung and Striebel 1965 (AIAA Journal 3(8)) in Bierman's adjoint form
("modified Bryson–Frazier", Bierman 1973, Automatica 9): x_s = x − P λ and P_s = P − P Λ P, with

    λ ← (I − K h)ᵀ λ − h y/s,  Λ ← (I − K h)ᵀ Λ (I − K h) + h hᵀ/s  for each measurement, and  λ ← Fᵀ λ,  Λ ← Fᵀ Λ F

for each block, which inverts nothing. It goes from block to block of the filter (2.6 kB each); the samples in between
take the corrections of both ends in proportion.
"""

import numpy as np

from ..compilation import compiled
from ..rotations import fill_matrix, rotate_by_world_vector
from . import amekf
from .amekf import BLOCK, PROPAGATED_STATES, SMOOTHED_STATES, STATES
from .base import HEADING, MOST_LOST_STD, RATE, RATE_VAR, OrientationFilter, into_sensor

COUNT = len(SMOOTHED_STATES)


@compiled
def _backward(blocks, start_rows, gravity):  # type: ignore[no-untyped-def]
    """Compute deviations (blocks + 1, 6) of the smoothed from the filtered states `SMOOTHED_STATES` after each block,
    and the smoothed covariances (blocks + 1, 3, 3) of θ and of the bias; the first of each is that of the start, whose
    rows of P are `start_rows`."""
    deviation = np.empty((len(blocks) + 1, COUNT))
    covs = np.empty((2, len(blocks) + 1, 3, 3))
    lam, Lam, rows, cov = np.zeros(STATES), np.zeros((STATES, STATES)), start_rows.copy(), np.empty((COUNT, COUNT))
    F, identity = np.eye(STATES), np.eye(STATES)
    for k in range(len(blocks), -1, -1):
        rows[:] = start_rows
        if k > 0:
            rows[:] = blocks[k - 1].P_smoothed_rows
        if min(rows[0, 0], rows[1, 1]) > 0.5 * MOST_LOST_STD**2:  # what follows tells nothing of an attitude so lost
            lam[:3] = 0.0
            Lam[:3] = 0.0
            Lam[:, :3] = 0.0
        deviation[k] = -np.dot(rows, lam)
        for n in range(COUNT):
            cov[:, n] = rows[:, SMOOTHED_STATES[n]]
        cov -= np.dot(np.dot(rows, Lam), rows.T)
        covs[0, k], covs[1, k] = cov[:3, :3], cov[3:, 3:]
        if k == 0:
            break
        block = blocks[k - 1]
        for n in range(block.measurements - 1, -1, -1):  # λ and Λ before a measurement from those after it
            at, root, gain = block.state_index[n], block.inv_innovation_std[n], block.normalized_gain[n].copy()
            u = root * np.dot(Lam, gain)
            lam[at] -= root * (np.dot(gain, lam) + block.normalized_innovation[n])
            Lam[at] -= u
            Lam[:, at] -= u
            Lam[at, at] += root * (root + np.dot(gain, u))
        amekf.fill_transition_rows(block, gravity, identity, F[:PROPAGATED_STATES])
        lam[:] = np.dot(F.T, lam)
        Lam[:] = np.dot(np.dot(F.T, Lam), F)
        Lam[:] = 0.5 * (Lam + Lam.T)
    return deviation, covs[0].reshape(-1, 9), covs[1].reshape(-1, 9)


@compiled
def _interpolate(  # type: ignore[no-untyped-def]
    blocks, deviation, cov, bias_cov, start_trace, models, static, quat, bias, attitude_cov, about_vertical
):
    """Correct the filter's run in place, sample by sample, between the corrections of its block's ends.

    They are taken in proportion to the time, or, where gyro was lost, to the variance of the turn that was lost up to
    the sample; of that and the variance from there to the end, the product over the sum is left, as in any bridge.
    """
    R, P, e, moved = np.empty((3, 3)), np.empty(9), np.empty(COUNT), 0
    size = models[0].block_samples
    for k in range(len(quat)):
        moved += not static[k]
        row = k // size
        end = min(row + 1, len(blocks))  # the last block may not be full: nothing was corrected in it
        whole = k % size + 1 == size  # the filter has corrected this sample
        share, bridge = (k % size + 1) / size, 0.0
        if row < len(blocks) and blocks[row].lost_rotation_var > 0.0 and not whole:
            lost, before = blocks[row].lost_rotation_var, start_trace
            if row > 0:
                last = blocks[row - 1].P_smoothed_rows
                before = last[0, 0] + last[1, 1] + last[2, 2]
            so_far = attitude_cov[k, 0, 0] + attitude_cov[k, 1, 1] + attitude_cov[k, 2, 2]
            so_far = min(max(0.0, (so_far - before) / 3.0), lost)
            share = so_far / lost
            bridge = so_far * (1.0 - share)
        for n in range(COUNT):
            after = deviation[end, n]
            if row < len(blocks) and not whole:
                after += blocks[row].correction[SMOOTHED_STATES[n]]
            e[n] = (1.0 - share) * deviation[row, n] + share * after
        for i in range(9):
            P[i] = (1.0 - share) * cov[row, i] + share * cov[end, i]
        rotate_by_world_vector(quat[k], e[0], e[1], e[2])
        for c in range(3):
            bias[k, c] += e[3 + c]
        fill_matrix(quat[k], R)
        into_sensor(R, P, bridge, models[0].drift_var * (models[0].dt * moved) ** 2, attitude_cov[k])
        # Smoothed headings and biases know the whole recording from the first sample on: nothing is corrected later.
        about_vertical[k, HEADING] = about_vertical[k, RATE] = variance = 0.0
        for i in range(3):
            for j in range(3):
                variance += R[2, i] * R[2, j] * bias_cov[row, 3 * i + j]
        about_vertical[k, RATE_VAR] = variance


def _smooth(states: np.ndarray, models: np.ndarray, *arrays: np.ndarray) -> None:
    """Smooth a whole recording; each call starts anew, so that a recording cut in two is two recordings."""
    P_rows, size = states["P"][0, list(SMOOTHED_STATES), :STATES], int(models["block_samples"][0])
    blocks, forward = np.empty(len(arrays[0]) // size, BLOCK), models.copy()
    forward["drift_var"] = 0.0
    amekf.run(states.copy(), forward, blocks, *arrays)
    smoothed = _backward(blocks, P_rows, float(models["gravity"][0]))
    _interpolate(blocks, *smoothed, float(np.trace(P_rows[:3, :3])), models, *arrays[2:])


SMOOTHER = OrientationFilter(amekf.make_records, _smooth, amekf.AmekfParams)
