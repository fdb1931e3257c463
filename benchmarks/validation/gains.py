"""Gains of NCF and GDC, by a grid search on trials that no experiment scores.

Each setting had its own search, so that no filter runs with gains of another kind of motion. The score was the mean
over trials of the total RMSE over the motion, which the experiments report too; heading, bias, noise and initial tilt
were those of the static phase. Each half of BROAD is run with the gains of the other half, and other recordings with
those of all of it. The drift experiment runs with those of "simulated 1 kHz": a search of its own lowers the total RMSE
there by 3 %. docs/validation.md has the scores; the code of the search is in the history of this file.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wepose_pin.filters import GdcParams, NcfParams

# The grid: zero, which leaves the term out, and steps of a quarter or half a decade.
PROPORTIONAL = (0.0, *np.logspace(-3.0, 0.5, 15))  # [1/s] k_P
INTEGRAL = (0.0, *np.logspace(-6.0, -1.0, 11))  # [1/s²] k_I
DESCENT = (0.0, *np.logspace(-5.0, -0.5, 19))  # [1/s] β
HALVES = ({"01", "05", "09", "14", "21", "27", "31", "35"}, {"03", "07", "11", "16", "25", "29", "33"})  # of BROAD


class Gains(NamedTuple):
    """The gains of a setting."""

    ncf: NcfParams
    gdc: GdcParams


def _grid_points(proportional: float, integral: float, descent: float) -> Gains:
    """Find the grid points of these rounded values."""
    nearest = [
        float(min(axis, key=lambda point: abs(point - rounded)))
        for axis, rounded in ((PROPORTIONAL, proportional), (INTEGRAL, integral), (DESCENT, descent))
    ]
    return Gains(NcfParams(*nearest[:2]), GdcParams(nearest[2]))


# Sensor noise alone and a minute without rest: with the bias removed the accelerometer has next to nothing to add, and
# GDC is best without it, that is with the gyroscope integrated.
STATED = {
    "simulated 100 Hz": _grid_points(0.0032, 1e-4, 0.0),
    "simulated 1 kHz": _grid_points(0.0032, 3.2e-5, 0.0),
    "upper body, ideal": _grid_points(0.032, 1e-5, 5.6e-4),
    "upper body, mild": _grid_points(0.1, 0.0, 1.8e-3),
    "upper body, people": _grid_points(0.32, 0.0, 0.01),
    "BROAD, first half": _grid_points(0.1, 1e-3, 0.018),
    "BROAD, second half": _grid_points(0.056, 3.2e-4, 0.01),
    "BROAD": _grid_points(0.1, 1e-3, 0.018),
}


def make_gains(setting: str, trial: str = "") -> Gains:
    """Return the stated gains of a `setting`: a key of `STATED`, or "real".

    `trial`: its name; one of BROAD gets what was found on the half that it is not in.
    """
    if setting != "real":
        return STATED[setting]
    number = trial.split("_")[0]
    if number in HALVES[0]:
        return STATED["BROAD, second half"]
    return STATED["BROAD, first half" if number in HALVES[1] else "BROAD"]
