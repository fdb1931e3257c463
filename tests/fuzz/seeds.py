"""Small well-formed files of every kind that is parsed; fuzzing begins with them."""

from __future__ import annotations

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import polars as pl
from scipy.io import savemat

from wepose_pin.assets import asset
from wepose_pin.live.sources import xbus
from wepose_pin.live.sources.packets import CRC, HEADER, MAGIC, SAMPLE
from wepose_pin.readers.live_log import BLOCK, EVENT, HEAD, POSES, SAMPLES
from wepose_pin.readers.live_log import MAGIC as LIVE_MAGIC
from wepose_pin.subject import average_subject, subject_toml

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


def table() -> pl.DataFrame:
    columns = dict(zip(NAMES, np.column_stack([GYRO, ACCEL]).T, strict=True))
    return pl.DataFrame({"time": TIME, **columns, **dict(zip(("qx", "qy", "qz", "qw"), QUAT.T, strict=True))})


def csv() -> bytes:
    return table().write_csv().encode()


def parquet() -> bytes:
    out = io.BytesIO()
    table().write_parquet(out)
    return out.getvalue()


def mat(compressed: bool) -> bytes:
    out = io.BytesIO()
    imu = {"torso": {"gyro": GYRO, "accel": ACCEL}}
    savemat(out, {"imu": imu, "clock": {"time": TIME}, "q": QUAT, "note": "a"}, do_compression=compressed)
    return out.getvalue()


def hdf5() -> bytes:
    import h5py

    out = io.BytesIO()
    with h5py.File(out, "w") as file:
        for name, values in {"imu/torso/gyro": GYRO, "imu/torso/accel": ACCEL, "clock/time": TIME, "q": QUAT}.items():
            file.create_dataset(name, data=values, compression="gzip" if name == "q" else None)
    return out.getvalue()


def rows(*columns: np.ndarray, separator: str = ",") -> str:
    return "".join(separator.join(f"{v:.9g}" for v in row) + "\n" for row in np.column_stack(columns))


def mvnx(raw: bool) -> bytes:
    more = "<sensorAcceleration>0 0 9.81</sensorAcceleration><sensorAngularVelocity>0.1 0 0</sensorAngularVelocity>"
    frame = '<frame time="{}" index="{}" type="{}"><orientation>1 0 0 0 0.8 0.6 0 0</orientation>{}</frame>'
    frames = frame.format(0, "", "tpose", "")
    frames += "".join(frame.format(10 * k, k, "normal", more if raw else "") for k in range(3))
    return (
        '<?xml version="1.0" encoding="UTF-8"?><mvnx version="4"><subject frameRate="100"><segments>'
        '<segment label="T8" id="1"/><segment label="LeftUpperArm" id="2"/></segments><sensors><sensor label="T8"/>'
        f"</sensors><frames>{frames}</frames></subject></mvnx>"
    ).encode()


def mt_manager() -> list[bytes]:
    head = "// Update Rate: 100.0Hz\n"
    counter = np.arange(N) + 65530.0
    raw = "\t".join(["PacketCounter", "SampleTimeFine", *(f"{k}_{a}" for k in ("Acc", "Gyr") for a in "XYZ")])
    quat = ";".join(["PacketCounter", "Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"])
    euler = ",".join(["PacketCounter", "SampleTimeFine", "Roll", "Pitch", "Yaw"])
    texts = (
        head + raw + "\n" + rows(counter % 65536, 100 * counter, ACCEL, GYRO, separator="\t"),
        head + quat + "\n" + rows(counter, QUAT[:, [3, 0, 1, 2]], separator=";").replace(".", ","),
        "// a: b\n" + euler + "\n" + rows(counter, 100 * counter, 10 * GYRO),
    )
    return [text.encode() for text in texts]


def dot() -> list[bytes]:
    head = "sep=,\nDeviceTag:,left_wrist\nSyncStatus:,Synced\nOutputRate:,100Hz\n\n"
    count, fine = np.arange(N), 10000 * np.arange(N) + 2**32 - 50000.0
    names = {
        "Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z": (ACCEL, GYRO),
        "dq_W,dq_X,dq_Y,dq_Z,dv[1],dv[2],dv[3]": (np.tile([1.0, 0.0, 0.001, 0.0], (N, 1)), ACCEL / 100),
        "Euler_X,Euler_Y,Euler_Z": (10 * GYRO,),
    }
    texts = [
        f"{head}PacketCounter,SampleTimeFine,{name}\n{rows(count, fine % 2**32, *values)}"
        for name, values in names.items()
    ]
    return [text.encode() for text in texts]


