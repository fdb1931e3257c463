"""`Subject`: a person's lengths and sensor mounts with their joint covariance, and the file they live in."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .arguments import (
    NonNegative,
    check_arguments,
    check_array,
    check_covariance,
    check_fields,
    check_finite,
    check_names,
    check_unit,
)
from .assets import asset
from .errors import BadData, BadOption, BadSubject, MissingFile, one_of
from .readers.keys import is_number, parsed_toml
from .recording import SEGMENTS

LENGTHS = (
    "trunk",
    "shoulder_width",
    "left_upper_arm",
    "left_forearm",
    "left_hand",
    "right_upper_arm",
    "right_forearm",
    "right_hand",
)
LONGEST = 3.0  # [m] longer is no part of a person
SEXES = ("f", "m")
FORMAT = 1
MOST_TILT_DEG = 180.0  # off the start pose: all that a turn can be; whether it is plausible, the calibration says
MOST_DRIFT_DEG_MIN = 6000.0  # of a heading: 100 deg/s, beyond any gyroscope's bias


class Hinge(NamedTuple):
    """An elbow's axis."""

    axis: np.ndarray  # (3,) unit, in the upper arm's frame, y towards the left
    std: NonNegative  # [rad] by which the forearm leaves the plane across it, soft tissue included


class StartTilt(NamedTuple):
    """How far a segment was off the start pose when its mount was calibrated."""

    tilt: np.ndarray  # (2,) [rad] about x and y of W
    std: NonNegative  # [rad] of each


class Drift(NamedTuple):
    """How fast a sensor's heading drifted in the calibration, which is its gyroscope's bias as far as it was left."""

    rate: float  # [rad/s]
    std: NonNegative  # [rad/s]


