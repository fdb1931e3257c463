"""An OpenSim model (.osim, document version 40000 and later): its joints measured and scaled by its XML alone.

Source: opensim-core, `PhysicalOffsetFrame`, `Body`, `CustomJoint` and `Mesh` (their properties and `extendScale`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ..errors import BadData, MissingFile
from .rajagopal import JOINTS, Joint

if TYPE_CHECKING:
    from lxml.etree import _Element as Element
    from lxml.etree import _ElementTree as ElementTree

_OLDEST = 40000  # document version: since OpenSim 4.0 joints are in a set of their own
_AXES_OFF = np.radians(2.0)  # between an axis of the model and Rajagopal's
_UPRIGHT_OFF = np.radians(0.5)  # of a body at zero of all coordinates
_OPTIONAL = ("patella_r", "patella_l")  # bodies that a model may lack
_AXIS_PROPERTIES = ("coordinates", "axis")
_X, _Y, _Z = np.eye(3)
_LEFT_OUT = ("ForceSet", "ControllerSet", "ProbeSet", "ContactGeometrySet")


class Span(NamedTuple):
    """A length of the subject in the model: between two groups of joint centres, named by the body that each moves."""

    start: tuple[str, ...]
    end: tuple[str, ...]  # empty: the mass centre of the first
    bodies: tuple[str, ...]  # those that scale
    axes: str = "xyz"


class Marker(NamedTuple):
    """Where a marker is: at the joint that moves a body, or at the body's mass centre."""

    body: str
    at_mass_centre: bool = False


class Range(NamedTuple):
    """What a coordinate [rad] is by default, and from where to where it goes."""

    default: float
    low: float
    high: float


class _Frame(NamedTuple):
    """One end of a joint: the body it sits on, where, and the element that says so."""

    body: str
    translation: np.ndarray  # (3,) [m]
    rotation: Rotation
    element: Element | None


