"""Our names of a person's segments, and the words by which others name them."""

from __future__ import annotations

import re

SEGMENTS = (
    "torso",
    "left_upper_arm",
    "left_forearm",
    "right_upper_arm",
    "right_forearm",
    "pelvis",
    "head",
    "left_hand",
    "right_hand",
)

# Words that name a segment in a label or a file's name, after its side.
PARTS = (
    ("forearm", r"fore ?arm|lower ?arm|ulna|radius|wrist"),
    ("upper_arm", r"upper ?arm|humerus|biceps|brachium"),
    ("hand", r"hand|palm"),
)
MIDDLE = (
    ("torso", r"torso|trunk|chest|sternum|stern|thorax|t ?8"),
    ("pelvis", r"pelvis|sacrum"),
    ("head", r"head|forehead"),
)


def segment_of(label: str) -> str | None:
    """The segment that a label or a file's name speaks of, as ``humerus_r_imu`` or ``LeftForeArm``; None if unclear."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|[^A-Za-z0-9]+|(?<=[a-z])(?=\d)", " ", label).lower()
    sides = {side for side in ("left", "right") if re.search(rf"\b({side}|{side[0]})(?=\b|hand|fore|upper)", words)}
    found = {f"{side}_{part}" for part, pattern in PARTS if re.search(pattern, words) for side in sides}
    found |= {part for part, pattern in MIDDLE if re.search(rf"\b({pattern})\b", words)}
    return found.pop() if len(found) == 1 else None