@dataclass(frozen=True)
class Subject:
    """A person as far as known.

    Parameters
    ----------
    lengths : name → [m], every one of `LENGTHS`
    order : what the rows of `covariance` are: names of lengths [m], then ``mounts.<segment>.x``, ``.y``, ``.z``
        [rad], the error of a mount as a small turn about the segment's axes
    covariance : (k, k)
    mounts : segment → `quat_LS` (4,) xyzw, the calibrated mounts; empty where none are calibrated
    note : where the numbers come from, in a few words
    hinges : side → its elbow's axis, where a calibration found it
    start_tilt : segment → how it was off the start pose in the calibration; a person stands so again, nearly
    drift : segment → the heading's drift of its sensor in the calibration; its spread is what another day's may have
    """

    name: str
    lengths: Mapping[str, float]
    order: tuple[str, ...]
    covariance: np.ndarray
    mounts: Mapping[str, np.ndarray] = field(default_factory=dict)
    note: str = ""
    hinges: Mapping[str, Hinge] = field(default_factory=dict)
    start_tilt: Mapping[str, StartTilt] = field(default_factory=dict)
    drift: Mapping[str, Drift] = field(default_factory=dict)

    def check(self) -> Subject:
        """The same subject, if it can be one: made by hand it may be anything.

        Raises
        ------
        BadOption, BadSubject
            A field that is not of its kind; a length, mount, hinge, tilt or drift that cannot be; a covariance that is
            none, or has not the rows of `order`.
        """
        where = f"subject {self.name!r}: "
        check_fields(self, where)
        try:
            check_lengths(f"{where}lengths", self.lengths, LENGTHS)
            if set(self.lengths) != set(LENGTHS):
                raise BadData(f"{where}lengths: {', '.join(n for n in LENGTHS if n not in self.lengths)} is missing")
            check_names(f"{where}order", self.order, _ROWS)
            if len(set(self.order)) < len(self.order):
                raise BadData(f"{where}order = {self.order}: each name once")
            check_array(f"{where}covariance", self.covariance, (len(self.order), len(self.order)))
            check_finite(f"{where}covariance", self.covariance)
            check_covariance(f"{where}covariance", self.covariance)
            for name in ("mounts", "start_tilt", "drift"):
                check_names(f"{where}{name}", getattr(self, name), SEGMENTS)
            check_names(f"{where}hinges", self.hinges, ("left", "right"))
            arrays = [(f"mounts.{s}", quat, (4,)) for s, quat in self.mounts.items()]
            arrays += [(f"hinges.{side}.axis", hinge.axis, (3,)) for side, hinge in self.hinges.items()]
            arrays += [(f"start_tilt.{s}.tilt", start.tilt, (2,)) for s, start in self.start_tilt.items()]
            for name, values, shape in arrays:
                check_array(f"{where}{name}", values, shape)
                check_finite(f"{where}{name}", values)
                if shape != (2,):
                    check_unit(f"{where}{name}", values, 1e-3)
        except (BadData, BadOption) as error:
            raise BadSubject(str(error)) from None
        return self

    def std(self, name: str) -> float:
        """One standard deviation of a length [m], or of a mount's axis [rad]; NaN where nothing is known."""
        if name not in self.order:
            return float("nan")
        k = self.order.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def lengths_covariance(self, names: Iterable[str] = LENGTHS) -> np.ndarray:
        """Covariance (n, n) [m²] of the named lengths; zero where nothing is known of a length's error."""
        names = list(names)
        known = [k for k, name in enumerate(names) if name in self.order]
        rows = [self.order.index(names[k]) for k in known]
        found = np.zeros((len(names), len(names)))
        found[np.ix_(known, known)] = self.covariance[np.ix_(rows, rows)]
        return found

    def mount_covariance(self, segment: str) -> np.ndarray | None:
        """Covariance (3, 3) [rad²] of a calibrated mount's error in L; None where nothing is known of it."""
        rows = mount_rows(segment)
        if segment not in self.mounts or not set(rows) <= set(self.order):
            return None
        at = [self.order.index(row) for row in rows]
        return self.covariance[np.ix_(at, at)]

    def draw(self, rng: np.random.Generator) -> Subject:
        """A random person from this one's distribution of lengths, for simulation."""
        mean = np.array([self.lengths[name] for name in LENGTHS])
        drawn = rng.multivariate_normal(mean, self.lengths_covariance())
        # A length three times off is no person; this only guards the far tails.
        drawn = np.clip(drawn, 0.7 * mean, 1.3 * mean)
        return replace(
            self,
            name="drawn",
            lengths=dict(zip(LENGTHS, drawn.tolist(), strict=True)),
            covariance=np.zeros_like(self.covariance),
            note="drawn at random",
        )


def mount_rows(segment: str) -> list[str]:
    """What the rows of a subject's covariance that belong to a mount are called."""
    return [f"mounts.{segment}.{axis}" for axis in "xyz"]


_ROWS = (*LENGTHS, *(row for segment in SEGMENTS for row in mount_rows(segment)))  # what a covariance may be of


def check_lengths(place: str, lengths: Mapping[str, float], names: Collection[str]) -> None:
    """Each length [m] has one of the names and is that of a person's part.

    Raises
    ------
    BadOption
        One has, or is, not.
    """
    check_names(place, lengths, names)
    for name, value in lengths.items():
        if not 0.0 < value < LONGEST:
            raise BadOption(f"{place}.{name} = {value:g}: a length in metres is needed, above 0 and below {LONGEST:g}")


