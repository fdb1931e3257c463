"""Small well-formed files of every kind that is parsed; fuzzing begins with them."""

from __future__ import annotations

import io
import json
import tempfile
from pathlib import Path

import device_files as df
import numpy as np
import polars as pl
from mcap.writer import Writer
from scipy.io import savemat

import wepose_pin

N = 12
TIME = np.arange(N) / 100.0
GYRO = np.column_stack([0.1 * np.sin(9 * TIME), 0.2 * TIME, np.zeros(N)])
ACCEL = np.tile([0.1, 0.0, 9.8], (N, 1))
QUAT = np.tile([0.0, 0.6, 0.0, 0.8], (N, 1))  # xyzw
NAMES = [f"{kind}{axis}" for kind in "ga" for axis in "xyz"]

SESSION = """name = "small"
start_pose = "n_pose"
[data]
file = "arm.csv"
time = "time"
gyro_unit = "rad/s"
accel_unit = "m/s^2"
[phases]
start = [[0.01, 0.1]]
[sensors.torso]
gyro = ["gx", "gy", "gz"]
accel = ["ax", "ay", "az"]
mount = { up = "+z", forward = "+x" }
[sensors.left_forearm]
file = "arm.parquet"
rate_hz = 100.0
offset_s = 0.001
orientation = ["qx", "qy", "qz", "qw"]
"""
URDF = """<?xml version="1.0"?>
<robot name="arm"><material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
<link name="base"/><link name="upper"><inertial><origin xyz="0 0 -0.1" rpy="0 0 0"/><mass value="2"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
<visual><geometry><box size="0.1 0.1 0.3"/></geometry><material name="grey"/></visual></link><link name="tool"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0.1 1" rpy="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="10" velocity="3"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="tool"/><axis xyz="0 0 1"/>
<mimic joint="shoulder" multiplier="1" offset="0"/></joint></robot>
"""
# An arm as retargeting takes it, of three joints, and its map.
ARM = """<robot name="arm">
<link name="base"><collision><geometry><box size="0.2 0.3 0.6"/></geometry></collision></link>
<link name="upper"><collision><origin xyz="0 0 -0.15"/><geometry><cylinder radius="0.03" length="0.2"/></geometry>
</collision></link>
<link name="fore"><collision><origin xyz="0 0 -0.15"/><geometry><sphere radius="0.04"/></geometry></collision></link>
<link name="hand"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 -0.4 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="3" effort="9"/></joint>
<joint name="j2" type="continuous"><parent link="upper"/><child link="fore"/><origin xyz="0 0 -0.3"/>
<axis xyz="0 1 0"/><limit velocity="3" effort="9"/></joint>
<joint name="j3" type="revolute"><parent link="fore"/><child link="hand"/><origin xyz="0 0 -0.3"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="3" effort="9"/></joint></robot>
"""
ARM_MAP = b"""format = 1
urdf = "arm.urdf"
base = "base"
up = "+z"
forward = "+x"
[rest]
j1 = 0.1
[limits.acceleration]
j1 = 9.0
j2 = 9.0
j3 = 9.0
[arms.right]
joints = ["j1", "j2", "j3"]
shoulder = { link = "upper" }
elbow = { link = "fore" }
hand = { link = "hand", offset = [0.0, 0.0, -0.1], fingers = "-z", thumb = "+x" }
"""


def table() -> pl.DataFrame:
    columns = dict(zip(NAMES, np.column_stack([GYRO, ACCEL]).T, strict=True))
    return pl.DataFrame({"time": TIME, **columns, **dict(zip(("qx", "qy", "qz", "qw"), QUAT.T, strict=True))})


def csv() -> bytes:
    return table().write_csv().encode()


def parquet() -> bytes:
    out = io.BytesIO()
    table().write_parquet(out)
    return out.getvalue()


def mat() -> bytes:
    out = io.BytesIO()
    imu = {"torso": {"gyro": GYRO, "accel": ACCEL}}
    savemat(out, {"imu": imu, "clock": {"time": TIME}, "q": QUAT, "note": "a"})
    return out.getvalue()


def rows(*columns: np.ndarray, separator: str = ",") -> str:
    def text(value: float) -> str:
        return f"{value:.9g}" if abs(value) < 1e9 else f"{value:.0f}"  # microseconds since 1970 are whole

    return "".join(separator.join(map(text, row)) + "\n" for row in np.column_stack(columns))


def wild_csv() -> bytes:
    """As a spreadsheet writes it: remarks, semicolons, decimal commas, units in a line of their own."""
    units = ";".join(["s", *["rad/s"] * 3, *["m/s^2"] * 3])
    return f"remark;1\n\n{';'.join(['time', *NAMES])}\n{units}\n{tabled(';', ',', TIME, GYRO, ACCEL)}".encode()


def tabled(separator: str, decimal: str, *columns: np.ndarray) -> str:
    return rows(*columns).replace(",", separator).replace(".", decimal)


