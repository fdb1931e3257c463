"""What each angle is, in words: the tables of `docs/angles.md`, for files and pages that hold angles."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from .joints import Angles, group_sides

SOURCE = (
    "Wu et al. 2005 (J Biomech 38:981-992) for thorax, shoulder, elbow and wrist, "
    "Wu et al. 2002 (J Biomech 35:543-548) for pelvis, hip and ankle, "
    "Grood and Suntay 1983 (J Biomech Eng 105:136-144) for the knee"
)

# Joint without its side → the distal segment in the proximal one.
ROTATIONS = {
    "thorax": "thorax in W",
    "shoulder": "upper arm in thorax",
    "elbow": "forearm in upper arm",
    "wrist": "hand in forearm",
    "pelvis_in_world": "pelvis in W",
    "hip": "thigh in pelvis",
    "knee": "shank in thigh",
    "ankle": "foot in shank",
}
# Joint without its side and angle → where the angle is positive.
POSITIVE = {
    ("thorax", "extension"): "leaning back (a bow is negative)",
    ("thorax", "lateral_flexion_right"): "leaning to the right",
    ("thorax", "axial_rotation_left"): "turned to the left",
    ("shoulder", "plane_of_elevation"): "0° out to the side, 90° forward, −90° backward",
    ("shoulder", "elevation"): "on the far side of the plane of elevation; −90° is horizontal in that plane",
    ("shoulder", "internal_rotation"): "inward",
    ("shoulder", "adduction"): "arm towards the body (abduction is negative)",
    ("shoulder", "flexion"): "arm forward",
    ("elbow", "flexion"): "bent",
    ("elbow", "carrying_angle"): "forearm towards the body; the carrying angle of a straight arm is negative",
    ("elbow", "pronation"): "0° palm forward (supinated), 90° thumb forward, 180° palm back",
    ("wrist", "flexion"): "towards the palm",
    ("wrist", "ulnar_deviation"): "towards the little finger",
    ("wrist", "pronation"): "as in the forearm",
    ("pelvis_in_world", "posterior_tilt"): "tilted back (an anterior tilt is negative)",
    ("pelvis_in_world", "obliquity_right_down"): "the right side down",
    ("pelvis_in_world", "axial_rotation_left"): "turned to the left",
    ("hip", "flexion"): "thigh forward",
    ("hip", "adduction"): "thigh towards the other (abduction is negative)",
    ("hip", "internal_rotation"): "inward",
    ("knee", "flexion"): "bent",
    ("knee", "adduction"): "ankle towards the other (bow legs, varus)",
    ("knee", "external_rotation"): "toes outward",
    ("ankle", "dorsiflexion"): "toes up (plantar flexion is negative)",
    ("ankle", "inversion"): "sole inward",
    ("ankle", "internal_rotation"): "toes inward",
}


class Definition(NamedTuple):
    """One angle of the joints of a group, left and right alike."""

    group: str  # the joint without its side
    rotation: str  # as "forearm in upper arm"
    sequence: str
    axis: str  # of the sequence
    angle: str
    positive: str


def define_angles(sessions: Iterable[Angles]) -> list[Definition]:
    """Return the definition of each angle that there is in a session, once."""
    definitions: dict[Definition, None] = {}
    for angles in sessions:
        for group, members in group_sides(angles.joints).items():
            joint = angles[next(iter(members.values()))]
            for axis, name in zip(joint.sequence, joint.names, strict=True):
                definition = Definition(group, ROTATIONS[group], joint.sequence, axis, name, POSITIVE[group, name])
                definitions[definition] = None
    return list(definitions)
