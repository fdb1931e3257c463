"""Xsens MVNX: what MVN Studio and MVN Analyze export as XML, versions 2 to 4.

Each frame of type `normal` holds the segments' orientations (w x y z, to a world with z up) and, in exports before MVN
2018, the sensors' `sensorAcceleration` [m/s²] and `sensorAngularVelocity` [rad/s]. An Xsens segment's frame is the
world's (x forward, y left, z up) in the T-pose with palms down; ours is in the N-pose, an arm's thus a quarter turn
about x away.

Source: MVN User Manual, MVNX structure; the frames `identity` and `tpose` of exported files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import so3
from ..errors import BadData, MissingFile
from .device import Device, must_be_measured, table_of

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
WIDTH = {"orientation": 4, "sensorAngularVelocity": 3, "sensorAcceleration": 3}


class Frames(NamedTuple):
    """What the frames of a file say, as it stands there."""

    time: np.ndarray  # (n,) [s]
    segments: list[str]
    sensors: list[str]
    values: dict[str, np.ndarray]  # element → (n, count, width)


def read_mvnx(path: Path, use: str | None = None) -> Device:
    """The sensors' raw data where the file has them, else the segments' orientations; `use` asks for one of the two.

    Raises
    ------
    MissingFile, BadData
        Not there; no MVNX, damaged, cut off, or without what `use` asks for.
    """
    frames = read_frames(path)
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
        values = {
            label: {"orientation": _segment_quat(label, quat[:, k])}
            for k, label in enumerate(frames.segments)
            if label in SEGMENT_OF
        }
    if not values:
        found = ", ".join(frames.segments[:12])
        raise BadData(f"{path}: none of the upper body's segments, such as T8; there is: {found}")
    return Device(
        "mvnx",
        table_of(frames.time, values),
        {label: SEGMENT_OF[label] for label in values},
        "raw" if raw and use != "orientation" else "orientation",
        aligned=not raw or use == "orientation",
    )


def _segment_quat(label: str, quat_WB: np.ndarray) -> np.ndarray:
    """`quat_WL` (n, 4) xyzw of our frame from Xsens's (n, 4) wxyz; rows of zeros or NaN become NaN."""
    quat = so3.xyzw_from_wxyz(quat_WB)
    good = np.isfinite(quat).all(axis=1) & (np.linalg.norm(np.nan_to_num(quat), axis=1) > 0.5)
    turned = np.full(quat.shape, np.nan)
    side = SEGMENT_OF[label].partition("_")[0]
    R_BL = Rotation.from_rotvec([_QUARTER.get(side, 0.0), 0.0, 0.0])
    turned[good] = (Rotation.from_quat(quat[good]) * R_BL).as_quat()
    return turned


def read_frames(path: Path) -> Frames:
    """All frames of type `normal`.

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
    rate_hz = 0.0
    try:
        with path.open("rb") as file:
            # Nothing is expanded and nothing fetched: a file can neither grow in memory nor name others.
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
                    if name == "subject":
                        rate_hz = _number(path, element, "frameRate")
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
        tag: _values(path, tag, rows, len(segments) if tag == "orientation" else len(sensors), len(times))
        for tag, rows in texts.items()
    }
    return Frames(_times(path, times, rate_hz), segments, sensors, values)


def _name(element: Any) -> str:
    """An element's name without its namespace; none for comments and the like."""
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
    """(frames, count, width) of an element's numbers."""
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
    must_be_measured(path, values, f"<{tag}>")
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
