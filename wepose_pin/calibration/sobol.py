"""The Sobol sequence, as `scipy.stats.qmc.Sobol` without scrambling; scipy.stats takes half a second to load."""

from __future__ import annotations

import numpy as np

# Of each dimension from the second on: a primitive polynomial over GF(2), its coefficients as bits, and the first odd
# numbers m of the recurrence. Source: Joe and Kuo 2008, new-joe-kuo-6.
_DIMENSIONS = (
    (3, (1,)),
    (7, (1, 3)),
    (11, (1, 3, 1)),
    (13, (1, 1, 1)),
    (19, (1, 1, 3, 3)),
    (25, (1, 3, 5, 13)),
    (37, (1, 1, 5, 5, 17)),
    (41, (1, 1, 5, 5, 5)),
    (47, (1, 1, 7, 11, 19)),
    (55, (1, 1, 5, 1, 1)),
    (59, (1, 1, 1, 3, 11)),
    (61, (1, 3, 5, 5, 31)),
    (67, (1, 3, 3, 9, 7, 49)),
    (91, (1, 1, 1, 15, 21, 21)),
    (97, (1, 3, 1, 13, 27, 49)),
    (103, (1, 1, 1, 15, 7, 5)),
    (109, (1, 3, 1, 15, 13, 25)),
    (115, (1, 1, 5, 5, 19, 61)),
    (131, (1, 3, 7, 11, 23, 15, 103)),
    (137, (1, 3, 7, 13, 13, 15, 69)),
    (143, (1, 1, 3, 13, 7, 35, 63)),
    (145, (1, 3, 5, 9, 1, 25, 53)),
    (157, (1, 3, 1, 13, 9, 35, 107)),
)
MOST_DIMENSIONS = 1 + len(_DIMENSIONS)


def list_sobol_points(dimensions: int, count: int) -> np.ndarray:
    """The first points (count, dimensions) of the sequence, in [0, 1), from the origin on."""
    if dimensions > MOST_DIMENSIONS:
        from scipy.stats import qmc

        return np.asarray(qmc.Sobol(dimensions, scramble=False).random(count))
    bits = (count - 1).bit_length()
    directions = np.array([_list_directions(dimension, bits) for dimension in range(dimensions)])
    points = np.zeros((count, dimensions), dtype=np.int64)
    for k in range(1, count):
        points[k] = points[k - 1] ^ directions[:, (k & -k).bit_length() - 1]  # Antonov and Saleev 1979
    return points / 2**bits


def _list_directions(dimension: int, bits: int) -> list[int]:
    """Direction numbers of a dimension, in units of 2**-bits."""
    if not dimension:
        return [1 << (bits - 1 - k) for k in range(bits)]
    polynomial, first = _DIMENSIONS[dimension - 1]
    degree, m = len(first), list(first[:bits])
    for k in range(len(m), bits):  # Bratley and Fox 1988, equation 2
        m.append(m[k - degree] ^ (m[k - degree] << degree))
        for i in range(1, degree):
            if polynomial >> (degree - i) & 1:
                m[k] ^= m[k - i] << i
    return [number << (bits - 1 - k) for k, number in enumerate(m)]
