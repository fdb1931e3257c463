"""`BodyModel`, and the function that loads one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ..arguments import check_arguments
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadModel, BadSession, one_of
from .girdle import PARAMETERS
from .table import MECHANISM_SEGMENT, BodyTable, Segment, compute_population_lengths, find_table, load_table, read_table
from .tree import build, check_joint_values, measure_lengths, measure_reaches, parse_tree, rename_links, stretch_robot
from .urdf import Visual, import_yourdfpy, list_visuals, read_urdf

# Standard deviations off the mean of adults (calibration/anthropometry.toml), above which a length is implausible.
FAR_OFF = 5.0


@dataclass(frozen=True)
class BodyModel:
    """A body of known lengths.

    Parameters
    ----------
    pin : the Pinocchio model; one frame a link, of the link's name. Its universe is W
    robot : the parsed URDF it was built from, already with its lengths and the table's names (yourdfpy)
    table : what there is on it; its links bear the names of segments and points
    axes : spherical joint, which has the name of the link it moves → (3, 3) the axes that were joined, a row each, in
        the joint's frame at zero; without an entry for a `floating` joint
    chains : segment → the joints that set its orientation, by Pinocchio's numbers, from the root outwards, in the order
        of these. A segment of a limb is set by the joints nearest to it, as many as make three axes; others above (a
        clavicle) rest. One of the spine is set by all joints between it and the segment above. There are none where it
        is rigid with that
    parents : segment → the segment above it; None for the first. On one joint the others hang on the first
    girdles : girdle → (7,) what a person differs by from its law, `girdle.PARAMETERS`; zeros where it is not named
    personal : segment → its properties with a person's own means of soft tissue and start pose, which are corrected;
        a segment that is not named is as of all people
    """

    pin: pin.Model
    robot: Any
    table: BodyTable
    axes: Mapping[str, np.ndarray]
    chains: Mapping[str, tuple[int, ...]]
    parents: Mapping[str, str | None]
    girdles: Mapping[str, np.ndarray] = field(default_factory=dict)
    personal: Mapping[str, Segment] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"BodyModel({self.robot.name!r}: {len(self.table.segments)} segments, {self.pin.nv} degrees of freedom)"

    def girdle_parameters(self, name: str) -> np.ndarray:
        """(7,) what a girdle differs by from its law."""
        return self.girdles.get(name, np.zeros(len(PARAMETERS)))

    @cached_property
    def personal_table(self) -> BodyTable:
        """The table with the properties of a person's segments: their standard deviations remain beyond the means."""
        return replace(self.table, segments={**self.table.segments, **self.personal})

    @cached_property
    def point_girdles(self) -> dict[str, tuple[str, ...]]:
        """Point → the girdles that move it."""
        m, girdles = self.pin, self.table.girdles
        ends = {name: m.getJointId(girdle.joints[-1]) for name, girdle in girdles.items()}
        above = {point: m.supports[m.frames[m.getFrameId(at)].parentJoint] for point, at in self.point_frames.items()}
        return {point: tuple(name for name in ends if ends[name] in joints) for point, joints in above.items()}

    @cached_property
    def lengths(self) -> dict[str, float]:
        """The lengths [m] that this model has, measured on it in the neutral configuration."""
        return measure_lengths(self.robot, self.table)

    def find_spherical(self, segment: str) -> int | None:
        """Find the spherical joint nearest to a segment, which takes what its other joints leave; None: it has none.

        With one every orientation of the segment can be followed.
        """
        return next((joint for joint in reversed(self.chains[segment]) if self.pin.nvs[joint] == 3), None)

    def find_trunk(self, segment: str) -> str | None:
        """Find the segment of the spine that carries a segment, itself if it is one; None: there is none."""
        above: str | None = segment
        while above is not None and not self.table.segments[above].spine:
            above = self.parents[above]
        return above

    @cached_property
    def reaches(self) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Point → link → its part of the way from the root, the same for all lengths (`measure_reaches`)."""
        return measure_reaches(self.robot, self.table, self.pin, self.neutral_rotations)

    @cached_property
    def neutral_rotations(self) -> dict[str, np.ndarray]:
        """`orient_links` with all joints at zero."""
        return self.orient_links(pin.neutral(self.pin))

    def orient_links(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Link → R_WK (3, 3) in a configuration (nq,): segments and points by name, others by that of their joint."""
        m, data = self.pin, self.pin.createData()
        pin.framesForwardKinematics(m, data, q)
        R_WK = {m.names[joint]: np.array(data.oMi[joint].rotation) for joint in range(m.njoints)}
        links = (link for link in (*self.table.points, *self.table.segments) if m.existFrame(link))
        return R_WK | {link: np.array(data.oMf[m.getFrameId(link)].rotation) for link in links}

    @cached_property
    def point_frames(self) -> dict[str, str]:
        """Point → the frame whose origin it is."""
        return {name: point.link for name, point in self.table.points.items()}

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Implausible lengths."""
        (people, covariance, _), diagnostics = compute_population_lengths(self.table), []
        for (name, mean), std in zip(people.items(), np.sqrt(np.diag(covariance)), strict=True):
            low, high = max(0.0, mean - FAR_OFF * std), mean + FAR_OFF * std
            if not low <= self.lengths[name] <= high:
                limits = {"model": self.robot.name, "deviations": FAR_OFF, "shortest": low, "longest": high}
                diagnostics.append(Diagnostic("model-implausible", WARNING, name, self.lengths[name], facts=limits))
        return tuple(diagnostics)

    @cached_property
    def visuals(self) -> list[Visual]:
        """The visuals of all links."""
        return list_visuals(self.robot)

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
                raise BadModel(f"{self.robot.name}: length {name} = {value!r}: above 0 and below 10 m is needed")
        robot = stretch_robot(self.robot, self.table, lengths)
        body = _build_body(robot, self.table, robot.name)
        return replace(body, girdles=self.girdles, personal=self.personal)

    def urdf(self) -> str:
        """This body as the text of a URDF that any tool reads."""
        from lxml import etree

        library = import_yourdfpy()
        as_it_is = library.urdf.filename_handler_null  # of meshes, whose paths `read_urdf` has resolved
        urdf = library.URDF(self.robot, build_scene_graph=False, load_meshes=False, filename_handler=as_it_is)
        return etree.tostring(urdf.write_xml(), pretty_print=True, xml_declaration=True, encoding="utf-8").decode()


def _find_chains(model: pin.Model, table: BodyTable) -> tuple[dict[str, tuple[int, ...]], dict[str, str | None]]:
    """Find `BodyModel.chains` and `BodyModel.parents`."""
    joint_of = {name: model.frames[model.getFrameId(name)].parentJoint for name in table.segments}
    first = {joint: name for name, joint in reversed(joint_of.items())}  # the others on a joint are rigid with that
    chains, parents, between = dict[str, tuple[int, ...]](), dict[str, str | None](), dict[str, list[int]]()
    for name, joint in joint_of.items():
        path = model.supports[joint].tolist()
        above = [other for other in (path[:-1] if first[joint] == name else path) if other in first]
        parents[name] = first[above[-1]] if above else None
        between[name] = path[path.index(above[-1]) + 1 :] if above else path[1:]
    # A joint that moves two segments at once rests.
    times = Counter(joint for joints in between.values() for joint in joints)
    for name in sorted(joint_of, key=lambda name: joint_of[name]):
        free = [j for j in between[name] if times[j] == 1 and "Prismatic" not in model.joints[j].shortname()]
        while not table.segments[name].spine and sum(model.nvs[joint] for joint in free[1:]) >= 3:
            del free[0]
        chains[name] = tuple(free)
    return chains, parents


def load_model(path: str | Path | None = None, lengths: Mapping[str, float] | None = None) -> BodyModel:
    """Read a body model.

    Parameters
    ----------
    path : str or Path, optional
        A URDF, or a table (TOML) that names one, or the name of a body that comes with the package ("whole_body"); None
        for the upper body, a person of 1.75 m. A URDF needs a table beside it, or links with the names of the package's
        segments, of human-gazebo or of the human of example-robot-data.
    lengths : mapping, optional
        Length → [m] to scale the body to; None: as the file has them.

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
    body = load_sensed_model(path)
    return body.with_lengths(lengths) if lengths else body


