"""Protocols as data: what a person does in which phase, and the conditions that hold for the body meanwhile.

A ``calibration/<name>.toml`` lists steps for the person and conditions for the solver. There are three kinds:

- ``[[closure]]``: two points of the body coincide (``kind = "coincide"``) or keep a distance (``"distance"``), or one
  stays at an unknown point of W (``"fixed_point"``). All of them show lengths and headings by motion.
- ``[[pose]]``: segments point in given directions of the torso; `std_deg` is how well a person does that.
- ``[[axis]]``: a segment turns forwards about its own y, as the torso in a bow.

The residual of a pose does not show how exactly it was taken, so its weight is stated; that of a closure is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..alignment import PALM_SLIP_STD
from ..assets import asset
from ..documents import is_number, read_toml
from ..errors import BadOption, one_of
from ..model import load_table
from .chain import CHAIN, LENGTHS, default_reaches

PROTOCOLS = ("clasp", "clasp_measured", "handle", "poses", "touch_left", "touch_right")
KINDS = {"coincide": 2, "distance": 2, "fixed_point": 1}  # how many points each takes


@dataclass(frozen=True)
class Closure:
    """Points that stay together, at a distance, or on a point of W.

    Parameters
    ----------
    phase : of the session in which it holds
    kind : one of `KINDS`
    points : of the body
    slip : [m] one standard deviation, each axis, of what holds only nearly; sets the weights' shape, not their size
    distance : its name, as in ``--measured handle=0.4``; empty for other kinds
    metres, metres_std : the distance where the user gives none, and one standard deviation [m]
    """

    phase: str
    kind: str
    points: tuple[str, ...]
    slip: float = PALM_SLIP_STD
    distance: str = ""
    metres: float = 0.0
    metres_std: float = 0.003

    @property
    def rows(self) -> int:
        """How many residuals a sample has."""
        return 1 if self.kind == "distance" else 3


@dataclass(frozen=True)
class Direction:
    """A segment's −z points along `direction` (3,) of the torso, to within `std` [rad] about each axis."""

    phase: str
    segment: str
    direction: tuple[float, float, float]
    std: float
    rows: int = 3


@dataclass(frozen=True)
class Axis:
    """The segment turns forwards about its own y, which stays level to within `std` [rad]."""

    phase: str
    segment: str
    std: float
    rows: int = 1


Condition = Closure | Direction | Axis


@dataclass(frozen=True)
class Step:
    """What the person does, for how long [s]."""

    phase: str
    seconds: float
    do: str


@dataclass(frozen=True)
class Protocol:
    """A calibration session as data.

    Parameters
    ----------
    name : of the protocol, and of its file
    title : in a few words, for the subject's note
    needs : segments that must carry a sensor
    steps : for the person
    conditions : for the solver
    min_measured : how many lengths of the chain the user must measure
    measured_example : the length that fixes the scale best, as ``name=metres``
    """

    name: str
    title: str
    needs: tuple[str, ...]
    steps: tuple[Step, ...]
    conditions: tuple[Condition, ...]
    min_measured: int = 0
    measured_example: str = "shoulder_width=0.385"

    @property
    def closures(self) -> tuple[Closure, ...]:
        return tuple(c for c in self.conditions if isinstance(c, Closure))

    @property
    def distances(self) -> tuple[str, ...]:
        """Names of distances outside the body that the user can measure."""
        return tuple(dict.fromkeys(c.distance for c in self.closures if c.distance))

    @property
    def chain(self) -> tuple[str, ...]:
        """Lengths in some closure."""
        parts = [abs(c) for closure in self.closures for c in coefficients(closure).values()]
        return tuple(np.array(LENGTHS)[np.sum(parts, axis=(0, 1)) > 0.0].tolist()) if parts else ()

    @property
    def segments(self) -> frozenset[str]:
        """Segments whose orientation some condition uses, hands included."""
        used = {segment for closure in self.closures for segment in coefficients(closure)}
        used |= {c.segment for c in self.conditions if isinstance(c, Direction | Axis)}
        return frozenset(used | ({"torso"} if any(isinstance(c, Direction) for c in self.conditions) else set()))


def coefficients(closure: Closure) -> dict[str, np.ndarray]:
    """Segment → (3, 8), by which the lengths make its part of the closed chain, in its own frame."""
    reaches = default_reaches()
    parts = dict(reaches[closure.points[0]])
    for other in closure.points[1:]:
        for segment, part in reaches[other].items():
            parts[segment] = parts.get(segment, 0.0) - part
    return {segment: part for segment, part in parts.items() if np.any(part)}


def load_protocol(name: str | Path) -> Protocol:
    """A protocol by its name, or from a TOML file of one's own.

    Raises
    ------
    BadOption
        There is no such protocol, or its file has a key or value that is none.
    """
    own = str(name).endswith(".toml")
    if not own and name not in PROTOCOLS:
        raise BadOption(
            f"protocol '{name}' is not known; {one_of(PROTOCOLS, str(name))}; or the path of a .toml of one's own"
        )
    path = Path(name) if own else asset("calibration", f"{name}.toml")
    return _protocol(read_toml(path, "a protocol", BadOption), path)


