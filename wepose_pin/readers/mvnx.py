"""Xsens MVNX, the XML export of MVN Studio and MVN Analyze, versions 2 to 4.

Each frame of type `normal` holds the segments' orientations (w x y z, to a world with z up) and, in exports before MVN
2018, the sensors' `sensorAcceleration` [m/s²] and `sensorAngularVelocity` [rad/s]. An Xsens segment's frame is the
world's (x forward, y left, z up) in the T-pose with palms down; ours is in the N-pose, an arm's thus a quarter turn
about x away. Some exports (MVN 4.2) refer the arms to the N-pose, as we do. Which of the two it is, the segments'
positions in the same frames say: from joint to joint an arm's segment lies along y of its frame, or along −z.

Source: MVN User Manual, MVNX structure; the frames `identity` and `tpose` of exported files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, MissingFile
from ..model import load_table
from ..model.table import ROOT
from .device import Device, check_measured, make_table
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
# R_BL, our segment frame in Xsens's: arms fall from the T-pose to the N-pose by a quarter turn about x.
_QUARTER = {"left": 0.5 * np.pi, "right": -0.5 * np.pi}
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


def read_mvnx(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' raw data where the file has them, else the segments' orientations; `use` selects one.

    `rate_hz` goes before the file's frameRate.

    Raises
    ------
    MissingFile, BadData
        Not there; no MVNX, damaged, cut off, or without what `use` asks for; arms whose frames fit neither pose.
    """
    frames = read_frames(path, rate_hz)
    assumed: tuple[Diagnostic, ...] = ()
    raw = {"sensorAngularVelocity", "sensorAcceleration"} <= set(frames.values)
    if use == "raw" and not raw:
        raise BadData(
            f"{path}: no sensorAngularVelocity and sensorAcceleration; MVN writes them no more since 2018. Leave out "
            f"data.use, and its segments' orientations are read"
        )
    if raw and use != "orientation":
        gyro, accel = frames.values["sensorAngularVelocity"], frames.values["sensorAcceleration"]
        values = {
            label: {"gyro": gyro[:, k], "accel": accel[:, k]}
            for k, label in enumerate(frames.sensors)
            if label in SEGMENT_OF
        }
    else:
        quat = frames.values["orientation"]
        pose = _reference_pose(path, frames)
        if pose is None:
            assumed = (Diagnostic("arm-frames-assumed", WARNING, path.name),)
        values = {
            label: {"orientation": _segment_quat(label, quat[:, k], pose or "T")}
            for k, label in enumerate(frames.segments)
            if label in SEGMENT_OF
        }
    if not values:
        listed = ", ".join(frames.segments[:12])
        raise BadData(f"{path}: none of the upper body's segments, such as T8; there is: {listed}")
    return Device(
        "mvnx",
        make_table(frames.time, values),
        {label: SEGMENT_OF[label] for label in values},
        "raw" if raw and use != "orientation" else "orientation",
        aligned=not raw or use == "orientation",
        diagnostics=assumed,
    )


def read_mvnx_reference(path: Path) -> Reference:
    """Read the segments' orientations and joints as a reference; its world has z up.

    Raises
    ------
    MissingFile, BadData
        As `read_mvnx`.
    """
    frames = read_frames(path)
    pose = _reference_pose(path, frames) or "T"
    quats = {
        SEGMENT_OF[label]: _segment_quat(label, frames.values["orientation"][:, k], pose)
        for k, label in enumerate(frames.segments)
        if label in SEGMENT_OF
    }
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


def _reference_pose(path: Path, frames: Frames) -> str | None:
    """The pose, "T" or "N", in which the frames of the arms' segments are the world's; None without their positions.

    Raises
    ------
    BadData
        A segment's axis fits neither, or another one's says otherwise.
    """
    if "position" not in frames.values:
        return None
    at = {label: k for k, label in enumerate(frames.segments)}
    poses = {}
    for label, end in ARM.items():
        if label not in at or end not in at:
            continue
        quat = rotations.xyzw_from_wxyz(frames.values["orientation"][:, at[label]])
        along_W = frames.values["position"][:, at[end]] - frames.values["position"][:, at[label]]
        good = np.isfinite(quat).all(axis=1) & (np.linalg.norm(np.nan_to_num(quat), axis=1) > 0.5)
        good &= np.linalg.norm(np.nan_to_num(along_W), axis=1) > 1e-3
        if not good.any():
            continue
        along_B = np.median(Rotation.from_quat(quat[good]).inv().apply(along_W[good]), axis=0)
        along_B /= np.linalg.norm(along_B)
        axes = {"T": [0.0, 1.0 if label.startswith("Left") else -1.0, 0.0], "N": [0.0, 0.0, -1.0]}
        off = {pose: float(np.degrees(np.arccos(np.clip(along_B @ axis, -1.0, 1.0)))) for pose, axis in axes.items()}
        poses[label] = min(off, key=lambda pose: off[pose])
        if off[poses[label]] > ALONG_DEG:
            raise BadData(
                f"{path}: by its <position> and {end}'s, {label} lies {off['T']:.0f} deg off y of its frame (as in the "
                f"T-pose) and {off['N']:.0f} deg off -z (N-pose); its orientations are of neither and are not read"
            )
    if len(set(poses.values())) > 1:
        names = ", ".join(f"{label} {pose}-pose" for label, pose in poses.items())
        raise BadData(
            f"{path}: the arms' frames are the world's in two poses: {names}; export it again, with one of them"
        )
    return next(iter(poses.values()), None)