class OsimModel:
    """A model's XML, and the parts of it that hold lengths.

    Parameters
    ----------
    path : the file
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.document = _parse(path)
        self.root = self._find_root()
        self.bodies = {element.get("name", ""): element for element in self._objects("BodySet")}
        self.joints = {self._frame(joint, "child").body: joint for joint in self._objects("JointSet")}
        self._check_numbers()

    def text(self) -> bytes:
        from lxml import etree

        return bytes(etree.tostring(self.document, xml_declaration=True, encoding="UTF-8")) + b"\n"

    # What is there ---------------------------------------------------------------------------------------------------

    def _find_root(self) -> Element:
        top = self.document.getroot()
        model = top.find("Model") if top.tag == "OpenSimDocument" else None
        if model is None:
            kind = f"<{top.tag}>" if top.tag != "OpenSimDocument" else "an OpenSimDocument without <Model>"
            raise BadData(f"{self.path}: is XML, but no OpenSim model: it is {kind}")
        version = top.get("Version", "")
        if not version.isdecimal() or int(version) < _OLDEST:
            raise BadData(
                f"{self.path}: document version {version or 'missing'}; {_OLDEST} or later is needed: open the model "
                f"in OpenSim 4 and save it"
            )
        unit = (model.findtext("length_units") or "meters").strip().lower()
        if unit not in ("meters", "m"):
            raise BadData(f"{self.path}: length_units is '{unit}'; a model in meters is needed")
        return model

    def _objects(self, name: str) -> list[Element]:
        objects = self.root.find(f"{name}/objects")
        children = [] if objects is None else [each for each in objects if isinstance(each.tag, str)]
        if not children:
            raise BadData(f"{self.path}: no {name} in it, or an empty one; is it a whole model?")
        return children

    def _frame(self, joint: Element, end: str) -> _Frame:
        """The parent or the child frame of a joint."""
        label = joint.get("name", "")
        socket = (joint.findtext(f"socket_{end}_frame") or "").strip()
        frame = next(
            (each for each in joint.iterfind("frames/*") if each.get("name") == socket.rpartition("/")[2]), None
        )
        at = f"{self.path}: {joint.tag} {label}"
        place, zero = socket, "0 0 0"
        translation = rotation = np.zeros(3)
        if frame is not None:
            place = (frame.findtext("socket_parent") or "").strip()
            translation = _numbers(
                f"{at}, frame {frame.get('name')}: translation", frame.findtext("translation", zero), 3
            )
            rotation = _numbers(f"{at}, frame {frame.get('name')}: orientation", frame.findtext("orientation", zero), 3)
        body = place.rpartition("/")[2]
        if body != "ground" and body not in self.bodies:
            raise BadData(f"{at}: its {end} frame '{socket}' is on '{place}', which is no body of the model")
        return _Frame(body, translation, Rotation.from_euler("XYZ", rotation), frame)

    def _check_numbers(self) -> None:
        """OpenSim takes text and NaN in numbers for nothing."""
        for name, body in self.bodies.items():
            at = f"{self.path}: Body {name}"
            [mass] = _numbers(f"{at}: mass", body.findtext("mass", "0"), 1)
            if mass < 0.0:
                raise BadData(f"{at}: mass is {mass:g} kg; it is at least 0")
            _numbers(f"{at}: mass_center", body.findtext("mass_center", "0 0 0"), 3)
            _numbers(f"{at}: inertia", body.findtext("inertia", "0 0 0 0 0 0"), 6)
        for joint in self.joints.values():
            self._frame(joint, "parent")

    def check(self, spans: Collection[Span], measured: Collection[str]) -> None:
        """Raise `BadData` where a body, joint or coordinate that is needed is not there, or not as in Rajagopal's."""
        needed = {body: None for span in spans for body in (*span.start, *span.end, *span.bodies)}
        needed |= dict.fromkeys(measured)
        for body in needed:
            if body not in _OPTIONAL:
                self._check_body(body)
        for body, joint in JOINTS.items():
            if body in needed or any(self._is_below(each, body) for each in needed):
                self._check_joint(body, joint)

    def _check_body(self, body: str) -> None:
        if body not in self.bodies:
            raise BadData(
                f"{self.path}: no Body '{body}', which the subject's motion or lengths need; a full-body model with "
                f"the bodies of Rajagopal's is needed; it has: {', '.join(self.bodies)}"
            )
        if body not in self.joints:
            raise BadData(f"{self.path}: no joint moves Body '{body}'; a full-body model as Rajagopal's is needed")

    def _is_below(self, body: str, other: str) -> bool:
        return body in JOINTS and other in self._path(body)

    def _path(self, body: str) -> Iterator[str]:
        """The bodies from the ground to this one, itself the first."""
        seen: set[str] = set()
        while body != "ground":
            if body in seen:
                raise BadData(f"{self.path}: the joints of Body '{body}' lead back to it")
            seen.add(body)
            yield body
            self._check_body(body)
            body = self._frame(self.joints[body], "parent").body

    def _check_joint(self, body: str, wanted: Joint) -> None:
        self._check_body(body)
        element = self.joints[body]
        at = f"{self.path}: {element.tag} {element.get('name')}"
        parent = self._frame(element, "parent")
        if parent.body != wanted.parent:
            raise BadData(f"{at}: Body '{body}' hangs on '{parent.body}'; on '{wanted.parent}' it has to")
        rotation, _ = self._joint_at_zero(body)
        if rotation.magnitude() > _UPRIGHT_OFF:
            raise BadData(
                f"{at}: turns '{body}' by {np.degrees(rotation.magnitude()):.3g}° at zero of its coordinates; all "
                f"bodies have to be parallel to the ground there, as in Rajagopal's model"
            )
        axes = self._axes(element, parent.rotation)
        for coordinate, axis in zip(wanted.coordinates, wanted.axes, strict=True):
            if coordinate not in axes:
                has = ", ".join(axes) or "none"
                raise BadData(f"{at}: no coordinate '{coordinate}' that turns '{body}'; it has: {has}")
            off = float(np.arccos(np.clip(axes[coordinate] @ axis / np.linalg.norm(axis), -1.0, 1.0)))
            if off > _AXES_OFF:
                raise BadData(
                    f"{at}: the axis of '{coordinate}' is {np.degrees(off):.3g}° off that of Rajagopal's model, of "
                    f"which the angles are; at most {np.degrees(_AXES_OFF):.3g}° are accepted"
                )
        order = [name for name in axes if name in wanted.coordinates]
        if order != list(wanted.coordinates):
            raise BadData(
                f"{at}: turns by {', '.join(order)}; by {', '.join(wanted.coordinates)} in this order it has to"
            )

    def _axes(self, joint: Element, rotation: Rotation) -> dict[str, np.ndarray]:
        """Rotational coordinate → axis in the parent body, in their order; more than one coordinate an axis is none."""
        if joint.tag == "CustomJoint":
            axes = {}
            for k in (1, 2, 3):
                element = joint.find(f"SpatialTransform/TransformAxis[@name='rotation{k}']")
                if element is not None and (names := (element.findtext("coordinates") or "").split()):
                    slope = self._slope(joint, element)
                    axes[names[0]] = rotation.apply(slope * self._axis(joint, element))
            return axes
        names = [each.get("name", "") for each in joint.iterfind("coordinates/Coordinate")]
        columns = {"PinJoint": (_Z,), "UniversalJoint": (_X, _Y)}.get(joint.tag, ())
        return {name: rotation.apply(axis) for name, axis in zip(names, columns, strict=False)}

    def _axis(self, joint: Element, element: Element) -> np.ndarray:
        at = f"{self.path}: {joint.tag} {joint.get('name')}: axis of {element.get('name')}"
        axis = _numbers(at, element.findtext("axis", ""), 3)
        if not np.linalg.norm(axis) > 1e-6:
            raise BadData(f"{at} has no direction")
        return axis / np.linalg.norm(axis)

    def _slope(self, joint: Element, element: Element) -> float:
        """1 or −1 by which way a rotation's function goes."""
        return 1.0 if self._value(joint, element, 1e-3) >= self._value(joint, element, -1e-3) else -1.0

    def _value(self, joint: Element, element: Element, coordinate: float = 0.0) -> float:
        """The value of a TransformAxis's function."""
        function = next(
            (each for each in element if isinstance(each.tag, str) and each.tag not in _AXIS_PROPERTIES), None
        )
        return 0.0 if function is None else self._function(joint, function, coordinate)

    def _function(self, joint: Element, function: Element, x: float) -> float:
        at = f"{self.path}: {joint.tag} {joint.get('name')}: {function.tag}"
        if function.tag == "function":  # a wrapper of OpenSim's
            function = next(each for each in function if isinstance(each.tag, str))
            return self._function(joint, function, x)
        if function.tag == "Constant":
            return float(_numbers(at, function.findtext("value", "0"), 1)[0])
        if function.tag == "LinearFunction":
            return float(np.polyval(_numbers(at, function.findtext("coefficients", "1 0"), 2), x))
        if function.tag == "PolynomialFunction":
            return float(np.polyval(_numbers(at, function.findtext("coefficients", "0")), x))
        if function.tag == "MultiplierFunction":
            [scale] = _numbers(at, function.findtext("scale", "1"), 1)
            inner = next((each for each in function.iterfind("function/*") if isinstance(each.tag, str)), None)
            return 0.0 if inner is None else float(scale) * self._function(joint, inner, x)
        if function.tag in ("SimmSpline", "NaturalCubicSpline", "PiecewiseLinearFunction"):
            knots, values = (_numbers(at, function.findtext(name, "")) for name in "xy")
            if len(knots) < 2 or len(knots) != len(values) or not (np.diff(knots) > 0.0).all():
                raise BadData(f"{at}: {len(knots)} x and {len(values)} y; as many of each are needed, x rising")
            if function.tag == "PiecewiseLinearFunction":
                return float(np.interp(x, knots, values))
            return float(CubicSpline(knots, values, bc_type="natural")(x))
        raise BadData(f"{at}: is a function that is not known here; the joint cannot be measured")

    # Lengths ---------------------------------------------------------------------------------------------------------

    def _joint_at_zero(self, body: str) -> tuple[Rotation, np.ndarray]:
        """Rotation and place (3,) [m] of a body in its parent, at zero of all coordinates."""
        joint = self.joints[body]
        parent, child = self._frame(joint, "parent"), self._frame(joint, "child")
        turn, shift = Rotation.identity(), np.zeros(3)
        if joint.tag == "CustomJoint":
            for k in (1, 2, 3):
                for kind in ("rotation", "translation"):
                    element = joint.find(f"SpatialTransform/TransformAxis[@name='{kind}{k}']")
                    value = 0.0 if element is None else self._value(joint, element)
                    if value == 0.0 or element is None:
                        continue
                    if kind == "rotation":
                        turn = turn * Rotation.from_rotvec(value * self._axis(joint, element))
                    else:
                        shift = shift + value * self._axis(joint, element)
        rotation = parent.rotation * turn * child.rotation.inv()
        return rotation, parent.translation + parent.rotation.apply(shift) - rotation.apply(child.translation)

    def _pose(self, body: str) -> tuple[Rotation, np.ndarray]:
        """Rotation and place (3,) [m] of a body in ground, at zero of all coordinates."""
        rotation, place = Rotation.identity(), np.zeros(3)
        for each in reversed(list(self._path(body))):
            in_parent, at = self._joint_at_zero(each)
            rotation, place = rotation * in_parent, place + rotation.apply(at)
        return rotation, place

    def _joint_centre(self, body: str) -> np.ndarray:
        """The centre (3,) [m] in ground of the joint that moves a body: the origin of its frame on that body."""
        rotation, place = self._pose(body)
        return np.asarray(place + rotation.apply(self._frame(self.joints[body], "child").translation))

    def _mass_centre(self, body: str) -> np.ndarray:
        rotation, place = self._pose(body)
        return np.asarray(place + rotation.apply(_numbers(body, self.bodies[body].findtext("mass_center", "0 0 0"), 3)))

    def measure(self, span: Span) -> float:
        """A length [m] of the model."""
        start = np.mean([self._joint_centre(body) for body in span.start], axis=0)
        end = [self._joint_centre(body) for body in span.end] or [self._mass_centre(span.start[0])]
        length = float(np.linalg.norm(np.mean(end, axis=0) - start))
        if length < 1e-4:
            raise BadData(f"{self.path}: the joints of {' and '.join(span.start)} and what follows lie in one place")
        return length

    def scale_body(self, body: str, factor: np.ndarray) -> None:
        """Multiply all that is fixed to a body by a factor (3,) an axis."""
        element = self.bodies.get(body)
        if element is None:
            return
        _scale(element.find("mass_center"), factor)
        _scale_inertia(element.find("inertia"), factor)
        for mesh in element.iterfind("attached_geometry/*"):
            _scale(mesh.find("scale_factors"), factor)
        for frame in element.iterfind("components/PhysicalOffsetFrame"):
            _scale(frame.find("translation"), factor)
            for mesh in frame.iterfind("attached_geometry/*"):
                _scale(mesh.find("scale_factors"), factor)
        for marker in self.root.iterfind("MarkerSet/objects/Marker"):
            if (marker.findtext("socket_parent_frame") or "").strip().rpartition("/")[2] == body:
                _scale(marker.find("location"), factor)
        for joint in self.joints.values():
            for end in ("parent", "child"):
                frame = self._frame(joint, end)
                if frame.body == body and frame.element is not None:
                    _scale(frame.element.find("translation"), factor)
                    if end == "parent" and joint.tag == "CustomJoint":
                        self._scale_translations(joint, frame.rotation, factor)

    def _scale_translations(self, joint: Element, rotation: Rotation, factor: np.ndarray) -> None:
        """Multiply the translations of a custom joint, which are along axes of its frame on the parent."""
        from lxml import etree

        for k in (1, 2, 3):
            element = joint.find(f"SpatialTransform/TransformAxis[@name='translation{k}']")
            if element is None:
                continue
            along = rotation.apply(self._axis(joint, element))
            ratio = float(along @ (factor * along))
            for function in list(element):
                if not isinstance(function.tag, str) or function.tag in _AXIS_PROPERTIES or ratio == 1.0:
                    continue
                if function.tag in ("Constant", "MultiplierFunction"):
                    _scale(function.find("value" if function.tag == "Constant" else "scale"), np.array([ratio]))
                    continue
                product = etree.Element("MultiplierFunction")
                etree.SubElement(product, "scale").text = f"{ratio:.12g}"
                element.replace(function, product)
                etree.SubElement(product, "function").append(function)

    # What else changes -----------------------------------------------------------------------------------------------

    def remove_forces(self) -> dict[str, int]:
        """Empty the sets of muscles and of what depends on them; set → how many members it had."""
        left_out: dict[str, int] = {}
        for name in _LEFT_OUT:
            if (component_set := self.root.find(name)) is not None:
                count = len([each for each in component_set.iterfind("objects/*") if isinstance(each.tag, str)])
                left_out |= {name: count} if count else {}
                self.root.remove(component_set)
        for wraps in list(self.root.iter("WrapObjectSet")):
            wraps.getparent().remove(wraps)
        return left_out

    def add_markers(self, markers: Mapping[str, Marker]) -> None:
        """Add points as markers of their names, so that a .trc of them can be followed."""
        from lxml import etree

        marker_set = self.root.find("MarkerSet")
        if marker_set is None:
            marker_set = etree.SubElement(self.root, "MarkerSet", name="markerset")
        objects = marker_set.find("objects")
        if objects is None:
            objects = etree.SubElement(marker_set, "objects")
        for point, (body, at_mass_centre) in markers.items():
            for old in objects.iterfind(f"Marker[@name='{point}']"):
                objects.remove(old)
            at_joint = self._frame(self.joints[body], "child").translation
            mass_centre = _numbers(body, self.bodies[body].findtext("mass_center", "0 0 0"), 3)
            marker = etree.SubElement(objects, "Marker", name=point)
            etree.SubElement(marker, "socket_parent_frame").text = f"/bodyset/{body}"
            etree.SubElement(marker, "location").text = _format(mass_centre if at_mass_centre else at_joint)
            etree.SubElement(marker, "fixed").text = "true"

    def free_coordinates(self, free: Mapping[str, Range], legs: bool) -> None:
        """Free these coordinates within their ranges, lock the other ones, and those of legs on demand.

        Limits of the model would stop what a person does. Without any limit the inverse kinematics may turn a shoulder
        round for ever where two of its axes fall together.
        """
        for body, joint in JOINTS.items():
            for coordinate in self._coordinates(body):
                name = coordinate.get("name", "")
                if name not in joint.coordinates:
                    continue
                _set(coordinate, "locked", str(name not in free).lower())
                default, low, high = free.get(name, Range(0.0, -np.pi, np.pi))
                _set(coordinate, "default_value", f"{default:.12g}")
                _set(coordinate, "range", _format(np.array([low, high])))
        if not legs:
            for body in set(self.joints) - set(JOINTS):
                for coordinate in self._coordinates(body):
                    if coordinate.findtext("is_free_to_satisfy_constraints", "false").strip() != "true":
                        _set(coordinate, "locked", "true")

    def _coordinates(self, body: str) -> list[Element]:
        """The coordinates of the joint that moves a body; none where no joint does."""
        joint = self.joints.get(body)
        return [] if joint is None else list(joint.iterfind("coordinates/Coordinate"))


