"""The Sobol sequence beside SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from wepose_pin.calibration.sobol import MOST_DIMENSIONS, list_sobol_points


@pytest.mark.parametrize("dimensions", [1, 5, MOST_DIMENSIONS, MOST_DIMENSIONS + 1])
@pytest.mark.parametrize("count", [1, 2, 64, 256, 1024])
def test_points_are_those_of_scipy(dimensions: int, count: int) -> None:
    """Bit-identical: starts of a search come from them."""
    points = list_sobol_points(dimensions, count)
    np.testing.assert_array_equal(points, qmc.Sobol(dimensions, scramble=False).random(count))
