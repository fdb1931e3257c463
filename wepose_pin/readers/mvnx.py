"""Xsens MVNX, the XML export of MVN Studio and MVN Analyze, versions 2 to 4.

Each frame of type `normal` holds the segments' orientations (w x y z, to a world with z up) and, in exports before MVN
2018, the sensors' `sensorAcceleration` [m/s²] and `sensorAngularVelocity` [rad/s]. An Xsens segment's frame is the
world's (x forward, y left, z up) in the T-pose with palms down; ours is in the N-pose. MVN 4.2 exports the arms in the
frames of the ISB. The file's frame of type `tpose` tells which; without it the positions, as an arm lies along y of the
former and along −z of the latter; without both the former are assumed.

Source: MVN User Manual, MVNX structure; the frames `tpose` and `tpose-isb` of exported files.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..body import load_table
from ..body.table import ROOT
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..libraries import library_errors
from .device import Device, DeviceSensor, check_measured
from .markers import Reference

SEGMENT_OF = {
    "T8": "torso",
    "LeftUpperArm": "left_upper_arm",
    "LeftForeArm": "left_forearm",
    "RightUpperArm": "right_upper_arm",
    "RightForeArm": "right_forearm",
    "Pelvis": "pelvis",
    "Head": "head",
    "LeftHand": "left_hand",
    "RightHand": "right_hand",
}
# In the T-pose each of Xsens's frames is one of these, but for the tilts of that pose: 13 deg at the head.
_QUARTERS = Rotation.create_group("O")
T_POSE_DEG = 30.0
ALONG_DEG = 5.0  # MVN draws its joints on an arm's axis, to 0.03 deg
WIDTH = {"orientation": 4, "position": 3, "sensorAngularVelocity": 3, "sensorAcceleration": 3}
# An arm's segment and the one that begins at its other end.
ARM = {
    f"{side}{part}": f"{side}{end}"
    for side in ("Left", "Right")
    for part, end in (("UpperArm", "ForeArm"), ("ForeArm", "Hand"))
}
# The joint in which a segment begins.
JOINT_OF = {
    f"{side}{part}": f"{side.lower()}_{joint}"
    for side in ("Left", "Right")
    for part, joint in (("UpperArm", "shoulder"), ("ForeArm", "elbow"), ("Hand", "wrist"), ("UpperLeg", "hip"))
}
HIPS = ("left_hip", "right_hip")  # the root is midway between them
# Of its lengths [m]: MVN scales a body to the subject's height and a few measures.
LENGTH_STD = 0.01


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
    raw = {"sensorAngularVelocity", "sensorAcceleration"} <= set(frames.values)
    if use == "raw" and not raw:
        raise BadData(
            f"{path}: no sensorAngularVelocity and sensorAcceleration; MVN writes them no more since 2018. Leave out "
            f"data.use, and its segments' orientations are read"
        )
    diagnostics: tuple[Diagnostic, ...] = ()
    signals: dict[str, dict[str, np.ndarray]]
    if raw and use != "orientation":
        kind, (gyro, accel) = "raw", (frames.values[f"sensor{name}"] for name in ("AngularVelocity", "Acceleration"))
        signals = {label: {"gyro": gyro[:, k], "accel": accel[:, k]} for k, label in enumerate(frames.sensors)}
    else:
        kind = "orientation"
        signals = {label: {"orientation": quat} for label, quat in _read_quats(path, frames).items()}
        if frames.t_pose is None:
            diagnostics = (Diagnostic("file-assumption", WARNING, path.name, facts={"variant": "frames"}),)
    sensors = {
        label: DeviceSensor(frames.time, values, SEGMENT_OF[label])
        for label, values in signals.items()
        if label in SEGMENT_OF
    }
    if not sensors:
        listed = ", ".join(frames.segments[:12])
        raise BadData(f"{path}: none of the upper body's segments, such as T8; there is: {listed}")
    return Device(kind, sensors, since_power_on=False, aligned=kind == "orientation", diagnostics=diagnostics)


def read_mvnx_reference(path: Path) -> Reference:
    """Read the segments' orientations and joints as a reference; its world has z up. Errors as `read_mvnx`."""
    frames = read_frames(path)
    quats = {SEGMENT_OF[label]: quat for label, quat in _read_quats(path, frames).items()}
    return Reference(frames.time, quats, _find_joints(frames), "+z")


