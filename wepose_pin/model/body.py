"""`BodyModel`, and the function that loads one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import pinocchio as pin

from ..arguments import check_arguments
from ..assets import asset
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadModel, MissingFile, one_of
from ..subject import population_subject
from . import lengths as _lengths
from . import visuals as _visuals
from .chains import chains
from .table import MOST_LINKS, NEEDED, LinkTable, find_table, format_closest_links, read_table, rename_links, table_from
from .tree import AxisLimits, build, find_impossible_inertia, parse_tree
from .visuals import Visual

DEFAULT_URDF = "upper_body.urdf"
# Standard deviations off the mean of adults (calibration/anthropometry.toml), above which a length is implausible.
FAR_OFF = 5.0
# So is a mass [kg] beyond ten standard deviations above the mean of men, 85.5 ± 14.2 kg (ANSUR II), or below an upper
# body's share (head, arms and trunk: 68 %, Winter 2009, table 4.1) of five below the mean of women, 67.8 ± 11.0 kg.
HEAVIEST, LIGHTEST = 230.0, 8.0


@dataclass(frozen=True)
class BodyModel:
    """A body of known lengths.

    Parameters
    ----------
    pin : the Pinocchio model; one frame a link, of the link's name. Its universe is W
    robot : the parsed URDF it was built from, already with its lengths and our names (yourdfpy)
    joints : child link of a spherical joint → its Pinocchio joint
    limits : the same → what its three axes may do; without an entry for a `floating` joint
    """

    pin: pin.Model
    robot: Any
    joints: Mapping[str, int]
    limits: Mapping[str, AxisLimits]

    @property
    def lengths(self) -> dict[str, float]:
        """The lengths [m] that this model has, measured on it in the neutral configuration."""
        return _lengths.lengths(self.robot)

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Implausible lengths, mass or moments of inertia, and a trunk that cannot move."""
        name, prior = self.robot.name, population_subject()
        diagnostics = []
        for length, value in self.lengths.items():
            mean, std = prior.lengths[length], prior.std(length)
            if abs(value - mean) > FAR_OFF * std:
                plausible = {"shortest": max(0.0, mean - FAR_OFF * std), "longest": mean + FAR_OFF * std}
                facts: dict[str, float | str] = {"model": name, "deviations": FAR_OFF, **plausible}
                diagnostics.append(Diagnostic("model-length-implausible", WARNING, length, value, facts=facts))
        mass = sum(inertia.mass for inertia in self.pin.inertias)
        if mass and not LIGHTEST <= mass <= HEAVIEST:
            facts = {"lightest": LIGHTEST, "heaviest": HEAVIEST}
            diagnostics.append(Diagnostic("model-mass-implausible", WARNING, name, mass, facts=facts))
        impossible = find_impossible_inertia(self.robot)
        if impossible:
            facts = {"links": ", ".join(impossible)}
            diagnostics.append(Diagnostic("model-inertia-impossible", WARNING, name, facts=facts))
        torso = chains(self.pin).get("torso")
        if torso is not None and not torso.joints:
            rigid = ", ".join(joint.name for joint in parse_tree(self.robot, name).path("torso"))
            diagnostics.append(
                Diagnostic("model-torso-fixed", WARNING, name, facts={"joints": rigid or "the root is the torso"})
            )
        return tuple(diagnostics)

    @property
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
        return _body(_lengths.with_lengths(self.robot, lengths), self.robot.name)

    def urdf(self) -> str:
        """This body as the text of a URDF that any tool reads."""
        import yourdfpy
        from lxml import etree

        tree = yourdfpy.URDF(self.robot, build_scene_graph=False, load_meshes=False).write_xml()
        return etree.tostring(tree, pretty_print=True, xml_declaration=True, encoding="utf-8").decode()


