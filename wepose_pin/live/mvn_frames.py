"""The datagram of the Xsens MVN network streamer that holds quaternions ("MXTP02"), read and written.

Big-endian: a header of 24 bytes, then an item of 32 bytes a segment: number, position [m], quaternion w x y z. The
world has z up; each segment's frame equals it in the T-pose. Source: MVN real-time network streaming protocol
specification, revision N, 2018; it says centimetres where the receivers that were read take metres.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from .. import rotations
from .figure import SEGMENTS, Figure

TYPE = b"MXTP02"
# Type, sample counter, part of a frame, items, time [ms], character, body segments, props, finger segments, reserved,
# bytes after the header.
HEADER = struct.Struct(">6sIBBIBBBBHH")
ITEM = struct.Struct(">i3f4f")
WHOLE = 0x80  # the frame is in one datagram
BODY_SEGMENTS = len(SEGMENTS)
# Our segment → its number in MVN, from 1 on.
SEGMENT_IDS = {
    "pelvis": 1,
    "torso": 5,
    "head": 7,
    "right_upper_arm": 9,
    "right_forearm": 10,
    "right_hand": 11,
    "left_upper_arm": 13,
    "left_forearm": 14,
    "left_hand": 15,
}
_QUARTER = np.sqrt(0.5)
# `quat` (4,) xyzw of R_BL, our segment's frame in MVN's: from N-pose to T-pose an arm turns by a quarter about x.
N_TO_T: Mapping[str, np.ndarray] = {
    name: np.array([{"l": _QUARTER, "r": -_QUARTER}[name[0]], 0.0, 0.0, _QUARTER])
    if name.startswith(("left_", "right_"))
    else np.array([0.0, 0.0, 0.0, 1.0])
    for name in SEGMENT_IDS
}


def encode_frame(figure: Figure, counter: int, time_s: float) -> bytes:
    """Return the datagram of a whole figure."""
    quat_wxyz = rotations.wxyz_from_xyzw(figure.quat_WB)
    items = b"".join(
        ITEM.pack(k + 1, *position, *quat)
        for k, (position, quat) in enumerate(zip(figure.position.tolist(), quat_wxyz.tolist(), strict=True))
    )
    time_ms = round(1e3 * time_s) & 0xFFFFFFFF
    head = (TYPE, counter & 0xFFFFFFFF, WHOLE, BODY_SEGMENTS, time_ms, 0, BODY_SEGMENTS, 0, 0, 0, len(items))
    return HEADER.pack(*head) + items
