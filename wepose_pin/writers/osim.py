"""A generic OpenSim model (.osim) scaled to a subject, by its XML alone.

What OpenSim's own Scale Tool scales is scaled by the same factors: joint centres, mass centres, inertias, meshes,
markers, and the translations of custom joints. Masses stay the generic model's. Muscles cannot be scaled without their
paths over wrap surfaces, so forces, controllers, probes, wrap surfaces and contact geometry are left out.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..diagnostics import INFO, Diagnostic
from ..errors import BadData
from .motion import Motion, check_complete
from .osim_xml import Marker, OsimModel, Range, Span
from .rajagopal import JOINTS, coordinates, find_first_values, orientations

_LEAST_SCALE, _MOST_SCALE = 0.4, 2.5  # of a person against a model of a person
_CLOSE = 1e-9  # [m]
_ROUNDS = 50
_TURN = 2.0 * np.pi  # [rad] that a coordinate may go each way, or further where the motion does


def _arm_spans(side: str, s: str) -> dict[str, Span]:
    return {
        f"{side}_upper_arm": Span((f"humerus_{s}",), (f"ulna_{s}",), (f"humerus_{s}",)),
        f"{side}_forearm": Span((f"ulna_{s}",), (f"hand_{s}",), (f"ulna_{s}", f"radius_{s}")),
        f"{side}_hand": Span((f"hand_{s}",), (), (f"hand_{s}",)),
    }


def _leg_spans(side: str, s: str) -> dict[str, Span]:
    return {
        f"{side}_thigh": Span((f"femur_{s}",), (f"tibia_{s}",), (f"femur_{s}", f"patella_{s}")),
        f"{side}_shank": Span((f"tibia_{s}",), (f"talus_{s}",), (f"tibia_{s}",)),
        f"{side}_foot": Span((f"talus_{s}",), (f"toes_{s}",), (f"talus_{s}", f"calcn_{s}", f"toes_{s}")),
    }


# Length → where it is in the model. Those of one body along other axes are independent of each other.
SPANS = {
    "trunk": Span(("femur_r", "femur_l"), ("humerus_r", "humerus_l"), ("pelvis", "torso"), "xy"),
    "shoulder_width": Span(("humerus_r",), ("humerus_l",), ("torso",), "z"),
    "hip_width": Span(("femur_r",), ("femur_l",), ("pelvis",), "z"),
    **_arm_spans("left", "l"),
    **_arm_spans("right", "r"),
    **_leg_spans("left", "l"),
    **_leg_spans("right", "r"),
}


def _markers(side: str, s: str) -> dict[str, Marker]:
    return {
        f"{side}_shoulder": Marker(f"humerus_{s}"),
        f"{side}_elbow": Marker(f"ulna_{s}"),
        f"{side}_wrist": Marker(f"hand_{s}"),
        f"{side}_palm": Marker(f"hand_{s}", at_mass_centre=True),
    }


# Point → where it is in the model, if that has the length which ends there.
MARKERS = _markers("left", "l") | _markers("right", "r")


class Scale(NamedTuple):
    """A length of the subject, and what it scaled."""

    length: float  # [m] of the subject, and now of the model
    generic: float  # [m] of the generic model
    bodies: tuple[str, ...]
    axes: str  # of the bodies, such as "xy"
    factor: float

    def __str__(self) -> str:
        """Such as "pelvis, torso by 0.9637 in xy"."""
        return f"{', '.join(self.bodies)} by {self.factor:.4f}" + (f" in {self.axes}" if self.axes != "xyz" else "")


class ScaledModel(NamedTuple):
    """The text of a model, and length → what it scaled."""

    text: bytes
    scales: dict[str, Scale]
    left_out: dict[str, int]  # set of the generic model → members that the scaled one has not


def scale_model(generic: Path, motion: Motion, begin: bool) -> ScaledModel:
    """Scale a model to a subject; the coordinates of measured segments are free, all other rotations locked.

    Parameters
    ----------
    generic : the .osim
    motion : of the subject
    begin : make the pose of the first sample the default; otherwise it is zero of all coordinates

    Raises
    ------
    MissingFile, BadData
        Not there; no model of OpenSim 4; a body, joint or coordinate of it is not there or not as in Rajagopal's.
    """
    model = OsimModel(generic)
    wanted = {length: value for length, value in motion.model.lengths.items() if length in SPANS}
    quat_GB = orientations(motion.pose.quat_WL)
    measured = set(quat_GB)
    if not wanted or not measured:
        raise BadData(f"{generic}: the subject has no length or no segment that a model of a person has")
    model.check([SPANS[length] for length in wanted], measured)
    left_out = model.remove_forces()
    before = {length: model.measure(SPANS[length]) for length in wanted}
    factors: dict[str, float] = dict.fromkeys(wanted, 1.0)
    for _ in range(_ROUNDS):
        own = {length: model.measure(SPANS[length]) for length in wanted}
        if all(abs(own[length] - value) < _CLOSE for length, value in wanted.items()):
            break
        for length, value in wanted.items():
            ratio = value / own[length]
            factors[length] *= ratio
            _check_factor(generic, length, value, before[length], factors[length])
            for body in SPANS[length].bodies:
                model.scale_body(body, np.array([ratio if axis in SPANS[length].axes else 1.0 for axis in "xyz"]))
    else:
        raise BadData(
            f"{generic}: scaling {', '.join(wanted)} does not reach the subject's lengths; are joints misplaced?"
        )
    first = find_first_values(quat_GB) if begin else {}
    turned, _ = coordinates(quat_GB)
    free = {}
    for coordinate in find_followed_coordinates(measured):
        values = turned.get(coordinate, np.zeros(1))
        low, high = min(-_TURN, float(values.min()) - np.pi), max(_TURN, float(values.max()) + np.pi)
        free[coordinate] = Range(first.get(coordinate, 0.0), low, high)
    model.free_coordinates(free, legs=not measured <= set(JOINTS))
    ends = {body for length in wanted for body in (*SPANS[length].start, *SPANS[length].end)}
    model.add_markers({point: marker for point, marker in MARKERS.items() if marker.body in ends})
    model.root.set("name", re.sub(r"[^A-Za-z0-9_.-]+", "_", motion.name) or "subject")
    scales = {
        length: Scale(value, before[length], SPANS[length].bodies, SPANS[length].axes, factors[length])
        for length, value in wanted.items()
    }
    return ScaledModel(model.text(), scales, left_out)


def write_osim(path: Path, motion: Motion, generic: Path, begin: bool = False) -> list[Diagnostic]:
    """Write the generic model scaled to the motion's subject; give what scaled by what, and what was left out.

    Parameters
    ----------
    begin : make the pose of the first sample the default, as the inverse kinematics needs it

    Raises
    ------
    MissingFile, BadData
        As `scale_model`.
    """
    check_complete(motion, "an .osim")
    scaled = scale_model(generic, motion, begin)
    path.write_bytes(scaled.text)
    words = "; ".join(f"{scale} ({length})" for length, scale in scaled.scales.items())
    diagnostics = [Diagnostic("osim-scaled", INFO, facts={"scales": words})]
    if scaled.left_out:
        sets = ", ".join(f"{count} of {name}" for name, count in scaled.left_out.items())
        diagnostics.append(Diagnostic("osim-forces-left-out", INFO, facts={"sets": sets}))
    return diagnostics


def _check_factor(generic: Path, length: str, value: float, own: float, factor: float) -> None:
    if not _LEAST_SCALE <= factor <= _MOST_SCALE:
        raise BadData(
            f"{generic}: {length} is {own:.4g} m in it and {value:.4g} m of the subject; a factor of {_LEAST_SCALE} to "
            f"{_MOST_SCALE} is possible; is the model in metres?"
        )


def find_followed_coordinates(measured: Collection[str]) -> set[str]:
    """The coordinates that the measured bodies determine; an arm's from its humerus on."""
    free: set[str] = set()
    for body in set(measured) & set(JOINTS):
        part, _, side = body.partition("_")
        above = [f"humerus_{side}", f"radius_{side}"][: {"radius": 1, "hand": 2}.get(part, 0)]
        if set(above) <= set(measured):
            free |= {*JOINTS[body].coordinates, *(JOINTS[f"ulna_{side}"].coordinates if part == "radius" else ())}
    return free
