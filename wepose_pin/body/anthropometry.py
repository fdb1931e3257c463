"""The lengths of people: mean and covariance, from shares of stature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..documents import read_toml
from ..errors import BadModel, BadOption, one_of
from ..libraries import asset
from .table import BodyTable

SEXES = ("f", "m")


def check_stature(stature: float | None) -> None:
    """Raise `BadOption` where a stature is not between 1.0 and 2.5 m."""
    if stature is not None and not 1.0 <= stature <= 2.5:
        raise BadOption(f"stature {stature:g} is not a body height in metres; between 1.0 and 2.5")


def compute_population_lengths(
    table: BodyTable, stature: float | None = None, sex: str | None = None
) -> tuple[dict[str, float], np.ndarray, str]:
    """Compute the lengths [m] that name a share of stature, their covariance (k, k) [m²], and whose they are.

    Lengths share the stature's spread where it is not given, left and right share the person's shape; numbers and
    sources stand in ``calibration/anthropometry.toml``.
    """
    check_stature(stature)
    if sex is not None and sex not in SEXES:
        raise BadOption(f"sex '{sex}' is not known; {one_of(SEXES)}")
    numbers = _read_numbers()
    height = stature if stature is not None else numbers["stature"]["mean"]
    height_std = 0.0 if stature is not None else numbers["stature"]["std"] / numbers["stature"]["mean"]
    of_sexes = [numbers[{"f": "female", "m": "male"}[s]] for s in ([sex] if sex else SEXES)]

    shares = {name: length.share for name, length in table.lengths.items() if length.share}
    for name, share in shares.items():
        if share not in numbers["shape_std"]:
            choices = one_of(numbers["shape_std"], share)
            raise BadModel(f"{table.where}: lengths.{name}.share = '{share}' is not known; {choices}")
    mean = np.array([height * np.mean([each[share] for each in of_sexes]) for share in shares.values()])
    # Relative errors: one of stature common to all, one of shape common to left and right, one of each side.
    shape = np.array([numbers["shape_std"][share] for share in shares.values()])
    same = np.array([[a == b for a in shares.values()] for b in shares.values()], dtype=float)
    sided = np.array([bool(table.side(name)) for name in shares], dtype=float)
    relative = height_std**2 + same * np.outer(shape, shape) + np.diag(sided * numbers["asymmetry_std"]["all"] ** 2)
    note = f"population prior (stature {height:g} m{'' if stature else ' assumed'}, sex {sex or 'not given'})"
    return dict(zip(shares, mean.tolist(), strict=True)), np.outer(mean, mean) * relative, note


def list_breadths(table: BodyTable) -> dict[str, tuple[str, float, float]]:
    """Breadth → the length between joint centres that it gives, its ratio to the breadth, and the ratio's std."""
    of_share = {length.share: name for name, length in table.lengths.items()}
    return {
        name: (of_share[entry["share"]], entry["ratio"], entry["std"])
        for name, entry in _read_numbers()["breadths"].items()
        if entry["share"] in of_share
    }


def convert_breadths(
    measured: Mapping[str, float], table: BodyTable, measured_std: float
) -> dict[str, tuple[float, float]]:
    """Convert measured breadths to lengths, each [m] with its standard deviation; `BadOption`: both are measured."""
    breadths, converted = list_breadths(table), {}
    for name, metres in measured.items():
        length, ratio, std = breadths.get(name, (name, 1.0, 0.0))
        if length != name and length in measured:
            raise BadOption(f"measured {name} and {length}: one follows from the other; give one of them")
        converted[length] = (ratio * metres, float(np.hypot(std * metres, ratio * measured_std)))
    return converted


def _read_numbers() -> dict[str, Any]:
    return read_toml(asset("calibration", "anthropometry.toml"), "the anthropometric prior")
