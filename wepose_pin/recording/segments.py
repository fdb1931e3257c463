"""Names of a person's segments, and the words that labels and file names use for them."""

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

# Words in a label or a file name that name a segment of a side.
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


def guess_segment(label: str) -> str | None:
    """Guess the segment from a label or a file name, as ``humerus_r_imu`` or ``LeftForeArm``; None if unclear."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|[^A-Za-z0-9]+|(?<=[a-z])(?=\d)", " ", label).lower()
    sides = {side for side in ("left", "right") if re.search(rf"\b({side}|{side[0]})(?=\b|hand|fore|upper)", words)}
    matches = {f"{side}_{part}" for part, pattern in PARTS if re.search(pattern, words) for side in sides}
    matches |= {part for part, pattern in MIDDLE if re.search(rf"\b({pattern})\b", words)}
    return matches.pop() if len(matches) == 1 else None
