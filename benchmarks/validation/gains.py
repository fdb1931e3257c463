"""Gains of NCF and GDC, by a grid search on trials that no experiment scores.

Each setting had its own search, so that no filter runs with gains of another kind of motion. The score was the mean
over trials of the total RMSE over the motion, which the experiments report too; heading, bias, noise and initial tilt
were those of the static phase. Each half of BROAD is run with the gains of the other half, and other recordings with
those of all of it. The drift experiment runs with those of "simulated 1 kHz": a search of its own lowers the total RMSE
there by 3 %. The code of the search and its scores are in the history of this file and of docs/validation.md.
"""

from __future__ import annotations

from typing import NamedTuple

from wepose_pin.filters import GdcParams, NcfParams

HALVES = ({"01", "05", "09", "14", "21", "27", "31", "35"}, {"03", "07", "11", "16", "25", "29", "33"})  # of BROAD


class Gains(NamedTuple):
    """The gains of a setting."""

    ncf: NcfParams
    gdc: GdcParams


# Sensor noise alone and a minute without rest: with the bias removed the accelerometer has next to nothing to add, and
# GDC is best without it, that is with the gyroscope integrated.
# The grid was zero, which leaves a term out, and steps of a quarter of a decade, of k_I half a decade.
STATED = {
    "simulated 100 Hz": Gains(NcfParams(10.0**-2.5, 1e-4), GdcParams(0.0)),
    "simulated 1 kHz": Gains(NcfParams(10.0**-2.5, 10.0**-4.5), GdcParams(0.0)),
    "upper body, ideal": Gains(NcfParams(10.0**-1.5, 1e-5), GdcParams(10.0**-3.25)),
    "upper body, mild": Gains(NcfParams(0.1, 0.0), GdcParams(10.0**-2.75)),
    "upper body, people": Gains(NcfParams(10.0**-0.5, 0.0), GdcParams(0.01)),
    "BROAD, first half": Gains(NcfParams(0.1, 1e-3), GdcParams(10.0**-1.75)),
    "BROAD, second half": Gains(NcfParams(10.0**-1.25, 10.0**-3.5), GdcParams(0.01)),
    "BROAD": Gains(NcfParams(0.1, 1e-3), GdcParams(10.0**-1.75)),
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
