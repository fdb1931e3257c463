"""Symmetric 3×3 matrices and their upper triangles: xx xy xz yy yz zz."""

from __future__ import annotations

import numpy as np

from ..compilation import inlined


def symmetric(upper: np.ndarray) -> np.ndarray:
    """Matrices (…, 3, 3) from their upper triangles (…, 6)."""
    return upper[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


@inlined
def into_sensor(R, P, more, out):  # type: ignore[no-untyped-def]
    """Upper triangle `out` (6,) of ``Rᵀ P R + more I`` of symmetric 3×3 `P`; `R` (3, 3)."""
    xx, xy, xz, yy, yz, zz = P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    at = 0
    for i in range(3):
        a, b, c = R[0, i], R[1, i], R[2, i]
        u, v, w = xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c
        for j in range(i, 3):
            out[at] = R[0, j] * u + R[1, j] * v + R[2, j] * w
            at += 1
    out[0] += more
    out[3] += more
    out[5] += more


@inlined
def fill_symmetric(upper, out):  # type: ignore[no-untyped-def]
    """`out` (3, 3) of its upper triangle (6,)."""
    out[0, 0], out[0, 1], out[0, 2] = upper[0], upper[1], upper[2]
    out[1, 0], out[1, 1], out[1, 2] = upper[1], upper[3], upper[4]
    out[2, 0], out[2, 1], out[2, 2] = upper[2], upper[4], upper[5]