def load_model(
    path: str | Path | None = None,
    lengths: Mapping[str, float] | None = None,
    *,
    segments: Mapping[str, Any] | None = None,
    points: Mapping[str, Any] | None = None,
    up: str = "+z",
    forward: str = "+x",
    root: str | Sequence[str] | None = None,
) -> BodyModel:
    """Read a body, with other lengths [m] where given.

    Parameters
    ----------
    path
        A URDF, or a table (TOML) that names one and its links; None for ours, a person of 1.75 m.
    segments
        Segment → its link; or → ``{"link": …, "up": "+z", "forward": "+x"}`` with the link's axes in the N-pose, where
        they do not follow from the arm's direction at zero. None: a ``model.toml`` beside the URDF, the segments' own
        names, or a table of ours that fits (human-gazebo, the human of example-robot-data).
    points
        Point → its link, or ``{"link": …, "at": [x, y, z]}`` [m], where it is not the origin of the segment's link.
    up, forward
        Axes of the URDF's root link while all joints are at zero.
    root
        Link at whose origin W begins, or the two hips, midway between which it does; None: the URDF's root.

    Raises
    ------
    MissingFile, BadModel
        Not there; not a URDF; no tree with one root; a table that names what is not there; no links for the segments;
        an arm without a joint that could move it.
    """
    check_arguments(load_model, locals())
    path = Path(path) if path is not None else asset("urdf", DEFAULT_URDF)
    table: LinkTable | None = None
    if path.suffix.lower() == ".toml":
        table, urdf = read_table(path)
        if urdf is None:
            raise BadModel(f'{path}: names no URDF; urdf = "body.urdf" is wanted, a file beside this one')
        path = urdf
    if segments is not None:
        entries = {"segments": segments, "points": points or {}, "up": up, "forward": forward, "root": root}
        table = table_from(entries, str(path))
    elif points is not None or root is not None or (up, forward) != ("+z", "+x"):
        raise BadModel(f"{path}: points, up, forward and root are part of a table; give segments with them")
    robot = read_urdf(path)
    tree = parse_tree(robot, str(path))
    table = table or find_table(path, tree.below)
    if table is not None:
        robot = rename_links(robot, table)
    lacking = [link for link in NEEDED if link not in parse_tree(robot, str(path)).below]
    if lacking:
        raise BadModel(
            f"{path}: no link {format_closest_links(lacking, tree.below)}; name the segments' links in a table, as "
            f"docs/models.md shows; {one_of(tree.below, most=MOST_LINKS)}"
        )
    body = _body(robot, str(path))
    _check_arms(body, str(path))
    return body.with_lengths(lengths) if lengths else body


def read_urdf(path: Path) -> Any:
    """The URDF as yourdfpy has it.

    Raises
    ------
    MissingFile, BadModel
        Not there; not a URDF.
    """
    import yourdfpy

    if not path.is_file():
        raise MissingFile(f"{path}: no such file; a URDF is wanted here")
    try:
        # yourdfpy's parser mends broken XML in silence: half a body would be read as a body. And it reads what entities
        # name, on disk too.
        _check_xml(path)
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise BadModel(f"{path}: is no complete XML file, as a URDF is: {error}") from error
    try:
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy and lxml raise many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{path}: cannot be read as a URDF: {reason}") from error
    materials = [visual.material for link in robot.links for visual in link.visuals if visual.material is not None]
    for material in [*robot.materials, *materials]:
        if material.texture is not None and material.texture.filename is None:
            material.texture = None  # <texture/>: yourdfpy cannot write what it read there
    return robot


def _check_arms(body: BodyModel, where: str) -> None:
    """Raise an error on arm segments that no joint moves against the segment above, or that no joint could follow."""
    links, tree = chains(body.pin), parse_tree(body.robot, where)
    rigid = []
    for segment in NEEDED[1:]:
        if not links[segment].joints:
            above = segment.replace("forearm", "upper_arm") if segment.endswith("forearm") else "torso"
            shared = {joint.name for joint in tree.path(above)}
            between = [f"'{joint.name}' ({joint.type})" for joint in tree.path(segment) if joint.name not in shared]
            rigid.append(f"{segment} against {above} (between them: {', '.join(between) or 'nothing'})")
    if rigid:
        raise BadModel(
            f"{where}: no joint moves {'; '.join(rigid)}: the arm could not follow a person's; it needs revolute "
            f"joints there"
        )


def _check_xml(path: Path) -> None:
    def refuse(name: str, *_: object) -> None:
        raise BadModel(f"{path}: declares an entity, '{name}', which no URDF needs; write out what it stands for")

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse
    with path.open("rb") as file:
        parser.ParseFile(file)


def _body(robot: Any, where: str) -> BodyModel:
    built = build(robot, where)
    return BodyModel(built.pin, robot, built.joints, built.limits)