def trc() -> bytes:
    names = "\t\t\t".join(("LSHO", "RSHO", "LELB"))
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"
    head = f"PathFileType\t4\t(X/Y/Z)\ta.trc\n{keys}\n100\t100\t{N}\t3\tmm\nFrame#\tTime\t{names}\n\t\tX1\n"
    return (head + tabled("\t", ".", np.arange(N), TIME, 100 * ACCEL, 90 * ACCEL, 50 * ACCEL)).encode()


def live_log() -> bytes:
    """A live session of one sensor: a start pose of half a second, and as much after it; without chunks."""
    stream = io.BytesIO()
    writer = Writer(stream, use_chunking=False)
    header = {
        **{"format": 3, "name": "live", "sensors": ["torso"], "mounts": {"torso": [0.0, 0.0, 0.0, 1.0]}, "phases": {}},
        **{"start_pose": "n_pose", "remounted": False, "subject": None, "method": "amekf"},
    }
    writer.start("wepose-live", "seeds")
    writer.add_metadata("wepose", {"json": json.dumps(header)})
    channels = {topic: writer.register_channel(topic, "json", 0) for topic in ("/sensors/torso", "/events", "/pose")}

    def add(topic: str, **values: object) -> None:
        writer.add_message(channels[topic], 0, json.dumps(values).encode(), 0)

    add("/events", kind="clock", rate_hz=100.0, begin=0.0, wait_s=0.5)
    for k in range(100):
        add("/sensors/torso", t=k / 100.0, gyro=[0.0, 0.0, 0.0], accel=[0.0, 0.0, 9.8])
    add("/events", kind="start", begin=0, end=50)
    for tick in (51, 52):
        add("/pose", tick=tick, quat_WL={"torso": [0.0, 0.0, 0.0, 1.0]})
    add("/events", kind="reset", tick=60)
    writer.finish()
    return stream.getvalue()


def datagrams() -> list[bytes]:
    one = {"sensor": "torso", "t": 12.345, "gyro": [0.1, -0.2, 0.3], "accel": [0.0, 0.5, 9.81]}
    two = {"sensor": "head", "t": [1, 2.5], "gyro": [[0.1, 0, 0], [0, 0, 1]], "accel": [[0, 0, 9], [0, 0, 9]]}
    return [json.dumps(one).encode(), "\n".join(json.dumps(message) for message in (one, two)).encode()]


def pose() -> bytes:
    names = [f"torso_q{axis}" for axis in "xyzw"] + [
        "torso_std",
        *(f"left_palm_{axis}" for axis in "xyz"),
        "left_palm_std",
    ]
    values = np.column_stack([QUAT, np.full(N, 0.01), ACCEL / 10, np.full(N, 0.02)])
    out = io.BytesIO()
    pl.DataFrame({"time": TIME, **dict(zip(names, values.T, strict=True))}).write_parquet(out)
    return out.getvalue()


def subject() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        own = wepose_pin.population_subject().save(Path(folder) / "subject.toml").read_bytes()
    return own + (
        b"[mounts.torso]\nqx = 0.0\nqy = 0.0\nqz = 0.0\nqw = 1.0\n"
        b"[hinges.left_elbow]\nx = 0.0\ny = 1.0\nz = 0.0\nstd_deg = 5.0\n"
        b"[start_pose_offset.torso]\nx_deg = 1.0\ny_deg = 2.0\nstd_deg = 1.0\n"
        b"[heading_drift.torso]\nrate_deg_min = 1.0\nstd_deg_min = 2.0\n"
    )


def shipped(*names: str) -> list[bytes]:
    """Files of ours, as they are."""
    return [(Path(wepose_pin.__file__).parents[1] / name).read_bytes() for name in names]


def device(format: str) -> bytes:
    """A file of a maker, of which forty rows say enough."""
    with tempfile.TemporaryDirectory() as folder:
        path = df.mvnx(Path(folder), df.turning(), raw=True) if format == "mvnx" else df.make(format, Path(folder))
        data = path.read_bytes()
    return data if format in ("xdf", "mvnx") else b"".join(data.splitlines(keepends=True)[:50])


def increments() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        data = df.dot(Path(folder) / "a.csv", "increments").read_bytes()
    return b"".join(data.splitlines(keepends=True)[:50])


# What wepose wrote --------------------------------------------------------------------------------------------------


def pose_csv() -> bytes:
    """A whole body's pose: both arms, as `wepose track` writes it."""
    segments = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
    points = [f"{side}_{point}" for side in ("left", "right") for point in ("shoulder", "elbow", "wrist", "palm")]
    columns: dict[str, np.ndarray] = {"time": TIME}
    for segment in segments:
        columns |= {f"{segment}_q{axis}": QUAT[:, j] for j, axis in enumerate("xyzw")}
        columns[f"{segment}_std"] = np.full(N, 0.01)
    for point in points:
        columns |= {f"{point}_{axis}": TIME for axis in "xyz"} | {f"{point}_std": np.full(N, 0.01)}
    return pl.DataFrame(columns).head(4).write_csv().encode()
