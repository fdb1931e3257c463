"""The body: a URDF read into a `pin.Model` whose triples of revolute joints are spherical joints, with link lengths.

URDF knows no spherical joint (Pinocchio rejects `type="spherical"`), so a body model spells each as three revolute
joints with intersecting orthogonal axes and massless links between them. They are joined here into one
`pin.JointModelSpherical`, whose frame at zero is that of the link it moves; a `floating` joint likewise, since W does
not travel. Other joints stay as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from .assets import asset
from .errors import BadModel, MissingFile, one_of
from .recording import SEGMENTS
from .subject import LENGTHS

DEFAULT_URDF = "upper_body.urdf"

# A point is the origin of a link; the link is moved by the joint at that point.
POINTS = {
    f"{side}_{point}": f"{side}_{link}"
    for side in ("left", "right")
    for point, link in (("shoulder", "upper_arm"), ("elbow", "forearm"), ("wrist", "hand"), ("hand", "palm"))
}
_TURNS = ("revolute", "continuous")
_PARALLEL_TOLERANCE = 1e-6
_MEET_TOLERANCE = 1e-9  # [m]


class Visual(NamedTuple):
    """What one link looks like; sizes as in URDF."""

    link: str
    kind: str  # "box" | "cylinder" | "sphere" | "mesh"
    size: tuple[float, ...]  # box: x, y, z; cylinder: radius, length along z; sphere: radius [m]; mesh: scale x, y, z
    quat_LV: np.ndarray  # (4,) xyzw, visual to link
    p_LV: np.ndarray  # (3,) [m]
    rgba: tuple[float, float, float, float]
    file: str | None = None  # of a mesh, as the URDF names it


class AxisLimits(NamedTuple):
    """What the three axes that were joined into a spherical joint may do, in their order."""

    axes: np.ndarray  # (3, 3), a row an axis, in the joint's frame at zero
    lower: np.ndarray  # (3,) [rad]
    upper: np.ndarray  # (3,) [rad]


@dataclass(frozen=True)
class BodyModel:
    """A body of known lengths.

    Parameters
    ----------
    pin : the Pinocchio model; one frame a link, of the link's name
    robot : the parsed URDF it was built from, already with its lengths (yourdfpy)
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
        data = self.pin.createData()
        pin.framesForwardKinematics(self.pin, data, pin.neutral(self.pin))
        at = {frame.name: data.oMf[k].translation.copy() for k, frame in enumerate(self.pin.frames)}
        return _measured({point: at[link] for point, link in POINTS.items() if link in at}, at.get("torso"))

    @property
    def visuals(self) -> list[Visual]:
        """What all links look like."""
        return _visuals(self.robot)

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
            if not value > 0.0:
                raise BadModel(f"{self.robot.name}: length {name} = {value!r} must be greater than 0 m")
        return _build(_stretched(self.robot, {name: value / own[name] for name, value in lengths.items()}))

    def urdf(self) -> str:
        """This body as the text of a URDF that any tool reads."""
        import yourdfpy
        from lxml import etree

        tree = yourdfpy.URDF(self.robot, build_scene_graph=False, load_meshes=False).write_xml()
        return etree.tostring(tree, pretty_print=True, xml_declaration=True, encoding="utf-8").decode()


def load_model(path: str | Path | None = None, lengths: Mapping[str, float] | None = None) -> BodyModel:
    """Read a body's URDF; None for ours (a person of 1.75 m), with other lengths [m] where given.

    Raises
    ------
    MissingFile, BadModel
        Not there; not a URDF; no tree with one root; without the segments' links.
    """
    import yourdfpy

    path = Path(path) if path is not None else asset("urdf", DEFAULT_URDF)
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; a URDF is wanted here")
    try:
        urdf = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # yourdfpy and lxml raise many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{path}: cannot be read as a URDF: {reason}") from error
    body = _build(urdf.robot, str(path))
    lacking = [link for link in SEGMENTS[:5] if link not in {frame.name for frame in body.pin.frames}]
    if lacking:
        raise BadModel(f"{path}: no link '{lacking[0]}'; a body model names its links after the segments")
    return body.with_lengths(lengths) if lengths else body


# Building ---------------------------------------------------------------------------------------------------------


