"""Real recordings of sensors with a truth: BROAD's trials, the paper authors' own, the RING chain, a UR5 arm.

How exact the truths are. BROAD: optical, on the sensor's clock and in its frame, by its authors. The authors' trial:
Vicon, some 63 new poses a second; its world leans by degrees. RING: optical, 30 Hz; the markers stand to 0.4 µm in
their segment, that is they were written from fitted rigid bodies and say nothing of their noise, but the hinges do:
what turns about other axes is 0.2 to 0.4 deg, neighbours' joint centres agree to 0.4 to 1.6 mm; its world leans by
0.9 deg. UR5: encoders, some 0.01 deg, but the arm flexes beyond them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin import rotations
from wepose_pin.data_tables import read_columns, read_table
from wepose_pin.filters import BEST, Orientation, SensorFilters
from wepose_pin.filters.phases import SensorNoise
from wepose_pin.readers.arrays import read_mat
from wepose_pin.recording import ImuSensor, Recording

RING_SEGMENTS = ("seg1", "seg2", "seg3", "seg4", "seg5")
RING = Path("ring") / "trial1"
RING_FILES = {"rigid": "imu_rigid.csv", "loose": "imu_nonrigid.csv"}  # by mount
RING_MOUNTS = tuple(RING_FILES)


class Trial(NamedTuple):
    """One sensor, its data and the truth."""

    name: str
    rate_hz: float
    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s²]
    quat_true: np.ndarray  # (n, 4) xyzw, sensor to the truth's world; NaN where missing
    static: slice  # samples before the motion, in which the sensor is static
    scored: np.ndarray  # (n,) bool, samples that count and have a truth


def read_broad(path: Path) -> Trial:
    """Read a trial of the BROAD benchmark, a ``.mat`` file (Laidig et al. 2021, doi 10.3390/data6070072)."""
    mat = read_mat(path)
    gyro, accel, true = (np.ascontiguousarray(mat[f"/{key}"]) for key in ("imu_gyr", "imu_acc", "opt_quat"))
    rate_hz, moving = float(mat["/sampling_rate"]), mat["/movement"].astype(bool)
    true = rotations.xyzw_from_wxyz(true)
    begin, second = int(np.argmax(moving)), round(rate_hz)
    seen = np.isfinite(true).all(axis=1)
    return Trial(path.stem, rate_hz, gyro, accel, true, slice(second, begin - second), moving & seen)


def read_authors_trial(path: Path) -> Trial:
    """Read the paper authors' trial ``prova_HR.txt``: 1 kHz, static for a second, then motion with Vicon.

    Columns: time [1e-4 s], gyro [rad/s], accel [m/s²], 3 empty, 4 unused, Vicon quaternion x y z w (zeros before it
    begins), Vicon position [mm].
    """
    rows = [line.replace(";", "").split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    table = np.array(rows, dtype=float)
    true = table[:, 14:18].copy()
    seen = np.linalg.norm(true, axis=1) > 0.5
    true[~seen] = np.nan
    gyro, accel = np.ascontiguousarray(table[:, 1:4]), np.ascontiguousarray(table[:, 4:7])
    return Trial(path.stem, 1000.0, gyro, accel, true, slice(50, 901), seen)


class Referenced(NamedTuple):
    """One sensor on a body, and a reference of the body, which has its own clock, frame and world."""

    name: str
    rate_hz: float
    gyro_S: np.ndarray  # (n, 3) [rad/s]; sample k is at k / rate_hz of the sensor's clock
    accel_S: np.ndarray  # (n, 3) [m/s²]
    time: np.ndarray  # (m,) [s], the reference's clock
    quat_VB: np.ndarray  # (m, 4) xyzw, body to the reference's world V, z up apart from a tilt; NaN: missing
    static: slice  # samples before the motion, in which the sensor is static; empty where there are none


class Chain(NamedTuple):
    """The RING chain: five segments in a row, each with an IMU screwed on and one on foam.

    The frame of a segment has its origin at a marker near the joint to the one before, x along the link, z off the
    plane of the markers. seg1 to seg2 is a ball joint, then hinges about x (the link itself), y and z: the links' line
    runs along x, 17 mm below the origin.
    """

    sensors: dict[tuple[str, str], Referenced]  # by mount (of `RING_MOUNTS`) and segment
    time: np.ndarray  # (m,) [s], the optical clock
    origin_V: dict[str, np.ndarray]  # segment → (m, 3) [m], the segment's origin; NaN: missing
    quat_VB: dict[str, np.ndarray]  # segment → (m, 4) xyzw; NaN: missing


def list_ur5(data: Path) -> list[tuple[str, str]]:
    """List the recordings of a UR5 arm in ``ur5/``, recording and sensor: ``imu/RECORDING/SENSOR_adx.csv``."""
    files = sorted((data / "ur5" / "imu").glob("*/*_adx.csv"))
    return [(file.parent.name, file.stem.removesuffix("_adx")) for file in files]


def read_ring(folder: Path) -> Chain:
    """Read a trial of the RING chain: ``imu_rigid.csv``, ``imu_nonrigid.csv`` (40 Hz), ``omc.csv`` (30 Hz).

    The optical system lost all segments at once, some 0.35 s each two or three seconds. The file has straight lines in
    place of the markers there, NaN in place of the quaternions, but of one segment whose quaternions are made of those
    lines: what one segment lacks is taken for lost in all.
    """
    quat_VB, origin_V = {}, {}
    omc = folder / "omc.csv"
    table, rate_hz = read_table(omc), _stated_rate(omc)
    for segment, marker in zip(RING_SEGMENTS, (2, 2, 1, 2, 4), strict=True):  # the origins of arm.xml
        names = [f"{segment}_quat_{axis}" for axis in "wxyz"], [f"{segment}_marker{marker}_{axis}" for axis in "xyz"]
        quat_VB[segment] = rotations.xyzw_from_wxyz(read_columns(table, names[0], str(omc), segment))
        origin_V[segment] = read_columns(table, names[1], str(omc), segment)
    seen: np.ndarray = np.isfinite(np.stack([quat_VB[segment] for segment in RING_SEGMENTS])).all(axis=(0, 2))
    for segment in RING_SEGMENTS:
        quat_VB[segment][~seen] = np.nan
        origin_V[segment][~seen] = np.nan
    time = np.arange(len(seen)) / rate_hz
    sensors = {}
    for mount, file in RING_FILES.items():
        path = folder / file
        table, imu_hz = read_table(path), _stated_rate(path)
        for segment in RING_SEGMENTS:
            columns = ([f"{segment}_{kind}_{axis}" for axis in "xyz"] for kind in ("gyr", "acc"))
            gyro, accel = (read_columns(table, each, str(path), segment) for each in columns)
            name = f"{segment} {mount}"
            sensors[mount, segment] = Referenced(name, imu_hz, gyro, accel, time, quat_VB[segment], slice(0, 0))
    return Chain(sensors, time, origin_V, quat_VB)


def _stated_rate(path: Path) -> float:
    """Read the rate in the first line, ``# sampling frequency: 40``."""
    with path.open(encoding="utf-8") as lines:
        return float(lines.readline().partition("sampling frequency:")[2])