def _protocol(table: dict[str, Any], path: Path) -> Protocol:
    known = ("name", "title", "needs", "min_measured", "measured_example", "step", "closure", "pose", "axis")
    for key, value in table.items():
        if key not in known:
            raise BadOption(f"{path}: '{key}' is no key of a protocol; {one_of(known, key)}")
        tables = isinstance(value, list) and all(isinstance(entry, dict) for entry in value)
        if key in ("step", "closure", "pose", "axis") and not tables:
            raise BadOption(f"{path}: {key} = {value!r} is no list of tables; write [[{key}]]")
    conditions: list[Condition] = []
    for i, entry in enumerate(table.get("closure", [])):
        conditions.append(_closure(entry, f"{path}: closure {i + 1}"))
    for i, entry in enumerate(table.get("pose", [])):
        place = f"{path}: pose {i + 1}"
        std = np.deg2rad(_number(entry, "std_deg", place, 0.1, 45.0))
        directions = _get(entry, "directions", place)
        if not isinstance(directions, dict):
            raise BadOption(f"{place}: directions = {directions!r}; of each segment x, y, z, as in directions.torso")
        for segment, value in directions.items():
            _among(segment, CHAIN, f"{place}: directions")
            numbers = isinstance(value, list) and len(value) == 3 and all(is_number(v, 1e6) for v in value)
            length = float(np.linalg.norm(value)) if numbers else 0.0
            if not length > 1e-6:
                raise BadOption(f"{place}: directions.{segment} = {value}; three numbers are needed: x, y, z")
            x, y, z = (float(v) / length for v in value)
            conditions.append(Direction(str(_get(entry, "phase", place)), segment, (x, y, z), std))
    for i, entry in enumerate(table.get("axis", [])):
        place = f"{path}: axis {i + 1}"
        segment = _among(_get(entry, "segment", place), CHAIN, place)
        std = np.deg2rad(_number(entry, "std_deg", place, 0.1, 45.0))
        conditions.append(Axis(str(_get(entry, "phase", place)), segment, std))
    if not conditions:
        raise BadOption(f"{path}: no [[closure]], [[pose]] or [[axis]]; a protocol needs one at least")
    needs = tuple(
        _among(segment, load_table().segments, f"{path}: needs") for segment in _list(table, "needs", str(path))
    )
    steps = []
    for i, entry in enumerate(table.get("step", [])):
        place = f"{path}: step {i + 1}"
        seconds = _number(entry, "seconds", place, 0.0, 3600.0)
        steps.append(Step(str(_get(entry, "phase", place)), seconds, str(_get(entry, "do", place))))
    name = str(table.get("name", path.stem))
    measured_example = str(table.get("measured_example", Protocol.measured_example))
    _among(measured_example.partition("=")[0], LENGTHS, f"{path}: measured_example")
    title = str(table.get("title", name))
    min_measured = round(_number({"min_measured": 0, **table}, "min_measured", str(path), 0, len(LENGTHS)))
    protocol = Protocol(name, title, needs, tuple(steps), tuple(conditions), min_measured, measured_example)
    # A hand may go without a sensor, rigid with its forearm.
    used = {segment if segment in needs else segment.replace("hand", "forearm") for segment in protocol.segments}
    if not used <= set(needs):
        lacking = ", ".join(sorted(used - set(needs)))
        raise BadOption(f"{path}: needs = {list(needs)} lacks {lacking}, whose orientation a condition uses")
    return protocol


def _closure(entry: dict[str, Any], place: str) -> Closure:
    kind = _among(_get(entry, "kind", place), KINDS, f"{place}: kind")
    points = tuple(_among(point, default_reaches(), f"{place}: points") for point in _list(entry, "points", place))
    if len(points) != KINDS[kind]:
        raise BadOption(f"{place}: points = {list(points)}; kind '{kind}' takes {KINDS[kind]}")
    more: dict[str, Any] = {}
    if "slip" in entry:
        more["slip"] = _number(entry, "slip", place, 1e-4, 0.1)
    if kind == "distance":
        more["distance"] = str(_get(entry, "distance", place))
        more["metres"] = _number(entry, "metres", place, 0.02, 2.0)
        if "metres_std" in entry:
            more["metres_std"] = _number(entry, "metres_std", place, 1e-5, 0.1)
    return Closure(str(_get(entry, "phase", place)), kind, points, **more)


def _get(table: dict[str, Any], key: str, place: str) -> Any:
    if key not in table:
        raise BadOption(f"{place}: no '{key}'; it has: {', '.join(table)}")
    return table[key]


def _list(table: dict[str, Any], key: str, place: str) -> list[Any]:
    value = _get(table, key, place)
    if not isinstance(value, list):
        raise BadOption(f'{place}: {key} = {value!r}; a list of names is needed, as in {key} = ["left_palm"]')
    return value


def _number(table: dict[str, Any], key: str, place: str, least: float, most: float) -> float:
    value = _get(table, key, place)
    if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value <= most:
        raise BadOption(f"{place}: {key} = {value!r}; a number between {least:g} and {most:g} is needed")
    return float(value)


def _among(name: Any, choices: Any, place: str) -> str:
    if not isinstance(name, str) or name not in choices:
        raise BadOption(f"{place}: {name!r} is not known; {one_of(choices, str(name))}")
    return name
