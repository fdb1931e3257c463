"""Xsens MVNX, the XML export of MVN Studio and MVN Analyze, versions 2 to 4.

Each frame of type `normal` holds the segments' orientations (w x y z, to a world with z up) and, in exports before MVN
2018, the sensors' `sensorAcceleration` [m/s²] and `sensorAngularVelocity` [rad/s]. An Xsens segment's frame is the
world's (x forward, y left, z up) in the T-pose with palms down; ours is in the N-pose. MVN 4.2 exports the arms in the
frames of the ISB. The file's frame of type `tpose` tells which; without it the former are assumed.

Source: MVN User Manual, MVNX structure; the frames `tpose` and `tpose-isb` of exported files.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..libraries import library_errors
from .device import Device, Reference, Signal, check_measured, make_device

SEGMENT_OF = {
    **{"T8": "torso", "LeftUpperArm": "left_upper_arm", "LeftForeArm": "left_forearm"},
    **{"RightUpperArm": "right_upper_arm", "RightForeArm": "right_forearm", "Pelvis": "pelvis", "Head": "head"},
    **{"LeftHand": "left_hand", "RightHand": "right_hand"},
}
_JOINTS = {"UpperArm": "shoulder", "ForeArm": "elbow", "Hand": "wrist", "UpperLeg": "hip"}  # in which a segment begins
JOINT_OF = {f"{s}{part}": f"{s.lower()}_{joint}" for s in ("Left", "Right") for part, joint in _JOINTS.items()}
# In the T-pose each of Xsens's frames is one of these, but for the tilts of that pose: 13 deg at the head.
_QUARTERS = Rotation.create_group("O")
WIDTH = {"orientation": 4, "position": 3, "sensorAngularVelocity": 3, "sensorAcceleration": 3}
RAW = ("sensorAngularVelocity", "sensorAcceleration")


class Frames(NamedTuple):
    """The frames of a file, in its own units and order."""

    time: np.ndarray  # (n,) [s]
    segments: list[str]
    sensors: list[str]
    values: dict[str, np.ndarray]  # element → (n, count, width)
    t_pose: np.ndarray | None  # (count, 4) xyzw, the segments' orientations in the T-pose; None: not known


def read_mvnx(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors, or the segments' orientations, as `Format.read`; `rate_hz` goes before the file's frameRate."""
    frames = read_frames(path, rate_hz)
    if use != "orientation" and set(RAW) <= set(frames.values):
        raw = zip(frames.sensors, *(frames.values[tag].swapaxes(0, 1) for tag in RAW), strict=False)
        signals = {
            label: {"gyro": Signal(frames.time, gyro), "accel": Signal(frames.time, accel)}
            for label, gyro, accel in raw
            if label in SEGMENT_OF
        }
    else:
        signals = {label: {"orientation": Signal(frames.time, quat)} for label, quat in _read_quats(frames).items()}
    if not signals:
        listed = ", ".join(frames.segments[:12])
        raise BadData(f"{path}: none of the upper body's segments, such as T8; there is: {listed}")
    device = make_device(path, signals, " and ".join(RAW), use)
    aligned = device.kind == "orientation"
    diagnostics = _diagnose_frames(path, frames) if aligned else ()
    return device._replace(since_power_on=False, aligned=aligned, diagnostics=diagnostics)


def read_mvnx_reference(path: Path) -> Reference:
    """Read the segments' orientations and joints as a reference; its world has z up. Errors as `read_mvnx`."""
    frames = read_frames(path)
    quats = {SEGMENT_OF[label]: quat for label, quat in _read_quats(frames).items()}
    named = {JOINT_OF[label]: k for k, label in enumerate(frames.segments) if label in JOINT_OF}
    positions = frames.values.get("position")  # older exports have none
    joints = {} if positions is None else {joint: positions[:, k] for joint, k in named.items()}
    return Reference(frames.time, quats, joints, "+z", diagnostics=_diagnose_frames(path, frames))


def _diagnose_frames(path: Path, frames: Frames) -> tuple[Diagnostic, ...]:
    assumption = Diagnostic("file-assumption", WARNING, path.name, facts={"variant": "frames"})
    return (assumption,) if frames.t_pose is None else ()


