"""Smoother: the aMEKF forward and a Rauch–Tung–Striebel pass backward, so that each sample knows the whole recording.

A rest at the end, or turns that show the gyroscope's scale, say what the bias and the scale were from the first sample
on. The backward pass is that of Rauch, Tung and Striebel 1965 (AIAA Journal 3(8)) in Bierman's adjoint form
("modified Bryson–Frazier", Bierman 1973, Automatica 9): x_s = x − P λ and P_s = P − P Λ P, with

    λ ← (I − K h)ᵀ λ − h y/s,  Λ ← (I − K h)ᵀ Λ (I − K h) + h hᵀ/s  for each measurement, and  λ ← Fᵀ λ,  Λ ← Fᵀ Λ F

for each block, which inverts nothing. It goes from block to block of the filter; the samples in between take the
corrections of both ends in proportion. Time is linear in the samples; the tape between the passes takes
3.5 kB a block, that is 140 bytes a sample at 100 Hz, 14 at 1 kHz, beside the output's 128.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compilation import compiled
from ..errors import BadData, BadOption
from ..rotations import fill_matrix, rotate_by_world_vector
from .amekf import (
    STATES,
    TAPE,
    TAPE_D,
    TAPE_FIRST,
    TAPE_LENGTH,
    TAPE_LOST,
    TAPE_MEASURED,
    TAPE_P,
    TAPE_ROWS,
    TAPE_STEP,
    Amekf,
    AmekfParams,
    fill_symmetric,
    into_sensor,
)
from .base import FilterRun
from .noise import SensorNoise

_V, _P, _B, _M, _F, _D, _MOVING = 3, 5, 7, 10, 19, 22, 36  # as in amekf
_SHARED = len(TAPE_ROWS)


class _Forward(NamedTuple):
    """A piece that the filter has gone through."""

    out: FilterRun  # the filter's
    static: np.ndarray  # (n,) bool
    tape: np.ndarray  # (blocks, `TAPE`)
    start: np.ndarray  # rows of P (9, 25) before it


class Smoother:
    """Smoother of one sensor, for whole recordings; parameters are the aMEKF's.

    What bad data does is said at `Amekf`; a stretch without gyro is bridged from both sides.

    A recording too long for that comes in pieces: `push` gives a piece once the next one has come, smoothed by what
    both hold; `finish` gives the last. Of a recording in one piece that is `run`. What the pieces after the next one
    would have said is lost (docs/long-recordings.md has by how much).
    """

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: AmekfParams | None = None
    ) -> None:
        self.params = params or AmekfParams()
        self.noise = noise
        self.rate_hz = rate_hz
        self.quat_WS = np.array(quat_WS, dtype=float)
        self._filter = Amekf(noise, rate_hz, self.quat_WS, self.params)
        self._held: _Forward | None = None

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool) -> FilterRun:
        """Smooth a whole recording; each call starts anew, so a recording cut in two is two recordings."""
        self._filter, self._held = Amekf(self.noise, self.rate_hz, self.quat_WS, self.params), None
        self.push(gyro_S, accel_S, static)
        return self.finish()

    def push(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool) -> FilterRun | None:
        """Take a piece; gives the one before it.

        Raises
        ------
        BadData
            The piece before ended within a block of `Amekf.block` samples.
        """
        at_rest = np.ascontiguousarray(np.reshape(static, -1), dtype=np.bool_)
        if self._held is not None and len(self._held.static) % self._filter.block:
            raise BadData(
                f"a piece of {len(self._held.static)} samples before another: the smoother's must be multiples of "
                f"{self._filter.block}"
            )
        start = np.ascontiguousarray(self._filter.state.P[list(TAPE_ROWS)])
        tape = np.empty((len(at_rest) // self._filter.block, TAPE))
        out = self._filter.taped(gyro_S, accel_S, at_rest, tape)
        done = None if self._held is None else self._smoothed(self._held, tape)
        self._held = _Forward(out, at_rest, tape, start)
        return done

    def finish(self) -> FilterRun:
        """The last piece."""
        assert self._held is not None, "nothing was pushed"
        held, self._held = self._held, None
        return self._smoothed(held, held.tape[:0])

    def _smoothed(self, held: _Forward, after: np.ndarray) -> FilterRun:
        """A piece in the light of itself and of the tape `after` it."""
        tape, start = held.tape, held.start
        deviation, cov = _backward(np.concatenate([tape, after]) if len(after) else tape, start, self.noise.gravity)
        if len(after):
            deviation, cov = deviation[: len(tape) + 1].copy(), cov[: len(tape) + 1].copy()
        _between(tape, deviation, cov, float(np.trace(start[:3, :3])), self._filter.block, held.static, *held.out)
        return held.out

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:  # noqa: ARG002
        """There is none.

        Raises
        ------
        BadOption
            Always: what comes later is needed.
        """
        raise BadOption("method 'smoother' needs the whole recording and has no live update; take 'amekf' for that")


@compiled
def _transpose_transition(sums, length, gravity, L):  # type: ignore[no-untyped-def]
    """In place ``L ← Fᵀ L`` of `L` (25, m), F the transition that `amekf.transition_rows` applies."""
    columns = L.shape[1]
    g, t = 0.5 * length * gravity, 0.5 * length
    for j in range(columns):
        # Adjoints of the rows v⁺ and θ⁺, with what p⁺ and v⁺ take of them; then the direct shares.
        px, py = t * L[_P, j], t * L[_P + 1, j]
        vx, vy = L[_V, j] + px, L[_V + 1, j] + py
        L[_V, j], L[_V + 1, j] = vx + px, vy + py
        tx, ty = L[0, j] - g * vy, L[1, j] + g * vx
        tz = L[2, j]
        L[0, j], L[1, j] = tx - g * vy, ty + g * vx
        for c in range(3):
            L[_F + c, j] -= sums[c] * vx + sums[3 + c] * vy
            L[_B + c, j] -= sums[c] * tx + sums[3 + c] * ty + sums[6 + c] * tz
            L[_D + c, j] -= sums[_MOVING + c] * tx + sums[_MOVING + 3 + c] * ty + sums[_MOVING + 6 + c] * tz
            for w in range(3):
                at = 9 + 9 * w + c
                L[_M + 3 * c + w, j] -= sums[at] * tx + sums[at + 3] * ty + sums[at + 6] * tz


@compiled
def _backward(tape, start, gravity):  # type: ignore[no-untyped-def]
    """Deviations (blocks + 1, 9) of the smoothed from the filtered states after each block, those of `TAPE_ROWS`, and
    the smoothed covariance (blocks + 1, 3, 3) of θ; the first row is that of the start, whose rows of P are `start`."""
    blocks = len(tape)
    deviation = np.empty((blocks + 1, _SHARED))
    cov = np.empty((blocks + 1, 3, 3))
    lam = np.zeros((STATES, 1))
    Lam = np.zeros((STATES, STATES))
    swapped = np.empty((STATES, STATES))
    rows = np.empty((_SHARED, STATES))
    u = np.empty(STATES)
    for block in range(blocks, -1, -1):
        for n in range(_SHARED):
            s = 0.0
            for j in range(STATES):
                rows[n, j] = start[n, j] if block == 0 else tape[block - 1, TAPE_P + STATES * n + j]
                s -= rows[n, j] * lam[j, 0]
            deviation[block, n] = s
        for i in range(3):
            for j in range(STATES):
                u[j] = 0.0
            for m in range(STATES):
                p = rows[i, m]
                for j in range(STATES):
                    u[j] += p * Lam[m, j]
            for j in range(i, 3):
                s = rows[i, j]
                for m in range(STATES):
                    s -= u[m] * rows[j, m]
                cov[block, i, j] = s
                cov[block, j, i] = s
        if block == 0:
            break
        tick = tape[block - 1]
        for n in range(int(tick[TAPE_MEASURED]) - 1, -1, -1):
            first = TAPE_FIRST + n * TAPE_STEP
            at, root, y = int(tick[first]), tick[first + 1], tick[first + 2]
            gain = tick[first + 3 : first + TAPE_STEP]  # √s K
            s = 0.0
            for j in range(STATES):
                u[j] = 0.0
                s += gain[j] * lam[j, 0]
            lam[at, 0] -= root * (s + y)
            for m in range(STATES):
                k = root * gain[m]
                for j in range(STATES):
                    u[j] += k * Lam[m, j]
            s = root * root
            for j in range(STATES):
                s += root * gain[j] * u[j]
            for j in range(STATES):
                Lam[at, j] -= u[j]
                Lam[j, at] -= u[j]
            Lam[at, at] += s
        length = tick[TAPE_LENGTH]
        _transpose_transition(tick, length, gravity, lam)
        _transpose_transition(tick, length, gravity, Lam)
        for i in range(STATES):
            for j in range(STATES):
                swapped[j, i] = Lam[i, j]
        _transpose_transition(tick, length, gravity, swapped)
        for i in range(STATES):
            for j in range(STATES):
                Lam[i, j] = 0.5 * (swapped[i, j] + swapped[j, i])
    return deviation, cov


@compiled
def _between(tape, deviation, cov, start_trace, block, static, quat, bias, attitude_cov):  # type: ignore[no-untyped-def]
    """Correct the filter's run in place, sample by sample, between the corrections of its block's ends.

    They are taken in proportion to the time, or, where gyro was lost, to the variance of the turn that was lost up to
    the sample; of that and the variance from there to the end, the product over the sum is left, as in any bridge.
    """
    R = np.empty(9)
    P = np.empty((3, 3))
    upper = np.empty(6)
    e = np.empty(_SHARED)
    blocks = len(tape)
    for k in range(len(quat)):
        row = k // block
        bridge = 0.0
        if row >= blocks:  # the last block is not full: nothing was corrected in it
            for n in range(_SHARED):
                e[n] = deviation[blocks, n]
            for i in range(3):
                for j in range(3):
                    P[i, j] = cov[blocks, i, j]
        else:
            share = (k % block + 1) / block
            whole = k % block + 1 == block  # the filter has corrected this quaternion, not the bias it stated with it
            lost = tape[row, TAPE_LOST]
            if lost > 0.0 and not whole:
                before = start_trace
                if row > 0:
                    before = 0.0
                    for i in range(3):
                        before += tape[row - 1, TAPE_P + (STATES + 1) * i]
                so_far = attitude_cov[k, 0, 0] + attitude_cov[k, 1, 1] + attitude_cov[k, 2, 2]
                so_far = min(max(0.0, (so_far - before) / 3.0), lost)
                share = so_far / lost
                bridge = so_far * (1.0 - share)
            for n in range(_SHARED):
                after = deviation[row + 1, n] + (0.0 if whole and n < 3 else tape[row, TAPE_D + n])
                e[n] = (1.0 - share) * deviation[row, n] + share * after
            for i in range(3):
                for j in range(3):
                    P[i, j] = (1.0 - share) * cov[row, i, j] + share * cov[row + 1, i, j]
        rotate_by_world_vector(quat[k], e[0], e[1], e[2])
        moving = 0.0 if static[k] else 1.0
        for c in range(3):
            bias[k, c] += e[3 + c] + moving * e[6 + c]
        fill_matrix(quat[k], R)
        into_sensor(R, P, bridge, upper)
        fill_symmetric(upper, attitude_cov[k])