def _build(robot: Any, where: str = "") -> BodyModel:
    where = where or robot.name
    below: dict[str, list[Any]] = {link.name: [] for link in robot.links}
    moved_by: dict[str, str] = {}
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in below:
                raise BadModel(f"{where}: joint '{joint.name}' names a link '{link}' that is not there")
        if joint.child in moved_by:
            raise BadModel(
                f"{where}: link '{joint.child}' hangs on two joints, '{moved_by[joint.child]}' and '{joint.name}'; "
                f"a body is a tree"
            )
        moved_by[joint.child] = joint.name
        below[joint.parent].append(joint)
    roots = [name for name in below if name not in moved_by]
    if len(roots) != 1:
        found = ", ".join(roots) if roots else "none"
        raise BadModel(f"{where}: {len(roots)} links without a joint above them ({found}); a body has one root")
    inertials = {link.name: link.inertial for link in robot.links}

    model = pin.Model()
    model.name = robot.name or "body"
    joints: dict[str, int] = {}
    limits: dict[str, AxisLimits] = {}
    # (link, Pinocchio joint it is fixed to, its placement there)
    open_links: list[tuple[str, int, pin.SE3]] = [(roots[0], 0, pin.SE3.Identity())]
    while open_links:
        link, parent, M_JL = open_links.pop(0)
        model.addFrame(pin.Frame(link, parent, 0, M_JL, pin.FrameType.BODY), False)
        inertial = inertials[link]
        if inertial is not None and inertial.mass:
            model.appendBodyToJoint(parent, _inertia(inertial), M_JL)
        for first in below[link]:
            M_Jc = M_JL * _se3(first.origin)
            triple = _triple(first, below, inertials)
            if first.type == "fixed":
                open_links.append((first.child, parent, M_Jc))
                continue
            if triple is not None or first.type == "floating":
                child = triple[-1].child if triple else first.child
                for joint in (triple or ())[1:]:
                    M_Jc = M_Jc * _se3(joint.origin)
                added = model.addJoint(parent, pin.JointModelSpherical(), M_Jc, child)
                joints[child] = added
                if triple is not None:
                    limits[child] = _limits(triple)
            else:
                child = first.child
                added = model.addJoint(parent, _single(first, where), M_Jc, first.name)
            open_links.append((child, added, pin.SE3.Identity()))
    return BodyModel(pin=model, robot=robot, joints=joints, limits=limits)


def _triple(first: Any, below: Mapping[str, list[Any]], inertials: Mapping[str, Any]) -> tuple[Any, Any, Any] | None:
    """The three revolute joints that begin with `first` and together are a spherical joint, if they are."""
    chain = [first]
    while len(chain) < 3:
        link = chain[-1].child
        if chain[-1].type not in _TURNS or len(below[link]) != 1:
            return None
        if inertials[link] is not None and inertials[link].mass:
            return None
        chain.append(below[link][0])
    if chain[-1].type not in _TURNS or any(joint.mimic is not None for joint in chain):
        return None
    if any(np.linalg.norm(_se3(joint.origin).translation) > _MEET_TOLERANCE for joint in chain[1:]):
        return None
    axes = _axes(chain)
    if np.abs(axes @ axes.T - np.eye(3)).max() > _PARALLEL_TOLERANCE:
        return None
    return chain[0], chain[1], chain[2]


def _axes(chain: Any) -> np.ndarray:
    """Axes (3, 3), a row each, in the frame of the last joint's child, all joints at zero."""
    rows = []
    for k, joint in enumerate(chain):
        axis = np.asarray(joint.axis if joint.axis is not None else (1.0, 0.0, 0.0), dtype=float)
        for later in chain[k + 1 :]:
            axis = _se3(later.origin).rotation.T @ axis
        rows.append(axis / np.linalg.norm(axis))
    return np.array(rows)


def _limits(triple: tuple[Any, Any, Any]) -> AxisLimits:
    low, high = [], []
    for joint in triple:
        bounded = joint.type == "revolute" and joint.limit is not None
        low.append(joint.limit.lower if bounded else -np.pi)
        high.append(joint.limit.upper if bounded else np.pi)
    return AxisLimits(_axes(triple), np.array(low, dtype=float), np.array(high, dtype=float))


def _single(joint: Any, where: str) -> Any:
    axis = np.asarray(joint.axis if joint.axis is not None else (1.0, 0.0, 0.0), dtype=float)
    if np.linalg.norm(axis) < 1e-9:
        raise BadModel(f"{where}: joint '{joint.name}' has a zero axis")
    axis = axis / np.linalg.norm(axis)
    if joint.type == "revolute":
        return pin.JointModelRevoluteUnaligned(axis)
    if joint.type == "continuous":
        return pin.JointModelRevoluteUnboundedUnaligned(axis)
    if joint.type == "prismatic":
        return pin.JointModelPrismaticUnaligned(axis)
    raise BadModel(
        f"{where}: joint '{joint.name}' is of type '{joint.type}'; known are fixed, revolute, continuous, prismatic, "
        f"floating, and spherical as three revolute joints"
    )


def _se3(origin: np.ndarray | None) -> pin.SE3:
    return pin.SE3.Identity() if origin is None else pin.SE3(origin[:3, :3], origin[:3, 3])


def _inertia(inertial: Any) -> pin.Inertia:
    placement = _se3(inertial.origin)
    inertia = inertial.inertia if inertial.inertia is not None else np.zeros((3, 3))
    return pin.Inertia(inertial.mass, placement.translation, placement.rotation @ inertia @ placement.rotation.T)