def read_mvnx_lengths(path: Path) -> dict[str, float]:
    """Read the lengths [m] between the joints of MVN's body: shoulder width, trunk, upper arms and forearms."""
    joints = _find_joints(read_frames(path))
    if set(HIPS) <= set(joints):
        joints[ROOT] = np.mean([joints[hip] for hip in HIPS], axis=0)
    known = {}
    for name, length in load_table().lengths.items():
        if {*length.start, *length.end} <= set(joints):
            ends = (length.start, length.end)
            first, last = (np.mean([joints[point] for point in points], axis=0) for points in ends)
            known[name] = float(np.nanmedian(np.linalg.norm(last - first, axis=1)))
    if not known:
        raise BadData(f"{path}: no positions of the arms' segments in it; export it with <position>")
    return known


def _find_joints(frames: Frames) -> dict[str, np.ndarray]:
    """Find the joints, name → (n, 3) [m], as far as the file has positions."""
    positions = frames.values.get("position")
    named = {JOINT_OF[label]: k for k, label in enumerate(frames.segments) if label in JOINT_OF}
    return {} if positions is None else {joint: positions[:, k] for joint, k in named.items()}


def _side(label: str) -> float:
    return {"L": 1.0, "R": -1.0}.get(label[0], 0.0)


def _raise(label: str) -> Rotation:
    """Return R_WL in the T-pose: from the N-pose an arm rises by a quarter turn."""
    return Rotation.from_rotvec([0.5 * np.pi * _side(label), 0.0, 0.0])


def _read_quats(path: Path, frames: Frames) -> dict[str, np.ndarray]:
    """Read each label's `quat_WL` (n, 4) xyzw, of our frame; rows of zeros or NaN become NaN."""
    orientations = {}
    for k, label in enumerate(frames.segments):
        if label not in SEGMENT_OF:
            continue
        R_BL = _raise(label)
        if frames.t_pose is not None:
            off = (_QUARTERS.inv() * Rotation.from_quat(frames.t_pose[k])).magnitude()
            if off.min() > np.radians(T_POSE_DEG):
                raise BadData(
                    f"{path}: its frame of type tpose is no T-pose: {label} is {np.degrees(off.min()):.0f} deg off a "
                    f"quarter turn there, up to {T_POSE_DEG:g} are taken; export the file again"
                )
            R_BL = _QUARTERS[int(np.argmin(off))].inv() * R_BL
        quat = rotations.xyzw_from_wxyz(frames.values["orientation"][:, k])
        good = np.linalg.norm(np.nan_to_num(quat), axis=1) > 0.5
        orientations[label] = np.full(quat.shape, np.nan)
        orientations[label][good] = (Rotation.from_quat(quat[good]) * R_BL).as_quat()
    return orientations


def _find_t_pose(path: Path, frames: Frames) -> np.ndarray | None:
    """Find the T-pose (count, 4) xyzw of which the arms lie along −z of our frames, by their positions; None: none."""
    positions = frames.values.get("position")
    at = {} if positions is None else {label: positions[:, k] for k, label in enumerate(frames.segments)}
    along_W = {label: at[end] - at[label] for label, end in ARM.items() if {label, end} <= set(at)}
    # In the ISB's frames the palm of a hanging arm is forward.
    turns = [0.5 * np.pi * _side(label) * label.endswith(("ForeArm", "Hand")) for label in frames.segments]
    isb = [
        _raise(label) * Rotation.from_rotvec([0.0, 0.0, -turn])
        for label, turn in zip(frames.segments, turns, strict=True)
    ]
    for R_WB in ([Rotation.identity()] * len(isb), isb):
        t_pose = np.array([each.as_quat() for each in R_WB])
        quats = _read_quats(path, frames._replace(t_pose=t_pose))
        if along_W and all(_lies_along(quats[label], along) for label, along in along_W.items()):
            return t_pose
    return None