def _read_quats(frames: Frames) -> dict[str, np.ndarray]:
    """Read each label's `quat_WL` (n, 4) xyzw, of our frame; rows of zeros or NaN become NaN."""
    orientations = {}
    for k, label in enumerate(frames.segments):
        if label not in SEGMENT_OF:
            continue
        # From the N-pose to the T-pose an arm rises by a quarter turn.
        R_BL = Rotation.from_rotvec([0.5 * np.pi * {"L": 1.0, "R": -1.0}.get(label[0], 0.0), 0.0, 0.0])
        if frames.t_pose is not None:
            off = (_QUARTERS.inv() * Rotation.from_quat(frames.t_pose[k])).magnitude()
            R_BL = _QUARTERS[int(np.argmin(off))].inv() * R_BL
        quat = rotations.xyzw_from_wxyz(frames.values["orientation"][:, k])
        good = np.linalg.norm(np.nan_to_num(quat), axis=1) > 0.5
        orientations[label] = np.full(quat.shape, np.nan)
        orientations[label][good] = (Rotation.from_quat(quat[good]) * R_BL).as_quat()
    return orientations


def read_frames(path: Path, rate_hz: float | None = None) -> Frames:
    """Read all frames of type `normal`; `rate_hz` replaces the file's frameRate."""
    from lxml import etree

    labels: dict[str, list[str]] = {"segment": [], "sensor": []}
    frames: list[tuple[str, str]] = []  # index and time of each
    texts: dict[str, list[str]] = {}
    t_pose: list[str] = []
    with library_errors(path, "an MVNX"), path.open("rb") as file:
        # Entities are not expanded and other files not fetched, so that a file cannot grow in memory.
        tags = ("{*}segment", "{*}sensor", "{*}frame", "{*}subject")
        for _, element in etree.iterparse(file, tag=tags, resolve_entities=False, no_network=True, load_dtd=False):
            name, kind = etree.QName(element).localname, element.get("type", "normal")
            if name in labels and element.get("label"):
                labels[name].append(element.get("label"))
            elif name == "subject":
                rate_hz = rate_hz or float(element.get("frameRate", "0"))
            elif name == "frame":
                if kind == "normal":
                    frames.append((element.get("index", ""), element.get("time", "")))
                    for tag in WIDTH:
                        if (text := element.findtext(f"{{*}}{tag}")) is not None:
                            texts.setdefault(tag, []).append(text)
                elif kind == "tpose":
                    t_pose = [element.findtext("{*}orientation") or ""]
                element.clear()
                while element.getprevious() is not None:
                    del element.getparent()[0]
    if len(frames) < 2:
        raise BadData(f"{path}: {len(frames)} frames of type 'normal'; a recording has at least 2")
    if "orientation" not in texts:
        raise BadData(f"{path}: its frames hold no <orientation>; export it with the segments' orientations")
    values = {}
    for tag, rows in texts.items():
        if len(rows) != len(frames):
            raise BadData(f"{path}: <{tag}> stands in {len(rows)} of {len(frames)} frames; it is needed in all")
        values[tag] = _read_values(path, tag, rows, len(labels["sensor" if tag.startswith("sensor") else "segment"]))
    quats = rotations.xyzw_from_wxyz(_read_values(path, "orientation", t_pose, len(labels["segment"])).reshape(-1, 4))
    has_t_pose = len(quats) > 0 and bool((np.linalg.norm(quats, axis=1) > 0.5).all())
    numbers, stamps = zip(*frames, strict=True)
    with library_errors(path, "frames with an index and a frameRate, or with a time"):
        if not rate_hz:
            time = 1e-3 * np.array(stamps, dtype=float)
        else:  # `time` is cut to milliseconds
            time = np.array(numbers if all(numbers) else range(len(numbers)), dtype=float) / rate_hz
    return Frames(time, labels["segment"], labels["sensor"], values, quats if has_t_pose else None)


def _read_values(path: Path, tag: str, rows: Sequence[str], count: int) -> np.ndarray:
    """Read an element's numbers (frames, count, width)."""
    values = np.empty((len(rows), WIDTH[tag] * count))
    for k, text in enumerate(rows):
        try:
            values[k] = np.array(text.split(), dtype=float).reshape(values.shape[1])
        except ValueError:
            needed = f"{WIDTH[tag]} numbers for each of {count} are needed"
            raise BadData(f"{path}: <{tag}> of frame {k} begins with '{text[:40]}'; {needed}") from None
    check_measured(f"{path}: <{tag}>", values)
    return values.reshape(len(rows), count, WIDTH[tag])