def average_subject(stature: float | None = None, sex: str | None = None) -> Subject:
    """The anthropometric prior: mean lengths and their covariance over people.

    Lengths share the stature's spread where it is not given, left and right share the person's shape; numbers and
    sources stand in ``calibration/anthropometry.toml``.

    Parameters
    ----------
    stature : body height [m]; None: 1.75 with the spread of adults
    sex : "f", "m", or None for the mean of both

    Raises
    ------
    BadOption
        A stature outside 1.0 to 2.5 m, or another sex.
    """
    check_arguments(average_subject, locals())
    if stature is not None and not 1.0 <= stature <= 2.5:
        raise BadOption(f"stature {stature:g} is not a body height in metres; between 1.0 and 2.5")
    if sex is not None and sex not in SEXES:
        raise BadOption(f"sex '{sex}' is not known; {one_of(SEXES)}")
    table = tomllib.loads(asset("calibration", "anthropometry.toml").read_text(encoding="utf-8"))
    height = stature if stature is not None else table["stature"]["mean"]
    height_std = 0.0 if stature is not None else table["stature"]["std"] / table["stature"]["mean"]
    shares = [table[{"f": "female", "m": "male"}[s]] for s in ([sex] if sex else SEXES)]

    part = [name.removeprefix("left_").removeprefix("right_") for name in LENGTHS]
    mean = np.array([height * np.mean([share[p] for share in shares]) for p in part])
    # Relative errors: one of stature common to all, one of shape common to left and right, one of each side.
    shape = np.array([table["shape_std"][p] for p in part])
    same = np.array([[a == b for a in part] for b in part], dtype=float)
    sided = np.array([p != name for p, name in zip(part, LENGTHS, strict=True)], dtype=float)
    relative = height_std**2 + same * np.outer(shape, shape) + np.diag(sided * table["asymmetry_std"]["all"] ** 2)
    known = ", ".join([f"stature {height:g} m" + ("" if stature else " assumed"), f"sex {sex or 'not given'}"])
    return Subject(
        name="average",
        lengths=dict(zip(LENGTHS, mean.tolist(), strict=True)),
        order=LENGTHS,
        covariance=np.outer(mean, mean) * relative,
        note=f"anthropometric average ({known})",
    )


def subject_toml(subject: Subject) -> str:
    """The text of ``subject.toml``."""
    lines = [f"format = {FORMAT}", f"name = {_quoted(subject.name)}"]
    if subject.note:
        lines.append(f"note = {_quoted(subject.note)}")
    lines += ["", "[lengths]       # m", *(f"{k} = {v:.6f}" for k, v in subject.lengths.items())]
    lines += ["", "[lengths_std]   # m, one standard deviation"]
    lines += [f"{k} = {subject.std(k):.6f}" for k in subject.lengths if k in subject.order]
    for segment, quat in subject.mounts.items():
        lines += ["", f"[mounts.{segment}]   # R_LS, sensor to segment"]
        lines += [f"{key} = {value:.9f}" for key, value in zip(("qx", "qy", "qz", "qw"), quat, strict=True)]
        std = [subject.std(row) for row in mount_rows(segment)]
        if np.isfinite(std).all():
            lines.append(f"std_deg = {np.degrees(np.sqrt(np.mean(np.square(std)))):.3f}")
    for side, hinge in subject.hinges.items():
        lines += ["", f"[hinges.{side}]   # the elbow's axis in the upper arm's frame"]
        lines += [f"{key} = {value:.9f}" for key, value in zip("xyz", hinge.axis, strict=True)]
        lines.append(f"std_deg = {np.degrees(hinge.std):.3f}")
    for segment, start in subject.start_tilt.items():
        lines += ["", f"[start_tilt.{segment}]   # off the start pose in the calibration, about x and y of W"]
        lines += [f"{key} = {np.degrees(value):.4f}" for key, value in zip(("x_deg", "y_deg"), start.tilt, strict=True)]
        lines.append(f"std_deg = {np.degrees(start.std):.4f}")
    for segment, drift in subject.drift.items():
        lines += ["", f"[drift.{segment}]   # of its sensor's heading in the calibration"]
        rates = {"rate_deg_min": drift.rate, "std_deg_min": drift.std}
        lines += [f"{key} = {60.0 * np.degrees(value):.4f}" for key, value in rates.items()]
    if subject.order:
        lines += ["", "[covariance]    # of lengths [m] and mount errors [rad], jointly"]
        lines.append(f"order = {json.dumps(list(subject.order))}")
        lines.append("matrix = [")
        lines += ["    [" + ", ".join(f"{v:.9e}" for v in row) + "]," for row in subject.covariance]
        lines.append("]")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """A string as TOML has it: as JSON, but for what cannot be encoded and for DEL, which TOML wants escaped."""
    sound = text.encode("utf-8", "replace").decode("utf-8")
    return json.dumps(sound, ensure_ascii=False).replace("\x7f", "\\u007f")