def ximu3() -> list[bytes]:
    first = 52100347 + 10000 * np.arange(N)
    units = [
        f"{kind} {axis} {unit}" for kind, unit in (("Gyroscope", "(deg/s)"), ("Accelerometer", "(g)")) for axis in "XYZ"
    ]
    inertial = ",".join(["Timestamp (us)", *units]) + "\n" + rows(first, GYRO, ACCEL / 9.8)
    quaternion = "Timestamp (us),W,X,Y,Z\n" + rows(first, QUAT[:, [3, 0, 1, 2]])
    return [inertial.encode(), quaternion.encode()]


def opensim() -> bytes:
    lines = [f"{t:.3f}\t0.8,0,0.6,0\t1,0,0,0\n" for t in TIME]
    return (
        "DataRate=100\nDataType=Quaternion\nversion=3\nendheader\ntime\ttorso_imu\thumerus_r_imu\n" + "".join(lines)
    ).encode()


def live_log() -> bytes:
    """A live session of one sensor: a start pose of half a second, and as much after it."""

    def block(tag: bytes, payload: bytes) -> bytes:
        return BLOCK.pack(tag, len(payload), zlib.crc32(payload, zlib.crc32(tag))) + payload

    n = 100
    header = {
        **{"format": 1, "name": "live", "sensors": ["torso"], "mounts": {"torso": [0.0, 0.0, 0.0, 1.0]}, "phases": {}},
        **{"start_pose": "n_pose", "strapping": "as_calibrated", "subject": None, "method": "amekf"},
    }
    time, gyro, accel = np.arange(n) / 100.0, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.8], (n, 1))
    samples = struct.pack("<I", n) + bytes(n) + time.tobytes() + gyro.tobytes() + accel.tobytes()
    poses = struct.pack("<QI", 51, 2) + np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)).tobytes()
    events = (
        {"kind": "clock", "rate_hz": 100.0, "begin": 0.0, "wait_s": 0.5},
        {"kind": "start", "begin": 0, "end": 50},
    )
    clock, start = (block(EVENT, json.dumps(event).encode()) for event in events)
    reset = block(EVENT, json.dumps({"kind": "reset", "tick": 60}).encode())
    head = block(HEAD, json.dumps(header).encode())
    return LIVE_MAGIC + head + clock + block(SAMPLES, samples) + start + block(POSES, poses) + reset


def datagrams() -> list[bytes]:
    one = {"sensor": "torso", "t": 12.345, "gyro": [0.1, -0.2, 0.3], "accel": [0.0, 0.5, 9.81]}
    two = {"sensor": "head", "t": [1, 2.5], "gyro": [[0.1, 0, 0], [0, 0, 1]], "accel": [[0, 0, 9], [0, 0, 9]]}
    samples = np.zeros(2, SAMPLE)
    body = HEADER.pack(MAGIC, 1, 3, 2, 1.5) + samples.tobytes()
    lines = "\n".join(json.dumps(found) for found in (one, two)).encode()
    return [json.dumps(one).encode(), lines, body + CRC.pack(zlib.crc32(body))]


def serial() -> bytes:
    """Bytes of an MTi: two packets of data, an acknowledgement and noise."""
    found = b"\x00\xfa"
    for k in range(2):
        data = struct.pack(">HBHHBI", 0x1020, 2, k, 0x1060, 4, 100 * k)
        data += struct.pack(">HB3f", xbus.RATE_OF_TURN, 12, 0.1, 0.2, 0.3)
        data += struct.pack(">HB3d", xbus.ACCELERATION | 3, 24, 0.0, 0.0, 9.8)
        found += xbus.frame(xbus.DATA, data)
    return found + xbus.frame(xbus.SET_OUTPUT + 1, xbus.output_items(100, False))


def pose() -> bytes:
    names = [f"torso_q{axis}" for axis in "xyzw"] + [
        "torso_std",
        *(f"left_hand_{axis}" for axis in "xyz"),
        "left_hand_std",
    ]
    values = np.column_stack([QUAT, np.full(N, 0.01), ACCEL / 10, np.full(N, 0.02)])
    out = io.BytesIO()
    pl.DataFrame({"time": TIME, **dict(zip(names, values.T, strict=True))}).write_parquet(out)
    return out.getvalue()


def subject() -> bytes:
    return subject_toml(average_subject()).encode() + (
        b"[mounts.torso]\nqx = 0.0\nqy = 0.0\nqz = 0.0\nqw = 1.0\n"
        b"[hinges.left]\nx = 0.0\ny = 1.0\nz = 0.0\nstd_deg = 5.0\n"
        b"[start_tilt.torso]\nx_deg = 1.0\ny_deg = 2.0\nstd_deg = 1.0\n"
        b"[drift.torso]\nrate_deg_min = 1.0\nstd_deg_min = 2.0\n"
    )


def shipped(*names: str) -> list[bytes]:
    """Files of ours, as they are."""
    return [Path(asset(*name.split("/", 1))).read_bytes() for name in names]