def _lies_along(quat_WL: np.ndarray, along_W: np.ndarray) -> bool:
    """Return whether −z of a frame (n, 4) is along vectors (n, 3), to `ALONG_DEG`."""
    good = np.isfinite(quat_WL).all(axis=1)
    down_W = Rotation.from_quat(quat_WL[good]).apply([0.0, 0.0, -1.0])
    length = np.nansum(np.linalg.norm(along_W[good], axis=1))
    return bool(np.nansum(down_W * along_W[good]) > np.cos(np.radians(ALONG_DEG)) * length)


def read_frames(path: Path, rate_hz: float | None = None) -> Frames:
    """Read all frames of type `normal`; `rate_hz` replaces the file's frameRate.

    Raises
    ------
    BadData
        Not there; no MVNX, damaged or cut off; frames of unlike size.
    """
    from lxml import etree

    labels: dict[str, list[str]] = {"segment": [], "sensor": []}
    times: list[tuple[str, str]] = []
    texts: dict[str, list[str]] = {}
    t_pose: list[str] = []
    with library_errors(path, "an MVNX"), path.open("rb") as file:
        # Entities are not expanded and other files not fetched, so that a file cannot grow in memory.
        tags = ("{*}segment", "{*}sensor", "{*}frame", "{*}subject")
        for _, element in etree.iterparse(file, tag=tags, resolve_entities=False, no_network=True, load_dtd=False):
            name = etree.QName(element).localname
            if name in labels and element.get("label"):
                labels[name].append(element.get("label"))
            elif name == "subject":
                rate_hz = rate_hz or float(element.get("frameRate", "0"))
            elif name == "frame":
                if element.get("type", "normal") == "normal":
                    times.append((element.get("index", ""), element.get("time", "")))
                    for tag in WIDTH:
                        if (text := element.findtext(f"{{*}}{tag}")) is not None:
                            texts.setdefault(tag, []).append(text)
                elif element.get("type") == "tpose":
                    t_pose = [element.findtext("{*}orientation") or ""]
                element.clear()
                while element.getprevious() is not None:
                    del element.getparent()[0]
    if len(times) < 2:
        raise BadData(f"{path}: {len(times)} frames of type 'normal'; a recording has at least 2")
    if "orientation" not in texts:
        raise BadData(f"{path}: its frames hold no <orientation>; export it with the segments' orientations")
    values = {}
    for tag, rows in texts.items():
        if len(rows) != len(times):
            raise BadData(f"{path}: <{tag}> stands in {len(rows)} of {len(times)} frames; it is needed in all")
        values[tag] = _read_values(path, tag, rows, len(labels["sensor" if tag.startswith("sensor") else "segment"]))
    quats = rotations.xyzw_from_wxyz(_read_values(path, "orientation", t_pose, len(labels["segment"])).reshape(-1, 4))
    has_t_pose = len(quats) > 0 and bool((np.linalg.norm(quats, axis=1) > 0.5).all())
    time = _read_times(path, times, rate_hz)
    frames = Frames(time, labels["segment"], labels["sensor"], values, quats if has_t_pose else None)
    return frames if has_t_pose else frames._replace(t_pose=_find_t_pose(path, frames))


def _read_values(path: Path, tag: str, rows: Sequence[str], count: int) -> np.ndarray:
    """Read an element's numbers (frames, count, width)."""
    values = np.empty((len(rows), WIDTH[tag] * count))
    for k, text in enumerate(rows):
        try:
            values[k] = np.array(text.split(), dtype=float).reshape(values.shape[1])
        except ValueError:
            raise BadData(
                f"{path}: <{tag}> of frame {k} begins with '{text[:40]}'; {WIDTH[tag]} numbers for each of {count} are "
                f"needed"
            ) from None
    check_measured(path, values, f"<{tag}>")
    return values.reshape(len(rows), count, WIDTH[tag])


def _read_times(path: Path, times: Sequence[tuple[str, str]], rate_hz: float | None) -> np.ndarray:
    """Read times (n,) [s]: the frames' numbers over the rate, as `time` is cut to milliseconds."""
    with library_errors(path, "frames with an index and a frameRate, or with a time"):
        if rate_hz and all(number for number, _ in times):
            return np.array([float(number) for number, _ in times]) / rate_hz
        return np.arange(len(times)) / rate_hz if rate_hz else 1e-3 * np.array([float(text) for _, text in times])
