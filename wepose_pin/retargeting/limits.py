"""Joint limits: read from the URDF by themselves, and the accelerations that keep all of them for all time to come.

Over a step the jerk is even: the acceleration is a line, the velocity a parabola, the position a cubic. Three bounds on
the acceleration at a step's end follow, of which the tightest counts:

1. It and its step are within the limits of acceleration and jerk.
2. From there, falling as fast as both allow, the joint still comes to a halt before its position limit and never passes
   its velocity limit (`_peaks`). Among all motions on this grid none falls faster, so that a state which keeps this has
   a next one that does: braking.
3. Where 2. leaves the choice, the joint lands softly: at its limits with no acceleration left (`_lands`). Whoever
   brakes at full strength up to a limit bounces off it, for the brake cannot be let go at once either.

Bounds of both sides agree where a brake can be let go within the joint's velocities and range (`usable`).
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from ..compilation import compiled, inlined, kernel
from ..errors import BadModel, MissingFile


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
    except (ElementTree.ParseError, ValueError, LookupError) as error:
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


LAND_A, LAND_J = 0.7, 0.5  # share of acceleration and jerk with which a joint lands: the rest is for coming in too fast
SLOWEST_PULL = 8.0  # [1/s] with which shapes come together at last, however hard the joints can brake
_HALVINGS = 30
_ROUNDING = 1e-9  # [rad or m, and a second] by which a bound may be missed


@inlined
def _peaks(v, a, first, a_most, j_step, dt):  # type: ignore[no-untyped-def]
    """Farthest way ahead and highest velocity, if the next acceleration is `first` and all later ones fall fastest.

    Both are those of the motion between the samples, too.
    """
    far, fast, way, after = 0.0, v, 0.0, first
    while True:
        slope, end = (after - a) / dt, v + 0.5 * dt * (a + after)
        fast = max(fast, end)
        turns = a > 0.0 > after  # the velocity has its top within the step
        top = v - 0.5 * a * a / slope if turns else v
        fast = max(fast, top)
        if end <= 0.0 < top:  # comes to a halt within the step: the later root of v + a t + ½ slope t²
            root = np.sqrt(max(a * a - 2.0 * slope * v, 0.0))
            t = -(a + root) / slope if a > 0.0 else 2.0 * v / (root - a)
            far = max(far, way + t * (v + t * (0.5 * a + t * slope / 6.0)))
        way += dt * (v + dt * (a / 3.0 + after / 6.0))
        far = max(far, way)
        v, a = end, after
        if v <= 0.0 and a <= 0.0:
            return far, fast
        after = max(a - j_step, -a_most)


@inlined
def _lands(room, v, a, a_most, j_most, pull):  # type: ignore[no-untyped-def]
    """Whether a joint comes in at or below the velocity from which it lands, with time to let its acceleration go.

    That velocity is the one of an even brake, and near the limit `pull` [1/s] times the room: there position, velocity
    and acceleration fade alike. Where s is how far below it the velocity is, s' = -e with e the acceleration above the
    brake's; e can be taken off at `j_most` in time if s ≥ e² / (2 j).
    """
    bend = a_most / pull**2  # the room from which on the brake is even
    slow = pull * room if room < bend else np.sqrt(2.0 * a_most * (room - 0.5 * bend))
    over = max(a + min(pull * max(v, 0.0), a_most), 0.0)
    return v + 0.5 * over * over / j_most <= slow + _ROUNDING


@inlined
def _most(v, a, room, v_most, a_most, j_most, dt):  # type: ignore[no-untyped-def]
    """Largest next acceleration of bounds 1 and 2, and of all three."""
    j_step = j_most * dt
    bottom, top = max(a - j_step, -a_most), min(a + j_step, a_most)
    if bottom > top:  # from outside its limits: back
        bottom = top = max(min(a, a_most + j_step) - j_step, -a_most - j_step)
    hard = _highest(False, bottom, top, v, a, room, v_most, a_most, j_most, dt)
    return hard, _highest(True, bottom, hard, v, a, room, v_most, a_most, j_most, dt)


@inlined
def _highest(soft, low, high, v, a, room, v_most, a_most, j_most, dt):  # type: ignore[no-untyped-def]
    """Largest of `low` to `high` that keeps bound 3, or 2; `low` where none does."""
    if _keeps(soft, high, v, a, room, v_most, a_most, j_most, dt):
        return high
    if not _keeps(soft, low, v, a, room, v_most, a_most, j_most, dt):
        return low
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _keeps(soft, middle, v, a, room, v_most, a_most, j_most, dt):
            low = middle
        else:
            high = middle
    return low


@inlined
def _keeps(soft, after, v, a, room, v_most, a_most, j_most, dt):  # type: ignore[no-untyped-def]
    if not soft:
        far, fast = _peaks(v, a, after, a_most, j_most * dt, dt)
        return far <= room + _ROUNDING and fast <= v_most + _ROUNDING
    # Half a step on with that acceleration: there the joint is when it can next do otherwise in full.
    ahead = v + dt * (0.5 * a + after)
    left = room - dt * (1.5 * v + dt * (7.0 * a + 6.5 * after) / 12.0)
    if ahead + 0.5 * max(after, 0.0) ** 2 / (LAND_J * j_most) > v_most:
        return False
    pull = min(0.5 * j_most / a_most, 0.3 / dt)  # the landing itself asks for up to LAND_A pull a_most of jerk
    return _lands(left, ahead, after, LAND_A * a_most, LAND_J * j_most, pull)


@kernel
def acceleration_bounds(u, v, a, lower, upper, v_most, a_most, j_most, dt, low, high):  # type: ignore[no-untyped-def]
    """Fill `low` and `high` (n,) with the accelerations at the next sample that keep every limit for ever."""
    for j in range(len(u)):
        up, soft_up = _most(v[j], a[j], upper[j] - u[j], v_most[j], a_most[j], j_most[j], dt)
        down, soft_down = _most(-v[j], -a[j], u[j] - lower[j], v_most[j], a_most[j], j_most[j], dt)
        high[j] = min(up, max(soft_up, -down))
        low[j] = max(-down, min(-soft_down, up))
        if low[j] > high[j]:  # a range too short for its own limits, or rounding
            low[j] = high[j] = 0.5 * (low[j] + high[j])


@compiled
def opening_bounds(growth, distance, clearance, v, a, a_most, j_most, dt):  # type: ignore[no-untyped-def]
    """(m,) the lowest growth [m/s] of distances half a step on, so that what comes nearer stops in time.

    Bound 3 for many things at once. Counted on is half of what all joints together could brake: the other half is
    theirs for their own limits. From the acceleration at which two come nearer the coming step takes off what it can.

    Parameters
    ----------
    growth : (m, n) of the distances with the joints [m/rad]
    distance, clearance : (m,) [m]
    v, a, a_most, j_most : (n,)
    """
    bounds = np.empty(len(distance))
    for k in range(len(distance)):
        brake, jerk, nears, speeds, ahead = 1e-9, 1e-9, 0.0, 0.0, 0.0
        for j in range(len(v)):
            g = growth[k, j]
            brake += 0.5 * abs(g) * a_most[j]
            jerk += 0.5 * abs(g) * j_most[j]
            nears -= g * (v[j] + 0.5 * dt * a[j])
            speeds -= g * a[j]
            ahead += g * (1.5 * v[j] + 0.5 * dt * a[j])
        left = distance[k] - clearance[k] + dt * ahead
        pull = min(0.5 * jerk / brake, 0.3 / dt, SLOWEST_PULL)
        bend = LAND_A * brake / pull**2
        slow = pull * left if left < bend else np.sqrt(2.0 * LAND_A * brake * (left - 0.5 * bend))
        over = max(speeds - jerk * dt + min(pull * max(nears, 0.0), LAND_A * brake), 0.0)
        bounds[k] = 0.5 * over**2 / (LAND_J * jerk) - slow
    return bounds


def usable(a_most: np.ndarray, v_most: np.ndarray, j_most: np.ndarray, span: np.ndarray, dt: float) -> np.ndarray:
    """The part of an acceleration limit from which a joint comes back within half of its velocities and range `span`.

    While a full brake is let go the velocity changes by a² / (2 j), on the way to rest the position by 2 a³ / (3 j²);
    and by as much as a step's even where the jerk would allow more.
    """
    by_jerk = np.minimum(np.sqrt(j_most * v_most), np.cbrt(0.75 * j_most**2 * span))
    return np.minimum(a_most, np.minimum(by_jerk, np.minimum(0.25 * v_most / dt, 0.1 * span / dt**2)))
