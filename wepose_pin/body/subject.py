"""`Subject`: a person's lengths and sensor mounts with their joint covariance, and the file they live in."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..arguments import NonNegative, Range, check_arguments, check_array, check_fields, check_names
from ..documents import Key, TomlTable, format_record, format_toml, read_record, read_toml, whole_file
from ..errors import BadData, BadModel, BadOption, BadSubject
from .body import BodyModel
from .girdle import PARAMETERS
from .soft_tissue import USUAL_POSE_SHARE, estimate_pose_share, estimate_scatter, make_personal
from .table import BodyTable, Segment, compute_population_lengths, load_table

# A row of a covariance, other than lengths.
_ROW = re.compile(r"(mounts\..+\.|girdles\..+\.(rest|raised)_)[xyz]|girdles\..+\.law")
LONGEST = 3.0  # [m] of a plausible length
BodyLength = Annotated[float, Range(0.0, closed=False, high=LONGEST, unit="m")]
FORMAT = 2
Quality = Literal["pass", "poor", "fail"]  # of a calibration
POPULATION = "population"  # name of the prior of a body's lengths
# [rad] by which the plane of a hinge is turned about the segment above it against that segment's frame, beyond its
# turn in the start pose; of simulated people.
HINGE_PLANE_STD = np.deg2rad(7.0)
MOST_TISSUE_SHARE = 1.5  # of the population's mean soft tissue that a person has

# Limits of a file; whether numbers are plausible says the quality of the calibration.
_OFFSET = Key(unit="deg", least=-180.0, most=180.0, digits=4, each=("x_deg", "y_deg", "std_deg"))
# Of a heading: up to 100 deg/s.
_DRIFT = Key(unit="deg_min", least=-6000.0, most=6000.0, digits=5, each=("rate_deg_min", "std_deg_min"))
_UNIT = Key(least=-1.001, most=1.001, digits=9)  # of a component of a unit vector
_MOUNT = replace(_UNIT, each=("qx", "qy", "qz", "qw"), unread=("std_deg",))
_GIRDLE = Key(least=-LONGEST, most=LONGEST, each=PARAMETERS, digits=6)
_COMMENT = "# Lengths and girdles in m; mounts rotate the sensor's frame to the segment's; see docs/calibrate.md"


class Hinge(NamedTuple):
    """The axis of a joint of nearly one axis, such as an elbow."""

    # (3,) unit, in the frame of the segment above
    axis: Annotated[np.ndarray, replace(_UNIT, each=("x", "y", "z"))]
    # [rad] by which the segment below leaves the plane across it, with soft tissue
    std: Annotated[NonNegative, Key(unit="deg", least=0.0, most=57.3, digits=3)]
    # [rad/rad] by which the sensor above lags behind the twist that it shows; None: not known
    twist_lag: Annotated[float | None, Key(least=-10.0, most=10.0, digits=4)] = None
    # [rad/rad] by which the segment below leaves the plane as it turns about its long axis; None: not known
    per_twist: Annotated[float | None, Key(least=-1.0, most=1.0, digits=4)] = None


@dataclass(frozen=True)
class Subject:
    """A person's lengths, mounts and what else a calibration estimates.

    Parameters
    ----------
    name : of the person
    lengths : name → [m], as the table of the body names them
    order : names of the k rows of `covariance`: lengths [m]; ``mounts.<segment>.x``, ``.y``, ``.z`` [rad], the error of
        a mount as a rotation vector in the segment's frame L, about the vertical relative to the start pose as held;
        ``girdles.<point>.law`` (no unit), ``.rest_x`` … [m]
    covariance : (k, k) of the errors of what `order` names
    mounts : segment → `quat_LS` (4,) xyzw, its sensor's mount (S to L); empty where none is calibrated
    note : where the numbers come from, in a few words
    hinges : joint → `Hinge`, its axis, where a calibration estimated it
    start_pose_offset : segment → (3,) [rad] its angles to the start pose in the calibration, about x and y of W, which
        a person nearly repeats, and the standard deviation of each
    heading_drift : segment → (2,) [rad/s] drift of its sensor's heading in the calibration, by what remained of the
        gyroscope's bias, and its standard deviation; on another day it has a similar size
    girdles : shoulder point → (7,) by which the person differs from the body's law of the shoulder girdle: a share of
        the law, then a displacement x, y, z [m] at rest and another [m] with the arm raised by 90°
    quality : "pass", "poor" or "fail", of the calibration that estimated it; empty where none did
    """

    name: str
    lengths: Annotated[Mapping[str, BodyLength], Key("lengths", "m", digits=6)]
    order: Annotated[tuple[str, ...], None]
    covariance: Annotated[np.ndarray, None]
    mounts: Annotated[Mapping[str, np.ndarray], _MOUNT] = field(default_factory=dict)
    note: str = ""
    hinges: Mapping[str, Hinge] = field(default_factory=dict)
    start_pose_offset: Annotated[Mapping[str, np.ndarray], _OFFSET] = field(default_factory=dict)
    heading_drift: Annotated[Mapping[str, np.ndarray], _DRIFT] = field(default_factory=dict)
    girdles: Annotated[Mapping[str, np.ndarray], _GIRDLE] = field(default_factory=dict)
    quality: Literal["", "pass", "poor", "fail"] = ""

    def __repr__(self) -> str:
        quality = f", calibration {self.quality}" if self.quality else ""
        return f"Subject({self.name!r}: {len(self.lengths)} lengths, {len(self.mounts)} mounts{quality})"

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write ``subject.toml``, which `load_subject` and ``wepose track --subject`` read.

        Parameters
        ----------
        path : str or Path
            The file, whose name ends in ``.toml``, or its folder.
        force : bool
            Replace an existing file.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        ExistingOutput
            The file is there and `force` is not given, or it cannot be written.

        Examples
        --------
        >>> wp.population_subject(1.68, "f").save("anna")
        PosixPath('anna/subject.toml')
        """
        file = Path(path) if Path(path).suffix == ".toml" else Path(path) / "subject.toml"
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file, force) as partial:
            partial.write_text(subject_toml(self), encoding="utf-8")
        return file

    @property
    def is_population(self) -> bool:
        """True of the population prior, without any calibration."""
        return self.name == POPULATION

    def check(self, where: str = "") -> Subject:
        """Check all fields and return the subject; `where` begins the text of a `BadOption` or `BadSubject`."""
        where = where or f"subject {self.name!r}: "
        check_fields(self, where)
        sizes = {"mounts": 4, "start_pose_offset": 3, "heading_drift": 2, "girdles": len(PARAMETERS)}
        arrays = {f"{key}.{name}": (own, n) for key, n in sizes.items() for name, own in getattr(self, key).items()}
        arrays |= {f"hinges.{name}.axis": (hinge.axis, 3) for name, hinge in self.hinges.items()}
        try:
            named = [row for row in self.order if not _ROW.fullmatch(row)]
            check_names(f"{where}covariance.order", named, self.lengths)
            if len(set(self.order)) < len(self.order):
                raise BadData(f"{where}covariance.order names a row twice")
            check_array(f"{where}covariance", self.covariance, (len(self.order),) * 2)
            for name, (values, size) in arrays.items():
                unit = 1e-3 if name.startswith(("mounts", "hinges")) else np.inf
                check_array(f"{where}{name}", values, (size,), unit=unit)
                if name.startswith(("start_pose_offset", "heading_drift")) and values[-1] < 0.0:
                    raise BadData(f"{where}{name}[{size - 1}] = {values[-1]:g}: a standard deviation is at least 0")
        except (BadData, BadOption) as error:
            raise BadSubject(str(error)) from None
        return self

    def check_quality(self) -> None:
        """Raise `BadSubject` where `quality` is "fail"."""
        if self.quality == "fail":
            raise BadSubject(
                f"subject '{self.name}': its calibration failed (quality = \"fail\"); calibrate again, or use it "
                f"with `accept_failed=True`"
            )

    def check_body(self, table: BodyTable) -> None:
        """Raise `BadSubject` where a name is not one of the body's, or a length of the body is missing."""
        where = f"subject '{self.name}': "
        if missing := [name for name in table.lengths if name not in self.lengths]:
            raise BadSubject(f"{where}lengths: {', '.join(missing)} of the body {table.name} is missing")
        for key in ("mounts", "start_pose_offset", "heading_drift"):
            check_names(f"{where}{key}", getattr(self, key), table.segments, BadSubject)
        check_names(f"{where}hinges", self.hinges, table.hinges, BadSubject)
        if table.girdles:  # else, as those of others, it has its own shoulders
            check_names(f"{where}girdles", self.girdles, table.girdles, BadSubject)

    def shape(self, body: BodyModel, *, remounted: bool = False) -> BodyModel:
        """Return the body with this person's lengths, girdles and means of soft tissue, unknown if `remounted`."""
        body = body.with_lengths({name: self.lengths[name] for name in body.lengths if name in self.lengths})
        girdles = {name: own for name, own in self.girdles.items() if name in body.table.girdles}
        return replace(body, girdles=girdles, personal={} if remounted else self._find_personal(body))

    def _find_personal(self, body: BodyModel) -> dict[str, Segment]:
        """Find segment → its properties with this person's means of soft tissue; nothing where no hinge shows them.

        A hinge shows how far the sensor above it lags behind a twist. The share of the usual lag that it has is
        assumed for all soft tissue. The axis of a hinge also shows how far the person twists the segment above it, and
        what hangs on that, in the start pose. How well the hinges hold shows how far soft tissue varies, and the tilts
        in the start pose how exactly the person stood.
        """
        segments, hinges, personal = body.table.segments, body.table.hinges, dict[str, Segment]()
        shown = {hinges[joint].on: joint for joint, hinge in self.hinges.items() if hinge.twist_lag is not None}
        usual = sum(segments[name].soft_tissue.mean_per_twist for name in shown)
        if not usual:
            return {}
        share = sum(self.hinges[joint].twist_lag or 0.0 for joint in shown.values()) / usual
        share = min(max(share, 0.0), MOST_TISSUE_SHARE)
        scatter = estimate_scatter([hinge.std for hinge in self.hinges.values()])
        # The table states twists as people hold them, and tilts larger.
        pose_size = min(estimate_pose_share(self.start_pose_offset, body.table) / USUAL_POSE_SHARE, 1.0)
        for name, segment in segments.items():
            lag, start = share * segment.soft_tissue.mean_per_twist, share * segment.start_mean[2]
            size, carrier = 1.0 if name in shown else pose_size**2, body.parents.get(name)
            start_var = size * (segment.start_std[2] ** 2 - segment.start_mean[2] ** 2)
            if carrier in personal:
                start += personal[carrier].start_mean[2]
                start_var += personal[carrier].start_std[2] ** 2 - size * segments[carrier].start_std[2] ** 2
            start_var = max(start_var, 0.0)
            if name in shown:
                usual_axis, hinge = np.array(hinges[shown[name]].axis), self.hinges[shown[name]]
                angle = np.arctan2(np.cross(usual_axis, hinge.axis)[2], usual_axis @ hinge.axis)
                # What a hinge shows beyond all people is no skin: a wrong axis, or a sensor that slides.
                lag = min(max(hinge.twist_lag or 0.0, 0.0), MOST_TISSUE_SHARE * segment.soft_tissue.mean_per_twist)
                plane_var = (scatter * HINGE_PLANE_STD) ** 2
                weight = start_var / (start_var + plane_var)
                start, start_var = float(weight * angle), weight * plane_var
            # Soft tissue in any pose is part of the uncertainty of what a motion has shown: of the tilts of mounts that
            # are not known better, and of the twist by a hinge. It does not count again.
            tissue = make_personal(segment.soft_tissue, share, lag, scatter)
            tilt_std = [self.std(row) for row in mount_rows(name)[:2]]
            is_counted = [*np.greater_equal(tilt_std, tissue.std[:2]), name in shown]
            personal[name] = segment._replace(
                soft_tissue=tissue._replace(std=tuple(np.where(is_counted, 0.0, tissue.std))),
                start_mean=(*segment.start_mean[:2], start),
                start_std=(*segment.start_std[:2], float(np.sqrt(start_var))),
            )
        return personal

    def turn_hinges(self, body: BodyModel) -> dict[str, Hinge]:
        """Return the hinges with their axes in the segments as the means of soft tissue correct them."""
        hinges = {}
        for joint, hinge in self.hinges.items():
            own = body.personal.get(body.table.hinges[joint].on)
            turn = Rotation.from_rotvec([0.0, 0.0, 0.0 if own is None else -own.start_mean[2]])
            hinges[joint] = hinge._replace(axis=turn.apply(hinge.axis))
        return hinges

    def std(self, name: str) -> float:
        """Return one standard deviation of a row of `order`, in its unit; NaN where there is no such row."""
        return float(np.sqrt(np.diag(self.covariance)[self.order.index(name)])) if name in self.order else float("nan")

    def lengths_covariance(self, names: Iterable[str] | None = None) -> np.ndarray:
        """Return the covariance (n, n) of the named rows of `order`, or of all lengths [m²]; zero without a row."""
        names = list(self.lengths if names is None else names)
        known = [k for k, name in enumerate(names) if name in self.order]
        rows = [self.order.index(names[k]) for k in known]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(known, known)] = self.covariance[np.ix_(rows, rows)]
        return covariance

    def shape_covariance(self, table: BodyTable) -> np.ndarray:
        """Return the covariance (k + 7 g, k + 7 g) of a body's k lengths [m] and of the parameters of its g girdles.

        The parameters are in the order and units of `girdles`. Where this subject has no covariance of them, it is the
        spread of people that the table states.
        """
        rows, k, girdles = girdle_rows(table), len(table.lengths), table.girdles
        covariance = self.lengths_covariance([*table.lengths, *rows])
        if not set(rows) <= set(self.order):
            std = np.ravel([(each.law_std, *each.rest_std, *each.raised_std) for each in girdles.values()])
            alike = [[girdles[a].alike if table.counterpart(a) == b else 0.0 for b in girdles] for a in girdles]
            both_sides = np.diag([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # the law and the place at rest
            correlation = np.eye(std.size) + np.kron(np.reshape(alike, (len(girdles), len(girdles))), both_sides)
            covariance[k:] = covariance[:, k:] = 0.0
            covariance[k:, k:] = correlation * np.outer(std, std)
        return covariance

    def mount_covariance(self, segment: str) -> np.ndarray | None:
        """Return the covariance (3, 3) [rad²] of a calibrated mount's error in L; None: the mount has none."""
        rows = mount_rows(segment)
        is_known = segment in self.mounts and set(rows) <= set(self.order)
        return self.lengths_covariance(rows) if is_known else None


def mount_rows(segment: str) -> list[str]:
    """Return the names of a mount's rows in a subject's covariance."""
    return [f"mounts.{segment}.{axis}" for axis in "xyz"]


def girdle_rows(table: BodyTable) -> list[str]:
    """Return the names of the rows of all girdles' parameters in a subject's covariance."""
    return [f"girdles.{name}.{parameter}" for name in table.girdles for parameter in PARAMETERS]


def population_subject(
    stature: float | None = None, sex: Literal["f", "m"] | None = None, body: BodyModel | BodyTable | None = None
) -> Subject:
    """Return the population prior: the mean lengths of people of this stature and sex, with their covariance.

    Errors of all lengths are correlated by the stature where it is not given, those of left and right by the shape of
    the person. A length that the body's table does not relate to stature, such as a robot's, is that of the model, with
    the standard deviation that the table states in percent.

    Parameters
    ----------
    stature : float, optional
        Body height [m]; None: 1.75 with the spread of adults.
    sex : str, optional
        "f", "m", or None for the mean of both.
    body : BodyModel or BodyTable, optional
        The body whose lengths these are; None: the upper body.

    Returns
    -------
    Subject
        Lengths [m] with their covariance, without mounts.

    Raises
    ------
    BadOption
        A stature outside 1.0 to 2.5 m, or another sex.
    BadModel
        The table relates a length to stature in a way that is not known; or it does not, and `body` is a table without
        the model that has the length.

    Examples
    --------
    >>> prior = wp.population_subject(1.68, "f")
    >>> prior
    Subject('population': 8 lengths, 0 mounts)
    >>> round(prior.lengths["left_forearm"], 2), round(prior.std("left_forearm"), 2)  # [m]
    (0.26, 0.01)
    """
    check_arguments(population_subject, {"stature": stature, "sex": sex})
    table = load_table() if body is None else body if isinstance(body, BodyTable) else body.table
    people, people_cov, note = compute_population_lengths(table, stature, sex)
    order = tuple(table.lengths)
    lengths, covariance = dict.fromkeys(order, 0.0) | people, np.zeros((len(order),) * 2)
    for k, (name, length) in enumerate(table.lengths.items()):
        if name not in people:
            if not isinstance(body, BodyModel):
                raise BadModel(f"{table.where}: lengths.{name} is no share of stature; its model is needed")
            lengths[name] = body.lengths[name]
            covariance[k, k] = (0.01 * length.std_percent * lengths[name]) ** 2
    rows = [order.index(name) for name in people]
    covariance[np.ix_(rows, rows)] = people_cov
    note = note if people else f"lengths of the model {table.name}"
    return Subject(POPULATION, lengths, order, covariance, note=note)


def subject_toml(subject: Subject) -> str:
    """Return the text of ``subject.toml``."""
    values = {"format": FORMAT, "lengths": {}, **format_record(subject)}
    for segment in subject.mounts:
        if (cov := subject.mount_covariance(segment)) is not None:
            values["mounts"][segment]["std_deg"] = round(float(np.degrees(np.sqrt(np.trace(cov) / 3.0))), 3)
    if subject.order:
        values["lengths_std"] = {name: round(subject.std(name), 6) for name in subject.lengths if name in subject.order}
        matrix = [[float(f"{v:.9e}") for v in row] for row in subject.covariance]
        values["covariance"] = {"order": subject.order, "matrix": matrix}
    return "\n".join([_COMMENT, *format_toml(values)]) + "\n"


def load_subject(path: str | Path) -> Subject:
    """Read ``subject.toml``.

    Parameters
    ----------
    path : str or Path
        The file, or the folder that holds it, such as `wepose calibrate -o` wrote.

    Returns
    -------
    Subject
        Lengths [m] and mounts with their joint covariance.

    Raises
    ------
    MissingFile, BadSubject
        There is no such file; a length is missing, not positive or unknown; the covariance does not fit its order.

    Examples
    --------
    >>> subject = wp.load_subject("subject.toml")
    >>> round(subject.lengths["shoulder_width"], 2)  # [m]
    0.33
    """
    check_arguments(load_subject, locals())
    file = Path(path) / "subject.toml" if Path(path).is_dir() else Path(path)
    return _subject(read_toml(file, "a subject, as `wepose calibrate` writes one,", BadSubject), file)


def parse_subject(text: str, path: Path) -> Subject:
    """Return the subject of the text of ``subject.toml``; `path` is for messages."""
    try:
        return _subject(tomllib.loads(text), path)
    except ValueError as error:
        raise BadSubject(f"{path}: not valid TOML: {error}") from error


def _subject(values: Mapping[str, Any], path: Path) -> Subject:
    top, form = TomlTable(values, str(path), error=BadSubject), values.get("format")
    if form != FORMAT:
        needed = f"a subject, as `wepose calibrate` writes one, has format = {FORMAT}"
        raise BadSubject(f"{path}: format = {form!r}; {needed}")
    top.table("lengths")
    base = Subject(path.parent.name, {}, (), np.zeros((0, 0)))
    subject = read_record(Subject, top, base=base, others=("format", "lengths_std", "covariance"))
    table, std = top.table("covariance", {}), top.table("lengths_std", {})
    table.allow("order", "matrix")
    std.allow(*subject.lengths)
    order = table.texts("order") if table.values else tuple(name for name in subject.lengths if name in std)
    covariance = np.diag([float(std.get(name, 0.0, NonNegative)) ** 2 for name in order])
    if table.values:
        try:
            covariance = np.array(table.values.get("matrix"), dtype=float)
        except (TypeError, ValueError, OverflowError):
            raise BadSubject(f"{table.at('matrix')}: rows of numbers are needed, of one length") from None
    subject = replace(subject, order=order, covariance=covariance).check(f"{path}: ")
    # What the digits of the file leave of a unit vector's length.
    mounts = {name: quat / np.linalg.norm(quat) for name, quat in subject.mounts.items()}
    hinges = {name: each._replace(axis=each.axis / np.linalg.norm(each.axis)) for name, each in subject.hinges.items()}
    return replace(subject, mounts=mounts, hinges=hinges)
