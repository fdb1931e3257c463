"""C3D, markers and rotations as optical systems write them: a reference for `wepose evaluate`.

Points in POINT:UNITS at POINT:RATE; a residual below 0, NaN or zeros mark a missing one. Labels lose a subject before a
colon. Rotations (HAS-Motion's extension, as Theia3D writes it) are 4×4 transforms of a segment to the laboratory at
ROTATION:RATE, labelled ``l_uarm_4X4``, or ``left_upper_arm_4X4`` by `wepose export`. Numbers are those of Intel, DEC or
MIPS.

Source: The C3D File Format user guide (c3d.org); HAS-Motion's description of ROTATION.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadData, MissingFile, one_of
from .device import check_measured
from .markers import MarkerTable, Reference, locate

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "meters": 1.0, "millimeters": 1e-3}
BLOCK = 512
_KEY = 0x50  # byte 2 of each C3D
INTEL, DEC, MIPS = 84, 85, 86
_TYPES = {-1: 1, 1: 1, 2: 2, 4: 4}  # bytes of a value


@dataclass(frozen=True)
class _C3d:
    """The contents of a file: its bytes, the processor that wrote it, and parameters as ``POINT:RATE``."""

    path: Path
    raw: bytes
    processor: int
    parameters: Mapping[str, list[float] | list[str]]

    def number(self, name: str, default: float = 0.0) -> float:
        """Return the first value of a parameter."""
        value = self.parameters.get(name, [])
        return float(value[0]) if value and not isinstance(value[0], str) else default

    def texts(self, name: str) -> list[str]:
        """Return the texts of a parameter; more than 255 labels go on in LABELS2 and so on."""
        names = [f"{name}{suffix}" for suffix in ("", *range(2, 17))]
        return [text for each in names for text in self.parameters.get(each, []) if isinstance(text, str)]

    def values(self, kind: str, block: int, count: int) -> np.ndarray:
        """Read `count` numbers (i2 or f4) from a block on."""
        size = int(kind[1]) * count
        data = self.raw[BLOCK * (block - 1) : BLOCK * (block - 1) + size]
        if block < 2 or len(data) < size:
            raise BadData(f"{self.path}: is cut off: {len(data)} of {size} bytes of data are there; copy it again")
        return _convert(data, kind, self.processor)


def read_c3d(path: Path, table: MarkerTable) -> Reference:
    """Read the joints and segments that follow from the markers, or the segments that the file has.

    Raises
    ------
    MissingFile, BadData
        Not there; no C3D, damaged or cut off; RATE 0; neither points nor rotations; an unknown unit; no marker that the
        table knows.
    """
    file = _open(path)
    if file.number("ROTATION:USED") <= 0:
        return locate(path, *_read_markers(file), table)
    reference = _read_rotations(file, table)
    if file.number("POINT:USED") >= 1 and len(reference.time) == _count_frames(file):
        time, markers = _read_markers(file)
        with contextlib.suppress(BadData):  # markers of which no joint follows
            reference = reference._replace(points=locate(path, time, markers, table).points)
    return reference


def _read_markers(file: _C3d) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Read times (n,) [s] and marker → (n, 3) [m]."""
    path = file.path
    labels = [label.rpartition(":")[2].strip() for label in file.texts("POINT:LABELS")]
    used, frames = int(file.number("POINT:USED")), _count_frames(file)
    if used < 1 or not labels:
        raise BadData(f"{path}: neither points nor rotations in it; export the markers")
    units = {text.strip().lower() for text in file.texts("POINT:UNITS") if text.strip()}
    if len(units) != 1 or not units <= set(UNITS):
        raise BadData(f"{path}: POINT:UNITS is {', '.join(sorted(units)) or 'missing'}; {one_of(UNITS)}")
    time = np.arange(frames) / _find_rate(file, "POINT")
    metres = UNITS[units.pop()] * _read_points(file, used, frames)
    check_measured(path, np.nan_to_num(metres.reshape(frames, -1)), "a marker")
    return time, {name: metres[:, k] for k, name in enumerate(labels[:used])}