def _segment_quat(label: str, quat_WB: np.ndarray, pose: str) -> np.ndarray:
    """`quat_WL` (n, 4) xyzw of our frame from Xsens's (n, 4) wxyz, an arm's being the world's in the T- or N-pose.

    Rows of zeros or NaN become NaN.
    """
    quat = rotations.xyzw_from_wxyz(quat_WB)
    good = np.isfinite(quat).all(axis=1) & (np.linalg.norm(np.nan_to_num(quat), axis=1) > 0.5)
    turned = np.full(quat.shape, np.nan)
    side = SEGMENT_OF[label].partition("_")[0]
    R_BL = Rotation.from_rotvec([_QUARTER.get(side, 0.0) if pose == "T" else 0.0, 0.0, 0.0])
    turned[good] = (Rotation.from_quat(quat[good]) * R_BL).as_quat()
    return turned


def read_frames(path: Path, rate_hz: float | None = None) -> Frames:
    """Read all frames of type `normal`; `rate_hz` replaces the file's frameRate.

    Raises
    ------
    MissingFile, BadData
        Not there; no MVNX, damaged or cut off; frames of unlike size; entities, which MVNX has no use for.
    """
    from lxml import etree

    segments: list[str] = []
    sensors: list[str] = []
    times: list[tuple[str, str]] = []
    texts: dict[str, list[str]] = {}
    own_rate_hz = 0.0
    try:
        with path.open("rb") as file:
            # Entities are not expanded and other files not fetched, so that a file cannot grow in memory.
            events = etree.iterparse(
                file, events=("start", "end"), resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False
            )
            root = None
            for event, element in events:
                if root is None:
                    root = element
                    _check_root(path, root)
                name = _name(element)
                if event == "start":
                    if name == "subject" and rate_hz is None:
                        own_rate_hz = _number(path, element, "frameRate")
                elif name in ("segment", "sensor") and element.get("label"):
                    (segments if name == "segment" else sensors).append(element.get("label"))
                elif name == "frame":
                    if element.get("type", "normal") == "normal":
                        times.append((element.get("index", ""), element.get("time", "")))
                        for child in element:
                            if (tag := _name(child)) in WIDTH:
                                texts.setdefault(tag, []).append(child.text or "")
                    element.clear()
                    while element.getprevious() is not None:
                        del element.getparent()[0]
    except OSError:
        raise MissingFile(f"{path}: no such file, or it cannot be read; an .mvnx file is wanted here") from None
    except etree.XMLSyntaxError as error:
        read = f" after {len(times)} frames" if times else ""
        raise BadData(
            f"{path}: is damaged or cut off in line {error.lineno}{read}: {' '.join((error.msg or 'no XML').split())}; "
            f"export it again"
        ) from error
    if len(times) < 2:
        raise BadData(f"{path}: {len(times)} frames of type 'normal'; a recording has at least 2")
    if "orientation" not in texts:
        raise BadData(f"{path}: its frames hold no <orientation>; export it with the segments' orientations")
    values = {
        tag: _values(path, tag, rows, len(segments) if tag in ("orientation", "position") else len(sensors), len(times))
        for tag, rows in texts.items()
    }
    return Frames(_times(path, times, rate_hz or own_rate_hz), segments, sensors, values)


def _name(element: Any) -> str:
    """Return an element's name without its namespace; empty for comments and the like."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _check_root(path: Path, root: Any) -> None:
    if _name(root) != "mvnx":
        raise BadData(f"{path}: is XML, but no MVNX: its root is <{_name(root)}>, not <mvnx>")
    dtd = root.getroottree().docinfo.internalDTD
    if dtd is not None and any(True for _ in dtd.iterentities()):
        raise BadData(f"{path}: declares entities (<!ENTITY …>), which no MVNX has; it is not read")


def _number(path: Path, element: Any, name: str) -> float:
    text = element.get(name, "")
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1.0 <= value <= 10000.0:
        raise BadData(f"{path}: subject {name}='{text}' is no rate; frames a second are needed there")
    return value


def _values(path: Path, tag: str, rows: list[str], count: int, frames: int) -> np.ndarray:
    """Read an element's numbers (frames, count, width)."""
    size = WIDTH[tag] * count
    if len(rows) != frames:
        raise BadData(f"{path}: <{tag}> stands in {len(rows)} of {frames} frames; it is needed in all")
    values = np.empty((frames, size))
    for k, text in enumerate(rows):
        try:
            row = np.array(text.split(), dtype=float)
        except ValueError:
            raise BadData(f"{path}: <{tag}> of frame {k} holds something else than numbers: '{text[:40]}'") from None
        if len(row) != size:
            raise BadData(
                f"{path}: <{tag}> of frame {k} holds {len(row)} numbers; {WIDTH[tag]} for each of {count} are needed"
            )
        values[k] = row
    check_measured(path, values, f"<{tag}>")
    return values.reshape(frames, count, WIDTH[tag])


def _times(path: Path, times: list[tuple[str, str]], rate_hz: float) -> np.ndarray:
    """Times (n,) [s]: the frames' numbers over the rate, as `time` is cut to milliseconds."""
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
