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
from ..errors import BadModel, MissingFile, one_of
from . import lengths as _lengths
from . import visuals as _visuals
from .chains import chains
from .table import NEEDED, LinkTable, find_table, named, read_table, table_from
from .tree import AxisLimits, build, tree_of
from .visuals import Visual

DEFAULT_URDF = "upper_body.urdf"


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
    def visuals(self) -> list[Visual]:
        """What all links look like."""
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
        Not there; not a URDF; no tree with one root; a table that names what is not there; no links for the segments.
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
        given = {"segments": segments, "points": points or {}, "up": up, "forward": forward, "root": root}
        table = table_from(given, str(path))
    elif points is not None or root is not None or (up, forward) != ("+z", "+x"):
        raise BadModel(f"{path}: points, up, forward and root are part of a table; give segments with them")
    robot = read_urdf(path)
    tree = tree_of(robot, str(path))
    table = table or find_table(path, tree.below)
    if table is not None:
        robot = named(robot, table)
    lacking = [link for link in NEEDED if link not in tree_of(robot, str(path)).below]
    if lacking:
        raise BadModel(
            f"{path}: no link '{lacking[0]}'; name the segments' links in a table, as docs/models.md shows; "
            f"{one_of(tree.below, lacking[0])}"
        )
    body = _body(robot, str(path))
    chains(body.pin)  # raises what no segment could follow
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
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: of an encoding that nobody knows
        raise BadModel(f"{path}: is no whole XML file, as a URDF is: {error}") from error
    try:
        return yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy and lxml raise many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{path}: cannot be read as a URDF: {reason}") from error


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