def read_ur5(data: Path, recording: str, sensor: str) -> Referenced:
    """Read an IMU on a UR5 arm, and the encoders' orientations of its link, of one of `list_ur5`.

    Line k of the one was taken with line k of the other, 125 times a second. The static phase ends 0.1 s before the
    body has turned by 0.3 deg (the encoders' own jitter is a tenth of that).
    """
    imu = data / "ur5" / "imu" / recording / f"{sensor}_adx.csv"
    encoder = data / "ur5" / "encoder" / recording / f"{sensor}.csv"
    measured, true = read_table(imu), read_table(encoder)
    names = ([f"{kind}_{axis}" for axis in "xyz"] for kind in ("gyr", "acc"))
    gyro, accel = (read_columns(measured, each, str(imu), sensor) for each in names)
    time = 1e-6 * read_columns(true, ["TIME"], str(encoder), sensor)[:, 0]
    quat_VB = rotations.xyzw_from_wxyz(read_columns(true, [f"QUATERNION_{k}" for k in range(4)], str(encoder), sensor))
    rate_hz = 1.0 / float(np.median(np.diff(time)))
    R_VB = Rotation.from_quat(quat_VB)
    turned = np.flatnonzero((R_VB[0].inv() * R_VB).magnitude() > np.deg2rad(0.3))
    static = slice(0, max(0, int(turned[0]) - round(0.1 * rate_hz)) if len(turned) else len(time))
    return Referenced(f"{recording} {sensor}", rate_hz, gyro, accel, time - time[0], quat_VB, static)


def run_filter(
    gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise, method: str = BEST, params: Any = None
) -> Orientation:
    """Return the orientations of one sensor, of checked arrays and known noise, from the first sample on."""
    recording = Recording("", np.empty(len(gyro_S)), rate_hz, {"": ImuSensor(gyro_S, accel_S)})
    return SensorFilters({"": noise}, method=method, params=params).push(recording)[""]