# XML ------------------------------------------------------------------------------------------------------------------


def _parse(path: Path) -> ElementTree:
    from lxml import etree

    # Entities are not expanded and other files not fetched, so that a file cannot grow in memory.
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        with path.open("rb") as file:
            document = etree.parse(file, parser)
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}; an .osim model is needed here") from None
    except etree.XMLSyntaxError as error:
        reason = " ".join((error.msg or "no XML").split())
        raise BadData(f"{path}: is no complete XML file, as an .osim is: line {error.lineno}: {reason}") from error
    dtd = document.docinfo.internalDTD
    if dtd is not None and any(True for _ in dtd.iterentities()):
        raise BadData(f"{path}: declares entities (<!ENTITY …>), which no .osim has; it is not read")
    return document


def _numbers(at: str, text: str, count: int | None = None) -> np.ndarray:
    """The numbers of a text, (count,)."""
    words = text.split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.full(len(words), np.nan)
    if not np.isfinite(values).all() or (count is not None and len(values) != count) or not len(values):
        wanted = "numbers are" if count is None else "a number is" if count == 1 else f"{count} numbers are"
        raise BadData(f"{at} is '{' '.join(words)[:60]}'; {wanted} needed")
    return values


def _format(values: np.ndarray) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def _scale(element: Element | None, factor: np.ndarray) -> None:
    if element is not None and (element.text or "").strip():
        element.text = _format(factor * _numbers(element.tag, element.text or "", len(factor)))


def _scale_inertia(element: Element | None, factor: np.ndarray) -> None:
    """Moments about the mass centre, when all mass moves along the axes by the factor and stays as heavy."""
    if element is not None and (element.text or "").strip():
        xx, yy, zz, xy, xz, yz = _numbers(element.tag, element.text or "", 6)
        spread = factor**2 * (0.5 * (xx + yy + zz) - np.array([xx, yy, zz]))  # ∫ x² dm, …
        x, y, z = factor
        moments = spread.sum() - spread
        element.text = _format(np.array([*moments, x * y * xy, x * z * xz, y * z * yz]))


def _set(element: Element, tag: str, text: str) -> None:
    """Set the text of a property, which is made where it is missing."""
    from lxml import etree

    child = element.find(tag)
    (etree.SubElement(element, tag) if child is None else child).text = text
