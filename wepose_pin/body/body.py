"""`BodyModel`, and the function that loads one."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ..arguments import check_arguments
from ..assets import asset
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadModel, BadSession, one_of
from . import lengths as _lengths
from . import visuals as _visuals
from .anthropometry import compute_population_lengths
from .chains import Chain, axis_in_joint, find_chains
from .girdle import PARAMETERS
from .naming import MOST_LINKS, format_closest_links, rename_links
from .reaches import LinkVector, measure_reaches
from .soft_tissue import TissueMean
from .table import DEFAULT_BODY, BodyTable, Segment
from .table_file import find_table, load_table, parse_table, read_table
from .tree import build, check_joint_values, find_impossible_inertia, parse_tree
from .urdf import import_yourdfpy, read_urdf
from .visuals import Visual

# Standard deviations off the mean of adults (calibration/anthropometry.toml), above which a length is implausible.
FAR_OFF = 5.0
# So is a mass [kg] beyond ten standard deviations above the mean of men, 85.5 ± 14.2 kg (ANSUR II), or below an upper
# body's share (head, arms and trunk: 68 %, Winter 2009, table 4.1) of five below the mean of women, 67.8 ± 11.0 kg.
HEAVIEST, LIGHTEST = 230.0, 8.0
MIN_HINGE_COSINE = 0.5  # of the angle between a hinge's axis and that of the joint, below which it is another axis


@dataclass(frozen=True)
class BodyModel:
    """A body of known lengths.

    Parameters
    ----------
    pin : the Pinocchio model; one frame a link, of the link's name. Its universe is W
    robot : the parsed URDF it was built from, already with its lengths and the table's names (yourdfpy)
    table : what there is on it; its links bear the names of segments and points
    joints : child link of a spherical joint → its Pinocchio joint
    axes : the same → (3, 3) the axes that were joined, a row each, in the joint's frame at zero; without an entry for
        a `floating` joint
    girdles : girdle → (7,) what a person differs by from its law, `girdle.PARAMETERS`; zeros where it is not named
    tissue_means : segment → what a person's has turned beyond its sensor; nothing where it is not named
    loaded : the same body before its lengths were set; None: they were not
    """

    pin: pin.Model
    robot: Any
    table: BodyTable
    joints: Mapping[str, int]
    axes: Mapping[str, np.ndarray]
    girdles: Mapping[str, np.ndarray] = field(default_factory=dict)
    tissue_means: Mapping[str, TissueMean] = field(default_factory=dict)
    loaded: BodyModel | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        return f"BodyModel({self.robot.name!r}: {len(self.table.segments)} segments, {self.pin.nv} degrees of freedom)"

    def girdle_parameters(self, name: str) -> np.ndarray:
        """(7,) what a girdle differs by from its law."""
        return self.girdles.get(name, np.zeros(len(PARAMETERS)))

    @cached_property
    def point_girdles(self) -> dict[str, tuple[str, ...]]:
        """Point → the girdles that move it."""
        m = self.pin
        joints = {name: m.getJointId(girdle.joints[-1]) for name, girdle in self.table.girdles.items()}
        supports = {
            point: m.supports[m.frames[m.getFrameId(at)].parentJoint] for point, at in self.point_frames.items()
        }
        return {
            point: tuple(name for name, joint in joints.items() if joint in above) for point, above in supports.items()
        }

    @cached_property
    def lengths(self) -> dict[str, float]:
        """The lengths [m] that this model has, measured on it in the neutral configuration."""
        return _lengths.measure_lengths(self.robot, self.table)

    @cached_property
    def chains(self) -> dict[str, Chain]:
        """Segment → the joints that set its orientation, in the order of Pinocchio's joints."""
        return find_chains(self.pin, self.table)

    @cached_property
    def parents(self) -> dict[str, str | None]:
        """Segment → the segment above it; None for the first."""
        return {name: self.chains[name].above for name in self.table.segments if name in self.chains}

    @cached_property
    def reaches(self) -> dict[str, dict[str, LinkVector]]:
        """Point → link → its part of the way from the root, the same for all lengths."""
        if self.loaded is not None:
            return self.loaded.reaches
        return measure_reaches(
            self.table, self.lengths, lambda lengths: self.with_lengths(lengths).pin if lengths else self.pin
        )

    @cached_property
    def neutral_rotations(self) -> dict[str, np.ndarray]:
        """`orient_links` with all joints at zero."""
        return self.orient_links(pin.neutral(self.pin))

    def orient_links(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Link → R_WK (3, 3) in a configuration (nq,): segments and points by name, others by that of their joint."""
        m, data = self.pin, self.pin.createData()
        pin.framesForwardKinematics(m, data, q)
        R_WK = {m.names[joint]: np.array(data.oMi[joint].rotation) for joint in range(m.njoints)}
        for link in (*self.table.points, *self.table.segments):
            if m.existFrame(link):
                R_WK[link] = np.array(data.oMf[m.getFrameId(link)].rotation)
        return R_WK

    @cached_property
    def point_frames(self) -> dict[str, str]:
        """Point → the frame whose origin it is."""
        return {name: point.link for name, point in self.table.points.items()}

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Implausible lengths, mass or moments of inertia, and a trunk that cannot move."""
        name, people = self.robot.name, compute_population_lengths(self.table)
        diagnostics = []
        for length, mean, std in zip(people.names, people.mean, np.sqrt(np.diag(people.covariance)), strict=True):
            value = self.lengths[length]
            if abs(value - mean) > FAR_OFF * std:
                plausible = {"shortest": max(0.0, mean - FAR_OFF * std), "longest": mean + FAR_OFF * std}
                facts: dict[str, float | str] = {"model": name, "deviations": FAR_OFF, **plausible}
                diagnostics.append(Diagnostic("model-implausible", WARNING, length, value, facts=facts))
        mass = sum(inertia.mass for inertia in self.pin.inertias)
        if mass and people.names and not LIGHTEST <= mass <= HEAVIEST:
            facts = {"variant": "mass", "mass": mass, "lightest": LIGHTEST, "heaviest": HEAVIEST}
            diagnostics.append(Diagnostic("model-implausible", WARNING, name, facts=facts))
        impossible = find_impossible_inertia(self.robot)
        if impossible:
            facts = {"variant": "inertia", "links": ", ".join(impossible)}
            diagnostics.append(Diagnostic("model-implausible", WARNING, name, facts=facts))
        first = self.table.reference
        if not self.table.is_mechanism and not self.chains[first].joints:
            rigid = ", ".join(joint.name for joint in parse_tree(self.robot, name).path(first))
            facts = {"variant": "fixed", "joints": rigid or "the root", "segment": first}
            diagnostics.append(Diagnostic("model-implausible", WARNING, name, facts=facts))
        return tuple(diagnostics)

    @cached_property
    def visuals(self) -> list[Visual]:
        """The visuals of all links."""
        return _visuals.visuals(self.robot)

    def with_lengths(self, lengths: Mapping[str, float]) -> BodyModel:
        """The same body with other lengths [m]; those not named stay.

        Offsets, visuals and inertias of a segment stretch along it, masses with the volume.

        Raises
        ------
        BadModel
            A length that this model does not have, or that is not positive.
        """
        own = self.lengths
        for name, value in lengths.items():
            if name not in own:
                raise BadModel(f"{self.robot.name}: the model has no length '{name}'; {one_of(own, name)}")
            if not 0.0 < value < 10.0:
                raise BadModel(
                    f"{self.robot.name}: length {name} = {value!r} is no length of a body: above 0 and below 10 m"
                )
        body = _body(_lengths.with_lengths(self.robot, self.table, lengths), self.table, self.robot.name)
        return replace(body, girdles=self.girdles, tissue_means=self.tissue_means, loaded=self.loaded or self)

    def urdf(self) -> str:
        """This body as the text of a URDF that any tool reads."""
        from lxml import etree

        library = import_yourdfpy()
        urdf = library.URDF(
            self.robot,
            build_scene_graph=False,
            load_meshes=False,
            filename_handler=library.urdf.filename_handler_null,  # paths stay: `read_urdf` has resolved them
        )
        tree = urdf.write_xml()
        return etree.tostring(tree, pretty_print=True, xml_declaration=True, encoding="utf-8").decode()


def load_model(
    path: str | Path | None = None,
    lengths: Mapping[str, float] | None = None,
    *,
    like: str = DEFAULT_BODY,
    segments: Mapping[str, Any] | None = None,
    points: Mapping[str, Any] | None = None,
    up: str = "+z",
    forward: str = "+x",
    root: str | Sequence[str] | None = None,
) -> BodyModel:
    """Read a body model.

    Parameters
    ----------
    path : str or Path, optional
        A URDF, or a table (TOML) that names one, or the name of a body that comes with the package ("whole_body"); None
        for the upper body, a person of 1.75 m.
    lengths : mapping, optional
        Length → [m] to scale the body to; None: as the file has them.
    like : str
        The body of the package whose names of segments, points and lengths `segments` and `points` use.
    segments : mapping, optional
        Segment → name of its link in the URDF; or → ``{"link": …, "up": "+z", "forward": "+x"}``, where the link's axes
        that point up and forward in the N-pose do not follow from the segment's direction with all joints at zero.
        None: from the table beside the URDF, else links with the segments' names, else a table of the package whose
        links the URDF has (human-gazebo, the human of example-robot-data).
    points : mapping, optional
        Point → its link, or ``{"link": …, "at": [x, y, z]}`` [m] in the link, where the point is not at the origin of
        its segment's link.
    up, forward : str
        Axes of the URDF's root link that point up and forward while all joints are at zero.
    root : str or sequence of str, optional
        The link whose origin is that of W, or two links, such as the hips, midway between which it is; None: the root
        link of the URDF.

    Returns
    -------
    BodyModel
        Its `pin` is the Pinocchio model, its `table` names segments, points, lengths and joints. A body of the package
        is read once and shared: what is to be changed in it, such as `pin`, is copied first.

    Raises
    ------
    MissingFile, BadModel
        There is no such file; it is not a URDF; its links are no tree with one root; the table names a link that the
        URDF lacks; segments have no link, or no joint that could move it.

    Examples
    --------
    >>> model = wp.load_model("whole_body")
    >>> model
    BodyModel('whole_body': 15 segments, 51 degrees of freedom)
    >>> model.pin.nq  # numbers in a configuration
    66
    >>> round(wp.load_model(lengths={"left_forearm": 0.26}).lengths["left_forearm"], 3)  # [m]
    0.26
    """
    check_arguments(load_model, locals())
    path = _find_body(path)
    if segments is not None:
        entries = {"like": like, "segments": segments, "points": points or {}, "up": up, "forward": forward}
        body = _load_body(path, {**entries, "root": root or ()})
    elif points is not None or root is not None or (up, forward) != ("+z", "+x"):
        raise BadModel(f"{path}: points, up, forward and root are part of a table; give segments with them")
    else:
        packaged = path.parent == asset("urdf", f"{DEFAULT_BODY}.urdf").parent
        body = _load_packaged_body(path) if packaged else _load_body(path)
    return body.with_lengths(lengths) if lengths else body


@lru_cache
def _load_packaged_body(path: Path) -> BodyModel:
    """Return a body of the package, read once; a `BodyModel` does not change."""
    return _load_body(path)


def _load_body(path: Path, entries: Mapping[str, Any] | None = None) -> BodyModel:
    """Return the body of a URDF or of a table that names one; `entries` of a table that is given go before."""
    table: BodyTable | None = None
    if path.suffix.lower() == ".toml":
        table, urdf = read_table(path, needs_urdf=True)
        path = urdf or path
    if entries is not None:
        table = parse_table(dict(entries), str(path), path.stem)
    robot = read_urdf(path)
    tree, own = parse_tree(robot, str(path)), table is not None
    table = table or find_table(path, tree.below)
    if table is None:
        default = load_table()
        lacking = [name for name in default.needed if default.segments[name].link not in tree.below]
        raise BadModel(
            f"{path}: no link {format_closest_links(lacking, tree.below, default)}; name the segments' links in a "
            f'table, as docs/models.md shows (of a robot with kind = "mechanism"); '
            f"{one_of(tree.below, most=MOST_LINKS)}"
        )
    joints = {joint.name for joint in robot.joints}
    girdles = {name: girdle for name, girdle in table.girdles.items() if joints.issuperset(girdle.joints)}
    if own:
        for pose, values in table.poses.items():
            check_joint_values(robot, values, f"{table.where}: poses.{pose}", BadModel)
        _check_girdles(robot, table)
    else:  # the names fit; joints may have others
        table = replace(table, poses={name: pose for name, pose in table.poses.items() if joints.issuperset(pose)})
    table = replace(table, girdles=girdles)
    robot, table = rename_links(robot, table)
    body = _body(robot, table, str(path))
    _check_segments_move(body, str(path))
    if own:
        _lengths.check_lengths_scale(robot, table)
    return body


def load_sensed_model(path: str | Path | None, sensors: Collection[str], where: str) -> BodyModel:
    """Read the body of a recording whose sensors have these names; of a URDF without a table a mechanism.

    Its segments are the links that bear the sensors, as they are. Parameters and errors else as of `load_model`.

    Raises
    ------
    BadSession
        A sensor whose name is no link of a URDF without a table; `where` begins the text.
    """
    file = _find_body(path)
    if path is None or file.suffix.lower() == ".toml":
        return load_model(path)
    robot = read_urdf(file)
    tree, people = parse_tree(robot, str(file)), load_table().segments
    if find_table(file, tree.below) is not None or any(name in people and name not in tree.below for name in sensors):
        return load_model(path)
    for name in sensors:
        if name not in tree.below:
            raise BadSession(
                f"{where}: sensors.{name} is no link of {robot.name}; {one_of(tree.below, name, MOST_LINKS)}"
            )
    links = sorted(sensors, key=lambda name: len(tree.path(name)))
    segments = {name: Segment.of_mechanism(name) for name in links}
    body = _body(robot, BodyTable(robot.name, segments, kind="mechanism", where=str(file)), str(file))
    if not body.pin.nv:
        raise BadModel(f"{file}: no joint moves; a chain of revolute or prismatic joints is needed")
    return body


def _find_body(path: str | Path | None) -> Path:
    """The file of a body: ours by its name, else the path itself."""
    if path is None:
        return asset("urdf", f"{DEFAULT_BODY}.urdf")
    path = Path(path)
    if path.suffix or path.exists() or len(path.parts) > 1:
        return path
    return asset("urdf", f"{load_table(path.name).name}.toml")


def _check_girdles(robot: Any, table: BodyTable) -> None:
    """Raise `BadModel` where a girdle has a joint that is none, or does not slide.

    A body that is like ours need not have the joints of our girdles.
    """
    joints, ours = {joint.name: joint.type for joint in robot.joints}, load_table().girdles
    for girdle_name, girdle in table.girdles.items():
        place = f"{table.where}: girdles.{girdle_name}.joints"
        missing = [name for name in girdle.joints if name not in joints]
        if missing and girdle != ours.get(girdle_name):
            raise BadModel(f"{place}: '{missing[0]}' is no joint of the URDF; {one_of(joints, missing[0])}")
        turning = [name for name in girdle.joints if joints.get(name, "prismatic") != "prismatic"]
        if turning:
            raise BadModel(f"{place}: '{turning[0]}' does not slide; it is {joints[turning[0]]}, not prismatic")


def _check_segments_move(body: BodyModel, where: str) -> None:
    """Raise `BadModel` on segments that no joint moves against the one above, and on hinges between no neighbours."""
    table, tree = body.table, parse_tree(body.robot, where)
    rigid = []
    for segment in table.needed:
        above = body.parents[segment]
        if above is not None and not body.chains[segment].joints:
            shared = {joint.name for joint in tree.path(above)}
            between = [f"'{joint.name}' ({joint.type})" for joint in tree.path(segment) if joint.name not in shared]
            rigid.append(f"{segment} against {above} (between them: {', '.join(between) or 'nothing'})")
    if rigid:
        raise BadModel(
            f"{where}: no joint moves {'; '.join(rigid)}: the body could not follow; it needs revolute joints there"
        )
    for name, hinge in table.hinges.items():
        if body.parents[hinge.moves] != hinge.on:
            raise BadModel(
                f"{table.where}: hinges.{name} is none: {hinge.moves} hangs on "
                f"{body.parents[hinge.moves] or 'the root'}, not on {hinge.on}"
            )
        chain = body.chains[hinge.moves]
        if len(chain.joints) != 1 or chain.exact:
            continue
        [joint], data = chain.joints, body.pin.createData()
        pin.forwardKinematics(body.pin, data, pin.neutral(body.pin))
        axis_W = data.oMi[joint].rotation @ axis_in_joint(body.pin, joint)
        own = body.neutral_rotations[hinge.on].T @ axis_W
        if abs(own @ hinge.axis) < MIN_HINGE_COSINE:
            axis = ", ".join(f"{v:.2g}" for v in np.round(own, 9) + 0.0)
            raise BadModel(
                f"{table.where}: hinges.{name}.axis = {[*hinge.axis]} is none: {hinge.moves} turns about [{axis}] of "
                f"{hinge.on}"
            )


def _body(robot: Any, table: BodyTable, where: str) -> BodyModel:
    model, joints, axes = build(robot, where, spherical=not table.is_mechanism)
    return BodyModel(model, robot, table, joints, axes)
