"""The datagram of the Xsens MVN network streamer that holds quaternions ("MXTP02"), read and written.

Big-endian: a header of 24 bytes, then an item of 32 bytes a segment: number, position [m], quaternion w x y z. The
world has z up; each segment's frame equals it in the T-pose. Source: MVN real-time network streaming protocol
specification, revision N, 2018; it says centimetres where the receivers that were read take metres.
"""

from __future__ import annotations

import struct

from .. import rotations
from .figure import SEGMENTS, Figure

TYPE = b"MXTP02"
# Type, sample counter, part of a frame, items, time [ms], character, body segments, props, finger segments, reserved,
# bytes after the header.
HEADER = struct.Struct(">6sIBBIBBBBHH")
ITEM = struct.Struct(">i3f4f")
WHOLE = 0x80  # the frame is in one datagram
BODY_SEGMENTS = len(SEGMENTS)


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
