"""Xsens MVNX, the XML export of MVN Studio and MVN Analyze, versions 2 to 4.

Each frame of type `normal` holds the segments' orientations (w x y z, to a world with z up) and, in exports before MVN
2018, the sensors' `sensorAcceleration` [m/s²] and `sensorAngularVelocity` [rad/s]. An Xsens segment's frame is the
world's (x forward, y left, z up) in the T-pose with palms down; ours is in the N-pose. MVN 4.2 exports the arms in the
frames of the ISB: these are the world's where the arms hang with palms forward. The file's frame of type `tpose` tells
which. Without it the segments' positions tell: from joint to joint an arm's segment lies along y of its frame, or along
−z.

Source: MVN User Manual, MVNX structure; the frames `tpose` and `tpose-isb` of exported files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


def _quarter_turns(axis: tuple[float, float, float], parts: tuple[str, ...]) -> dict[str, Rotation]:
    """Return a turn for each label: of these parts a quarter about the axis, the other way on the right; else none."""
    turns = dict.fromkeys(SEGMENT_OF, Rotation.identity())
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        turns |= {f"{side}{part}": Rotation.from_rotvec(sign * 0.5 * np.pi * np.array(axis)) for part in parts}
    return turns


# R_WL in the T-pose: from the N-pose an arm rises by a quarter turn.
_RAISED = _quarter_turns((1.0, 0.0, 0.0), ("UpperArm", "ForeArm", "Hand"))
# R_BL of the ISB's frames, in which the palm of a hanging arm is forward.
_SUPINATED = _quarter_turns((0.0, 0.0, 1.0), ("ForeArm", "Hand"))
# In the T-pose each of Xsens's frames is one of these, but for the tilts of that pose: 13 deg at the head.
_QUARTERS = Rotation.create_group("O")
T_POSE_DEG = 30.0
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
# MVN draws its joints on the axis, to 0.03 deg: what is off by more than this is of another convention.
ALONG_DEG = 5.0


# Of its lengths [m]: MVN scales a body to the subject's height and a few measures.
LENGTH_STD = 0.01


class Frames(NamedTuple):
    """The frames of a file, in its own units and order."""

    time: np.ndarray  # (n,) [s]
    segments: list[str]
    sensors: list[str]
    values: dict[str, np.ndarray]  # element → (n, count, width)
    t_pose: np.ndarray | None  # (count, 4) xyzw, the segments' orientations in the T-pose


def read_mvnx(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' raw data where the file has them, else the segments' orientations; `use` selects one.

    `rate_hz` goes before the file's frameRate.

    Raises
    ------
    MissingFile, BadData
        Not there; no MVNX, damaged, cut off, or without what `use` asks for; arms that do not lie along their frames.
    """
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
        gyro, accel = frames.values["sensorAngularVelocity"], frames.values["sensorAcceleration"]
        signals = {label: {"gyro": gyro[:, k], "accel": accel[:, k]} for k, label in enumerate(frames.sensors)}
        kind = "raw"
    else:
        signals = {label: {"orientation": quat} for label, quat in _read_orientations(path, frames).items()}
        kind = "orientation"
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
    """Read the segments' orientations and joints as a reference; its world has z up.

    Raises
    ------
    MissingFile, BadData
        As `read_mvnx`.
    """
    frames = read_frames(path)
    quats = {SEGMENT_OF[label]: quat for label, quat in _read_orientations(path, frames).items()}
    return Reference(frames.time, quats, _find_joints(frames), "+z")


def read_mvnx_lengths(path: Path) -> dict[str, float]:
    """Read the lengths [m] between the joints of MVN's body: shoulder width, trunk, upper arms and forearms.

    Raises
    ------
    MissingFile, BadData
        As `read_mvnx`; no positions of the arms in it.
    """
    joints = _find_joints(read_frames(path))
    root = tuple(joint for joint in joints if joint in HIPS)

    def locate(points: tuple[str, ...]) -> np.ndarray:
        return np.mean([joints[name] for point in points for name in (root if point == ROOT else (point,))], axis=0)

    known = {}
    for name, length in load_table().lengths.items():
        (start, end), *others = ((part.start, part.end) for part in length.stretches)
        if not others and {*start, *end} <= {*joints, *([ROOT] if len(root) == len(HIPS) else [])}:
            known[name] = float(np.nanmedian(np.linalg.norm(locate(end) - locate(start), axis=1)))
    if not known:
        raise BadData(f"{path}: no positions of the arms' segments in it; export it with <position>")
    return known


def _find_joints(frames: Frames) -> dict[str, np.ndarray]:
    """Find the joints, name → (n, 3) [m], as far as the file has positions."""
    if "position" not in frames.values:
        return {}
    return {
        JOINT_OF[label]: frames.values["position"][:, k] for k, label in enumerate(frames.segments) if label in JOINT_OF
    }