def _open(path: Path) -> _C3d:
    """Read the header and the parameters."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise MissingFile(f"{path}: cannot be read: {error.strerror}") from error
    if len(raw) < 2 * BLOCK or raw[1] != _KEY:
        raise BadData(
            f"{path}: is no C3D: {'it is too short' if len(raw) < 2 * BLOCK else 'its second byte is not 0x50'}"
        )
    at = BLOCK * (raw[0] - 1)
    if not 0 < at < len(raw) - 4 or raw[at + 3] not in (INTEL, DEC, MIPS):
        raise BadData(f"{path}: is a damaged C3D: its parameters begin at no processor's number (84 to 86)")
    try:
        return _C3d(path, raw, raw[at + 3], _read_parameters(raw, at + 4, raw[at + 3]))
    except (struct.error, IndexError, ValueError) as error:
        raise BadData(f"{path}: is a damaged C3D: its parameters cannot be read: {error}") from error


def _read_parameters(raw: bytes, at: int, processor: int) -> dict[str, list[float] | list[str]]:
    """Read the parameters from a byte on; group:name → values."""
    groups: dict[int, str] = {}
    parameters: list[tuple[int, str, list[float] | list[str]]] = []
    order = ">" if processor == MIPS else "<"
    while at + 2 < len(raw) and raw[at]:
        length, group = struct.unpack_from("bb", raw, at)
        name = raw[at + 2 : at + 2 + abs(length)].decode("latin-1").upper()
        at += 2 + abs(length)
        (offset,) = struct.unpack_from(f"{order}h", raw, at)
        if group < 0:
            groups[-group] = name
        else:
            kind, rank = struct.unpack_from("bB", raw, at + 2)
            shape = list(raw[at + 4 : at + 4 + rank])
            count = int(np.prod(shape, dtype=int)) if rank else 1
            data = raw[at + 4 + rank : at + 4 + rank + count * _TYPES.get(kind, 1)]
            parameters.append((group, name, _parse_values(data, kind, shape, processor)))
        if not offset:
            break
        if offset < 0:
            raise ValueError(f"{name} leads back")
        at += offset
    return {f"{groups.get(group, '')}:{name}": values for group, name, values in parameters}


def _parse_values(data: bytes, kind: int, shape: list[int], processor: int) -> list[float] | list[str]:
    if kind == -1:
        width = shape[0] if shape else 1
        return [data[k : k + width].decode("latin-1").strip(" \0") for k in range(0, len(data), max(width, 1))]
    if kind == 1:
        return [float(byte) for byte in data]
    return [float(value) for value in _convert(data, "f4" if kind == 4 else "i2", processor)]


def _convert(data: bytes, kind: str, processor: int) -> np.ndarray:
    """Convert bytes of a processor to numbers (n,)."""
    if processor == DEC and kind == "f4":  # the words are swapped, and the exponent counts two more
        words = np.frombuffer(data, dtype="<u2").astype(np.uint32)
        return (words[0::2] << 16 | words[1::2]).astype(np.uint32).view(np.float32).astype(float) / 4.0
    return np.frombuffer(data, dtype=f"{'>' if processor == MIPS else '<'}{kind}").astype(float)


def _count_frames(file: _C3d) -> int:
    """Count the frames: more than 65535 are in TRIAL, as two words each."""
    order = ">" if file.processor == MIPS else "<"
    first, last = struct.unpack_from(f"{order}HH", file.raw, 6)
    ends = [file.parameters.get(f"TRIAL:ACTUAL_{name}_FIELD", []) for name in ("START", "END")]
    if all(len(words) == 2 for words in ends):
        first, last = (int(float(words[0])) % 65536 + 65536 * (int(float(words[1])) % 65536) for words in ends)
    frames = last - first + 1
    if frames < 2:
        raise BadData(f"{file.path}: {frames} frames; a recording has at least 2")
    return int(frames)


def _find_rate(file: _C3d, group: str) -> float:
    rate_hz = file.number(f"{group}:RATE")
    if not 1.0 <= rate_hz <= 1e5:
        raise BadData(f"{file.path}: {group}:RATE is {rate_hz:g}; frames a second are needed there")
    return rate_hz


def _read_points(file: _C3d, used: int, frames: int) -> np.ndarray:
    """Read the points (frames, used, 3) in the file's unit; NaN where missing."""
    order = ">" if file.processor == MIPS else "<"
    (analog,) = struct.unpack_from(f"{order}H", file.raw, 4)  # numbers of analog channels in a frame
    (block,) = struct.unpack_from(f"{order}H", file.raw, 16)
    scale = file.number("POINT:SCALE", -1.0)
    width = 4 * used + analog
    rows = file.values("f4" if scale < 0.0 else "i2", block, frames * width).reshape(frames, width)
    points = rows[:, : 4 * used].reshape(frames, used, 4)
    places = points[:, :, :3] * (1.0 if scale < 0.0 else scale)
    seen = np.isfinite(points).all(axis=2) & (points[:, :, 3] >= 0.0) & (places != 0.0).any(axis=2)
    return np.where(seen[:, :, None], places, np.nan)


def _read_rotations(file: _C3d, table: MarkerTable) -> Reference:
    """Read the segments' orientations among the rotations, each 4×4 numbers by columns and a reliability."""
    used = int(file.number("ROTATION:USED"))
    labels = [label.removesuffix("_4X4") for label in file.texts("ROTATION:LABELS")]
    rate_hz = file.number("POINT:RATE") * (file.number("ROTATION:RATIO") or 1.0)
    rate_hz = _find_rate(file, "ROTATION") if file.number("ROTATION:RATE") else rate_hz
    if not 1.0 <= rate_hz <= 1e5:
        raise BadData(f"{file.path}: ROTATION:RATE is {rate_hz:g}; frames a second are needed there")
    frames = int(file.number("ROTATION:FRAMES")) or _count_frames(file) * int(file.number("ROTATION:RATIO") or 1)
    values = file.values("f4", int(file.number("ROTATION:DATA_START")), 17 * used * frames).reshape(frames, used, 17)
    quats = {}
    for segment, name in table.rotations.items():
        label = next((each for each in (name, segment) if each in labels[:used]), None)
        if label is not None:
            R = values[:, labels.index(label), :16].reshape(frames, 4, 4).transpose(0, 2, 1)[:, :3, :3]
            good = np.isfinite(R).all(axis=(1, 2))
            good &= np.abs(np.linalg.det(np.where(good[:, None, None], R, 0.0)) - 1.0) < 0.01
            quats[segment] = np.full((frames, 4), np.nan)
            if good.any():
                quats[segment][good] = Rotation.from_matrix(R[good]).as_quat()
    if not quats:
        listed = ", ".join(labels[:8]) or "without labels"
        raise BadData(f"{file.path}: its rotations are of no known segment ({listed}); name them under --markers")
    return Reference(np.arange(frames) / rate_hz, quats, {}, own_frames=True)