def load_subject(path: str | Path) -> Subject:
    """Read ``subject.toml`` (or the folder that holds it).

    Raises
    ------
    MissingFile, BadSubject
        Not there; a length missing, not positive, unknown; a covariance that does not fit.
    """
    check_arguments(load_subject, locals())
    path = Path(path)
    if path.is_dir():
        path = path / "subject.toml"
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; `wepose calibrate` writes one")
    try:
        return subject_of(path.read_text(encoding="utf-8"), path)
    except UnicodeDecodeError as error:
        raise BadSubject(f"{path}: not valid TOML: {error}") from error


def subject_of(text: str, path: Path) -> Subject:
    """The subject that ``subject.toml`` says; `path` is where it stands, for messages.

    Raises
    ------
    BadSubject
        As `load_subject`.
    """
    try:
        table = parsed_toml(text)
    except ValueError as error:
        raise BadSubject(f"{path}: not valid TOML: {error}") from error
    if "sensors" in table:
        raise BadSubject(f"{path}: is a session; a subject is wanted here, as `wepose calibrate` writes one")
    if table.get("format") != FORMAT:
        raise BadSubject(f"{path}: format = {table.get('format')!r}; this version reads format = {FORMAT}")
    for key in ("lengths", "lengths_std", "mounts", "hinges", "start_tilt", "drift", "covariance"):
        if not isinstance(table.get(key, {}), dict):
            raise BadSubject(f"{path}: {key} = {table[key]!r} is not a table; write [{key}]")
    lengths = table.get("lengths", {})
    for name in [*lengths, *table.get("lengths_std", {})]:
        if name not in LENGTHS:
            raise BadSubject(f"{path}: '{name}' is not a length; {one_of(LENGTHS, name)}")
    for name in LENGTHS:
        value = lengths.get(name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 < value < LONGEST:
            raise BadSubject(f"{path}: lengths.{name} = {value!r}; a number in metres is needed, above 0")
    order, matrix = _covariance(path, table.get("covariance", {}), table.get("lengths_std", {}))
    return Subject(
        name=str(table.get("name", path.parent.name)),
        lengths={name: float(lengths[name]) for name in LENGTHS},
        order=order,
        covariance=matrix,
        mounts={segment: _mount(path, segment, mount) for segment, mount in table.get("mounts", {}).items()},
        note=str(table.get("note", "")),
        hinges={side: _read_hinge(path, side, hinge) for side, hinge in table.get("hinges", {}).items()},
        start_tilt={
            segment: StartTilt(np.radians([x, y]), float(np.radians(std)))
            for segment in table.get("start_tilt", {})
            for x, y, std in [_spread(path, table, "start_tilt", segment, ("x_deg", "y_deg", "std_deg"), MOST_TILT_DEG)]
        },
        drift={
            segment: Drift(float(np.radians(rate)) / 60.0, float(np.radians(std)) / 60.0)
            for segment in table.get("drift", {})
            for rate, std in [
                _spread(path, table, "drift", segment, ("rate_deg_min", "std_deg_min"), MOST_DRIFT_DEG_MIN)
            ]
        },
    )


def _covariance(path: Path, table: Mapping, std: Mapping) -> tuple[tuple[str, ...], np.ndarray]:
    for name, value in std.items():
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 <= value < 3.0:
            raise BadSubject(f"{path}: lengths_std.{name} = {value!r}; a standard deviation in metres is needed")
    if not table:
        order = tuple(name for name in LENGTHS if name in std)
        return order, np.diag([float(std[name]) ** 2 for name in order])
    order = table.get("order", ())
    if not isinstance(order, list | tuple) or len(set(map(str, order))) != len(order):
        raise BadSubject(f"{path}: covariance.order = {order!r}; a list of names is needed, each once")
    for name in order:
        if name not in _ROWS:
            raise BadSubject(f"{path}: covariance.order: {name!r} is not known; {one_of(_ROWS, str(name))}")
    order = tuple(order)
    try:
        matrix = np.array(table.get("matrix"), dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise BadSubject(f"{path}: covariance.matrix holds something that is no number, or rows that differ") from None
    if matrix.shape != (len(order), len(order)):
        raise BadSubject(f"{path}: covariance.matrix is {matrix.shape}; {len(order)} names in order need as many rows")
    least = -1e-9 * max(1.0, float(np.trace(matrix)))  # what rounding to the file's digits may do
    if (
        not (np.abs(matrix) < 1e6).all()
        or not np.allclose(matrix, matrix.T, atol=1e-12)
        or np.linalg.eigvalsh(matrix)[0] < least
    ):
        raise BadSubject(f"{path}: covariance.matrix is not symmetric and positive semidefinite")
    return order, matrix


def _read_hinge(path: Path, side: str, table: Any) -> Hinge:
    if side not in ("left", "right"):
        raise BadSubject(f"{path}: hinges.{side} is no side; left or right")
    parts = [table.get(key) for key in ("x", "y", "z", "std_deg")] if isinstance(table, dict) else [None]
    if not all(is_number(part, 1e6) for part in parts):
        raise BadSubject(f"{path}: hinges.{side} needs four numbers, x, y, z, std_deg")
    axis, std = np.array(parts[:3], dtype=float), float(np.radians(parts[3]))  # type: ignore[arg-type]
    if not abs(np.linalg.norm(axis) - 1.0) < 1e-3 or not 0.0 < std < 1.0:
        raise BadSubject(f"{path}: hinges.{side}: x, y, z must be of length 1, and std_deg between 0 and 57")
    return Hinge(axis / np.linalg.norm(axis), std)


def _spread(path: Path, table: Mapping, key: str, segment: str, names: tuple[str, ...], most: float) -> list[float]:
    """The numbers of a segment's table, none larger than `most`, the last of them a standard deviation."""
    if segment not in SEGMENTS:
        raise BadSubject(f"{path}: {key}.{segment} is not a segment; {one_of(SEGMENTS, segment)}")
    entry = table[key][segment]
    found = [entry.get(name) for name in names] if isinstance(entry, dict) else [None]
    numbers = [v for v in found if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= most]
    if len(numbers) != len(names) or numbers[-1] < 0.0:
        raise BadSubject(
            f"{path}: {key}.{segment} = {entry!r}; it needs {', '.join(names)}, numbers up to {most:g}, the last from 0"
        )
    return numbers


def _mount(path: Path, segment: str, table: Any) -> np.ndarray:
    if segment not in SEGMENTS:
        raise BadSubject(f"{path}: mounts.{segment} is not a segment; {one_of(SEGMENTS, segment)}")
    parts = [table.get(key) for key in ("qx", "qy", "qz", "qw")] if isinstance(table, dict) else [None]
    if not all(is_number(part, 1e6) for part in parts):
        raise BadSubject(f"{path}: mounts.{segment} needs four numbers, qx, qy, qz, qw")
    quat = np.array(parts, dtype=float)
    norm = np.linalg.norm(quat)
    if not abs(norm - 1.0) < 1e-3:
        raise BadSubject(f"{path}: mounts.{segment} is no unit quaternion; it needs qx, qy, qz, qw of length 1")
    return quat / norm