def load_sensed_model(path: str | Path | None, sensors: Collection[str] = (), where: str = "") -> BodyModel:
    """Read the body of a recording whose sensors have these names; of a URDF without a table a mechanism.

    Its segments are the links that bear the sensors, as they are; a sensor whose name is no link raises `BadSession`,
    whose text begins with `where`. Parameters and errors else as of `load_model`.
    """
    default = Path(load_table().where).with_suffix(".urdf")
    file = Path(path or default)
    if not (file.suffix or file.exists() or len(file.parts) > 1):  # the name of a body of the package
        file = Path(load_table(file.name).where)
    return _load_packaged_body(file) if file.parent == default.parent else _load_body(file, sensors, where)


def _load_body(path: Path, sensors: Collection[str] = (), where: str = "") -> BodyModel:
    """Return the body of a URDF or of a table that names one; a mechanism of the links with sensors where none does."""
    own_table = read_table(path) if path.suffix.lower() == ".toml" else None
    urdf = path if own_table is None else path.parent / own_table.urdf
    robot = read_urdf(urdf)
    tree = parse_tree(robot, str(urdf))
    if own_table is not None:
        for pose, values in own_table.poses.items():
            check_joint_values(robot, values, f"{own_table.where}: poses.{pose}", BadModel)
    table = own_table or find_table(urdf, tree.below)
    if table is None and sensors:  # a mechanism of the links with sensors
        for name in sensors:
            if name not in tree.below:
                raise BadSession(f"{where}: sensors.{name} is no link of {robot.name}; {one_of(tree.below, name, 100)}")
        links = sorted(sensors, key=lambda name: len(tree.path(name)))
        segments = {name: MECHANISM_SEGMENT._replace(link=name, rigid_without_sensor=True) for name in links}
        body = _build_body(robot, BodyTable(robot.name, segments, kind="mechanism", where=str(urdf)), str(urdf))
        if not body.pin.nv:
            raise BadModel(f"{urdf}: no joint moves; a chain of revolute or prismatic joints is needed")
        return body
    if table is None:
        default = load_table()
        lacking = [name for name in default.needed if default.segments[name].link not in tree.below]
        raise BadModel(
            f"{urdf}: no link {', '.join(map(repr, lacking))}; name the segments' links in a table, as docs/models.md "
            f'shows (of a robot with kind = "mechanism"); {one_of(tree.below, most=100)}'
        )
    # Of a table for several URDFs the names of links fit; joints may have others.
    joints = {joint.name for joint in robot.joints}
    table = replace(
        table,
        girdles={name: girdle for name, girdle in table.girdles.items() if joints.issuperset(girdle.joints)},
        poses={name: pose for name, pose in table.poses.items() if joints.issuperset(pose)},
    )
    body = _build_body(*rename_links(robot, table), str(urdf))
    for segment in body.table.needed:
        above = body.parents[segment]
        if above is not None and not body.chains[segment]:
            raise BadModel(f"{table.where}: no joint moves {segment} against {above}; revolute joints are needed there")
    for name, hinge in body.table.hinges.items():
        if body.parents[hinge.moves] != hinge.on:
            raise BadModel(f"{table.where}: hinges.{name} is none: {hinge.moves} does not hang on {hinge.on}")
    if own_table is not None:  # an error where the table does not give its lengths
        stretch_robot(body.robot, body.table, {name: 1.1 * value for name, value in body.lengths.items()})
    return body


_load_packaged_body = lru_cache(_load_body)  # read once; a `BodyModel` does not change


def _build_body(robot: Any, table: BodyTable, where: str) -> BodyModel:
    model, axes = build(robot, where, spherical=not table.is_mechanism)
    return BodyModel(model, robot, table, axes, *_find_chains(model, table))
