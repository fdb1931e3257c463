"""Joint limits: read from the URDF by themselves, and the velocities that keep all of them for all time to come."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from ..errors import BadModel, MissingFile
from ..so3 import kernel


class JointLimit(NamedTuple):
    """What a URDF says of one joint [rad or m, and a second]."""

    kind: str  # "revolute", "continuous", "prismatic"
    lower: float  # −inf where it turns without end
    upper: float
    velocity: float
    mimic: tuple[str, float, float] | None  # of which joint: value = multiplier * its value + offset


def urdf_limits(path: Path) -> dict[str, JointLimit]:
    """Every joint that moves, with its limits; NaN where the URDF has none.

    Read from the XML and from nothing else, so that a check against them shares no code with the solver.

    Raises
    ------
    MissingFile, BadModel
        Not there; not XML.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file")
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise BadModel(f"{path}: not valid XML: {error}") from error
    found = {}
    for joint in root.iter("joint"):
        kind = joint.get("type", "")
        if kind not in ("revolute", "continuous", "prismatic"):
            continue
        limit, mimic = joint.find("limit"), joint.find("mimic")
        lower, upper, velocity = (_number(limit, key) for key in ("lower", "upper", "velocity"))
        if kind == "continuous":
            lower, upper = -np.inf, np.inf
        elif limit is not None:  # URDF: what is left out is zero
            lower, upper = (0.0 if np.isnan(value) else value for value in (lower, upper))
        copied = None
        if mimic is not None:
            factor, offset = (_number(mimic, key) for key in ("multiplier", "offset"))
            copied = (
                mimic.get("joint", ""),
                1.0 if np.isnan(factor) else factor,
                0.0 if np.isnan(offset) else offset,
            )
        found[joint.get("name", "")] = JointLimit(kind, lower, upper, velocity, copied)
    return found


def _number(element: ElementTree.Element | None, key: str) -> float:
    try:
        return float(element.get(key, "nan")) if element is not None else np.nan
    except ValueError:
        return np.nan


@kernel
def fastest(room, a_step, dt):  # type: ignore[no-untyped-def]
    """Largest next velocity from which a joint still stops within `room`, each step taking off `a_step` at most.

    The velocity changes evenly over each step of `dt` [s]. `room` [rad or m] is what is left to the limit, less what
    the present velocity takes of the coming step. Braking from m·a_step takes ½ m² a_step dt, and between whole numbers
    the way is a straight line, so that the bound is a line of slope (m + 1) dt too: no root is left to chance.
    """
    if room <= 0.0:
        return 2.0 * room / dt  # already beyond: back by half a step's mean velocity
    if np.isinf(room):
        return room  # a joint without end
    unit = a_step * dt
    m = np.floor(0.5 * (np.sqrt(1.0 + 8.0 * room / unit) - 1.0))
    return m * a_step + (room - 0.5 * unit * m * (m + 1.0)) / ((m + 1.0) * dt)


@kernel
def velocity_bounds(u, v, lower, upper, v_most, a_most, dt, low, high):  # type: ignore[no-untyped-def]
    """Fill `low` and `high` (n,) with the next velocities that keep position, velocity and acceleration for ever.

    From a state inside them some next velocity always is: whoever brakes fully stays inside.
    """
    for j in range(len(u)):
        a_step = a_most[j] * dt
        passed = 0.5 * v[j] * dt
        most = min(v_most[j], fastest(upper[j] - u[j] - passed, a_step, dt))
        least = max(-v_most[j], -fastest(u[j] - lower[j] + passed, a_step, dt))
        high[j] = max(min(most, v[j] + a_step), v[j] - a_step)
        low[j] = min(max(least, v[j] - a_step), v[j] + a_step)
        if low[j] > high[j]:  # of rounding only
            low[j] = high[j] = 0.5 * (low[j] + high[j])