def _read_orientations(path: Path, frames: Frames) -> dict[str, np.ndarray]:
    """Read each label's `quat_WL` (n, 4) xyzw, of our frame; rows of zeros or NaN become NaN."""
    turns = _find_turns(path, frames)
    orientations = {}
    for k, label in enumerate(frames.segments):
        if label in SEGMENT_OF:
            quat, good = _select_good(frames.values["orientation"][:, k])
            orientations[label] = np.full(quat.shape, np.nan)
            orientations[label][good] = (Rotation.from_quat(quat[good]) * turns[label]).as_quat()
    return orientations


def _select_good(quat_wxyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions (n, 4) as xyzw, and which of them are neither zeros nor NaN."""
    quat = rotations.xyzw_from_wxyz(quat_wxyz)
    return quat, np.isfinite(quat).all(axis=1) & (np.linalg.norm(np.nan_to_num(quat), axis=1) > 0.5)


def _find_turns(path: Path, frames: Frames) -> dict[str, Rotation]:
    """Find each label's R_BL, our frame in Xsens's, by the file's T-pose; without one by the positions.

    Raises
    ------
    BadData
        The frame `tpose` is of another pose; an arm does not lie along its frame.
    """
    if frames.t_pose is not None:
        turns = _read_t_pose(path, frames.segments, frames.t_pose)
        choices = [{label: R_WB.inv() * _RAISED[label] for label, R_WB in turns.items()}]
    else:
        choices = [_RAISED, _SUPINATED]
    (label, off_deg), turns = min(
        ((_find_off_axis(frames, turns), turns) for turns in choices), key=lambda choice: choice[0][1]
    )
    if off_deg > ALONG_DEG:
        raise BadData(
            f"{path}: {label} lies {off_deg:.0f} deg off the axis of its frame, by its <position> and that of "
            f"{ARM[label]}; the orientations are not read. Export the file again"
        )
    return turns


def _read_t_pose(path: Path, segments: Sequence[str], quats: np.ndarray) -> dict[str, Rotation]:
    """Read each label's R_WB in the T-pose, to a quarter turn."""
    turns = {}
    for label, quat in zip(segments, quats, strict=True):
        if label in SEGMENT_OF:
            off = (_QUARTERS.inv() * Rotation.from_quat(quat)).magnitude()
            if off.min() > np.radians(T_POSE_DEG):
                raise BadData(
                    f"{path}: its frame of type tpose is no T-pose: {label} is {np.degrees(off.min()):.0f} deg off a "
                    f"quarter turn there; the orientations are not read. Export the file again"
                )
            turns[label] = _QUARTERS[int(np.argmin(off))]
    return turns


def _find_off_axis(frames: Frames, turns: Mapping[str, Rotation]) -> tuple[str, float]:
    """Find the arm's segment that lies furthest off −z of our frame, and that angle [deg]; 0 without positions."""
    at = {label: k for k, label in enumerate(frames.segments)}
    off_deg = {"": 0.0}
    for label, end in ARM.items() if "position" in frames.values else ():
        if label not in at or end not in at:
            continue
        quat, good = _select_good(frames.values["orientation"][:, at[label]])
        along_W = frames.values["position"][:, at[end]] - frames.values["position"][:, at[label]]
        good &= np.linalg.norm(np.nan_to_num(along_W), axis=1) > 1e-3
        if good.any():
            along_L = np.median((Rotation.from_quat(quat[good]) * turns[label]).inv().apply(along_W[good]), axis=0)
            off_deg[label] = float(np.degrees(np.arccos(np.clip(-along_L[2] / np.linalg.norm(along_L), -1.0, 1.0))))
    return max(off_deg.items(), key=lambda each: each[1])


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
                rate_hz = rate_hz or _read_rate(path, element.get("frameRate", ""))
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
    quats, good = _select_good(_read_values(path, "orientation", t_pose, len(labels["segment"])).reshape(-1, 4))
    time = _read_times(path, times, rate_hz)
    return Frames(time, labels["segment"], labels["sensor"], values, quats if t_pose and good.all() else None)


def _read_rate(path: Path, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1.0 <= value <= 10000.0:
        raise BadData(f"{path}: subject frameRate='{text}' is no rate; frames a second are needed there")
    return value


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
    try:
        index = np.array([float(number) for number, _ in times])
    except ValueError:
        index = np.arange(float(len(times)))
    if rate_hz:
        return index / rate_hz
    try:
        return 1e-3 * np.array([float(text) for _, text in times])
    except ValueError:
        raise BadData(f"{path}: neither frameRate nor each frame's time is there; one of the two is needed") from None
