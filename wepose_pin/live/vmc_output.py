"""The pose in the VMC protocol over OSC, for Unity, VSeeFace, Blender. See docs/live-page.md.

Bones are local to their parents and turn from the avatar's T-pose. The frame is Unity's: left-handed, x right, y up,
z forward. Source: Virtual Motion Capture Protocol 2.1 and 3.1, OSC 1.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from .figure import SEGMENTS, Figure, complete_figure
from .outputs import DatagramOutput
from .state import LivePose, StreamInfo

PORT = 39539  # on which renderers listen
RATE_HZ = 60.0  # of screens
MAX_BUNDLE = 1400  # [bytes] the protocol has 1500
# Bone of Unity's humanoid → our segment, and the bone above.
BONES = {
    "Hips": ("pelvis", ""),
    "Spine": ("l3", "Hips"),
    "Chest": ("torso", "Spine"),
    "Neck": ("neck", "Chest"),
    "Head": ("head", "Neck"),
} | {
    f"{side.capitalize()}{bone}": (
        f"{side}_{segment}",
        above if above in ("Hips", "Chest") else side.capitalize() + above,
    )
    for side in ("left", "right")
    for bone, segment, above in (
        ("Shoulder", "shoulder", "Chest"),
        ("UpperArm", "upper_arm", "Shoulder"),
        ("LowerArm", "forearm", "UpperArm"),
        ("Hand", "hand", "LowerArm"),
        ("UpperLeg", "upper_leg", "Hips"),
        ("LowerLeg", "lower_leg", "UpperLeg"),
        ("Foot", "foot", "LowerLeg"),
    )
}
_AT = np.array([SEGMENTS.index(segment) for segment, _ in BONES.values()])
_ABOVE = np.array([SEGMENTS.index(BONES[above or "Hips"][0]) for _, above in BONES.values()])
_IMMEDIATELY = b"#bundle\0" + struct.pack(">Q", 1)


class VmcOutput(DatagramOutput):
    """Sends each pose as bundles of OSC messages."""

    option, port = "--vmc", PORT

    def __init__(self, to: str, rate_hz: float | None = RATE_HZ) -> None:
        super().__init__(to, rate_hz)

    def encode(self, info: StreamInfo, pose: LivePose) -> list[bytes]:
        return encode_bundles(complete_figure(info, pose), pose.time)


def encode_bundles(figure: Figure, time_s: float) -> list[bytes]:
    """Return the OSC bundles of a figure, each small enough for one datagram."""
    bundles, size = [[_IMMEDIATELY]], len(_IMMEDIATELY)
    for message in _list_messages(figure, time_s):
        framed = struct.pack(">i", len(message)) + message
        if size + len(framed) > MAX_BUNDLE:
            bundles.append([_IMMEDIATELY])
            size = len(_IMMEDIATELY)
        bundles[-1].append(framed)
        size += len(framed)
    return [b"".join(parts) for parts in bundles]


def _list_messages(figure: Figure, time_s: float) -> Iterator[bytes]:
    yield encode_message("/VMC/Ext/OK", 1)
    yield encode_message("/VMC/Ext/T", float(time_s))
    yield _ROOT
    R_WB = Rotation.from_quat(figure.quat_WB)
    R_above = R_WB[_ABOVE].inv()
    position = R_above.apply(figure.position[_AT] - figure.position[_ABOVE])
    quat = (R_above * R_WB[_AT]).as_quat()
    position[0], quat[0] = figure.position[_AT[0]], figure.quat_WB[_AT[0]]  # of the hips, in W
    for head, numbers in zip(_BONE_HEADS, to_unity(position, quat).tolist(), strict=True):
        yield head + _BONE_NUMBERS.pack(*numbers)


def to_unity(position: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return positions (n, 3) [m] and quaternions (n, 4) xyzw in Unity's frame, (n, 7)."""
    x, y, z = position.T
    qx, qy, qz, qw = quat.T
    return np.column_stack([-y, z, x, qy, -qz, -qx, qw])


def encode_message(address: str, *arguments: str | float | int) -> bytes:
    """Return an OSC message; floats are f32, integers i32."""
    tags, data = ",", b""
    for argument in arguments:
        if isinstance(argument, str):
            tags, data = tags + "s", data + _pad(argument)
        elif isinstance(argument, int):
            tags, data = tags + "i", data + struct.pack(">i", argument)
        else:
            tags, data = tags + "f", data + struct.pack(">f", argument)
    return _pad(address) + _pad(tags) + data


def _pad(text: str) -> bytes:
    """Return a text with its closing zeros, a multiple of four bytes."""
    data = text.encode("utf-8") + b"\0"
    return data + b"\0" * (-len(data) % 4)


_BONE_NUMBERS = struct.Struct(">7f")  # position x, y, z [m], quaternion x, y, z, w
# What stays the same in the messages of the bones, and that of the root.
_BONE_HEADS = [encode_message("/VMC/Ext/Bone/Pos", bone, *(0.0,) * 7)[: -_BONE_NUMBERS.size] for bone in BONES]
_ROOT = encode_message("/VMC/Ext/Root/Pos", "root", *(0.0,) * 6, 1.0)