# Lengths ----------------------------------------------------------------------------------------------------------


def _measured(at: Mapping[str, np.ndarray], torso: np.ndarray | None) -> dict[str, float]:
    """Lengths [m] between points in the neutral configuration."""
    ends = {"shoulder_width": ("left_shoulder", "right_shoulder")}
    for side in ("left", "right"):
        ends[f"{side}_upper_arm"] = (f"{side}_shoulder", f"{side}_elbow")
        ends[f"{side}_forearm"] = (f"{side}_elbow", f"{side}_wrist")
        ends[f"{side}_hand"] = (f"{side}_wrist", f"{side}_hand")
    found = {name: float(np.linalg.norm(at[b] - at[a])) for name, (a, b) in ends.items() if a in at and b in at}
    if torso is not None and "shoulder_width" in found:
        found["trunk"] = float(np.linalg.norm((at["left_shoulder"] + at["right_shoulder"]) / 2.0 - torso))
    return {name: found[name] for name in LENGTHS if name in found}


def _stretched(robot: Any, ratio: Mapping[str, float]) -> Any:
    """A copy of the robot whose segments are stretched: the torso up and sideways, the arm along z."""
    robot = copy.deepcopy(robot)
    stretch = {"torso": np.array([1.0, ratio.get("shoulder_width", 1.0), ratio.get("trunk", 1.0)])}
    for side in ("left", "right"):
        for part in ("upper_arm", "forearm", "hand"):
            stretch[f"{side}_{part}"] = np.array([1.0, 1.0, ratio.get(f"{side}_{part}", 1.0)])
    for joint in robot.joints:
        if joint.parent in stretch and joint.origin is not None:
            joint.origin[:3, 3] *= stretch[joint.parent]
    for link in robot.links:
        if link.name in stretch:
            _stretch_link(link, stretch[link.name])
    return robot


def _stretch_link(link: Any, s: np.ndarray) -> None:
    for visual in [*link.visuals, *link.collisions]:
        if visual.origin is None:
            visual.origin = np.eye(4)
        along = np.linalg.norm(s[:, None] * visual.origin[:3, :3], axis=0)  # of the visual's own axes
        visual.origin[:3, 3] *= s
        geometry = visual.geometry
        if geometry.box is not None:
            geometry.box.size = np.asarray(geometry.box.size) * along
        elif geometry.cylinder is not None:
            geometry.cylinder.length *= float(along[2])
        elif geometry.mesh is not None:
            scale = geometry.mesh.scale
            geometry.mesh.scale = (np.ones(3) if scale is None else np.asarray(scale) * np.ones(3)) * along
    inertial = link.inertial
    if inertial is None or not inertial.mass:
        return
    if inertial.origin is None:
        inertial.origin = np.eye(4)
    R = inertial.origin[:3, :3]
    inertial.origin[:3, 3] *= s
    inertial.mass *= float(np.prod(s))
    if inertial.inertia is not None:
        # The second moments Σ = ½ tr(I) 1 − I stretch as D Σ D; mass goes with the volume.
        inertia = R @ inertial.inertia @ R.T
        second = (0.5 * np.trace(inertia) * np.eye(3) - inertia) * np.outer(s, s) * np.prod(s)
        inertial.inertia = R.T @ (np.trace(second) * np.eye(3) - second) @ R


def _visuals(robot: Any) -> list[Visual]:
    colours = {m.name: m.color.rgba for m in robot.materials if m.color is not None}
    found = []
    for link in robot.links:
        for visual in link.visuals:
            geometry, origin = visual.geometry, np.eye(4) if visual.origin is None else visual.origin
            size: tuple[float, ...]
            file = None
            if geometry.box is not None:
                kind, size = "box", tuple(float(v) for v in geometry.box.size)
            elif geometry.cylinder is not None:
                kind, size = "cylinder", (float(geometry.cylinder.radius), float(geometry.cylinder.length))
            elif geometry.sphere is not None:
                kind, size = "sphere", (float(geometry.sphere.radius),)
            elif geometry.mesh is not None:
                scale = np.ones(3) if geometry.mesh.scale is None else np.asarray(geometry.mesh.scale) * np.ones(3)
                kind, size, file = "mesh", tuple(float(v) for v in scale), geometry.mesh.filename
            else:
                continue
            rgba = np.array([0.7, 0.7, 0.7, 1.0])
            if visual.material is not None:
                own = visual.material.color
                rgba = own.rgba if own is not None else colours.get(visual.material.name, rgba)
            r, g, b, a = (float(v) for v in rgba)
            quat = Rotation.from_matrix(origin[:3, :3]).as_quat()
            found.append(Visual(link.name, kind, size, quat, origin[:3, 3].copy(), (r, g, b, a), file))
    return found
