"""Files of devices and programs, each written as its maker writes it, of one known motion.

Tables are as docs/formats.md has them, from files that labs have published; bags are written by rosbags, the XDF by the
few lines here, from the specification.
"""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

N, RATE, G = 400, 100.0, 9.80665
TIME = np.arange(N) / RATE
R_WS = Rotation.from_euler("ZYX", np.column_stack([0.8 * np.sin(TIME), 0.5 * np.sin(2 * TIME), 0.3 * TIME]))
GYRO = np.concatenate([np.zeros((1, 3)), (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE])
ACCEL = R_WS.inv().apply([0.0, 0.0, G])
WXYZ = R_WS.as_quat()[:, [3, 0, 1, 2]]
US0 = 1_700_000_000_000_000  # µs since 1970
AXES = "XYZ"


def rows(columns: list[np.ndarray | list[str]], separator: str = ",", decimal: str = ".") -> str:
    cells = [[v if isinstance(v, str) else f"{v:.9g}" for v in column] for column in columns]
    return "".join(separator.join(row).replace(".", decimal) + "\n" for row in zip(*cells, strict=True))


def own(values: np.ndarray, path: Path) -> np.ndarray:
    """With a noise of its own, far below what is compared: no two sensors give the same values."""
    return values + 1e-7 * np.random.default_rng(list(str(path).encode())).standard_normal(values.shape)


def table_text(columns: Sequence[Any], names: Sequence[str], separator: str = ",", decimal: str = ".") -> str:
    return separator.join(names) + "\n" + rows(list(columns), separator, decimal)


PREAMBLE = (
    "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n// Firmware Version: 4.6.0\n"
)


MT_RAW = [f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ"]


def mt_manager(
    path: Path, *, separator: str = "\t", decimal: str = ".", preamble: str = PREAMBLE, first: int = 0
) -> Path:
    matrix = R_WS.as_matrix().transpose(0, 2, 1).reshape(N, 9)  # columns of the matrix one after the other
    names = ["PacketCounter", "SampleTimeFine", *MT_RAW]
    names += [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
    columns: list[Any] = [[f"{(first + k) % 65536:05d}" for k in range(N)], [""] * N]
    columns += [*own(ACCEL, path).T, *GYRO.T, *matrix.T]
    path.write_text(preamble + separator.join(names) + "\n" + rows(columns, separator, decimal), encoding="utf-8")
    return path


def apdm(path: Path) -> Path:
    """``Format=7``: two sensors, the first without orientation."""
    first = ["Format=7"]
    for number, name in (("5718", "Left Wrist"), ("6575", "Chest")):
        first += [number, "", "", name, *[""] * 10]
    kinds = "Accelerometer,,,Gyroscope,,,Magnetometer,,,Barometer,Orientation,,,".split(",")
    axes = [*"XYZXYZXYZ", "", *"SXYZ"]
    zero = np.zeros(N)
    gone: list[Any] = [[""] * N] * 4
    one, other = ([*own(ACCEL, Path(name)).T, *GYRO.T, zero, zero, zero, zero] for name in ("wrist", "chest"))
    columns: list[Any] = [[str(1550879504438281 + 10_000 * k) for k in range(N)], *one, *gone, *other, *WXYZ.T]
    head = [first, ["Time", *kinds, *kinds], ["", *axes, *axes]]
    path.write_text("".join(",".join(line) + "\n" for line in head) + rows(columns))
    return path


def apdm_by_name(path: Path) -> Path:
    """As before ``Format=7``."""
    kinds = ("Acceleration", "Angular Velocity", "Magnetic Field")
    names = [f"Chest/{kind}/{axis}" for kind in kinds for axis in "XYZ"]
    names += [f"Chest/Orientation/{axis}" for axis in ("Scalar", "X", "Y", "Z")]
    units = ["s", *["m/s^2"] * 3, *["deg/s"] * 3, *["uT"] * 3, *[""] * 4]
    head = f"Test Name:,walk,,\nSample Rate:,100,Hz,\n{','.join(['Time', *names])}\n{','.join(units)}\n"
    path.write_text(head + rows([TIME, *ACCEL.T, *np.degrees(GYRO).T, *[np.zeros(N)] * 3, *WXYZ.T]))
    return path


DOT = (
    "sep=,\nDeviceTag:,{tag}\nFirmwareVersion:,3.0.0\nAppVersion:,2023.6.0\nSyncStatus:,{sync}\nOutputRate:,100Hz\n"
    "FilterProfile:,General\nMeasurement Mode:,Custom Mode 5\nStartTime: ,2025-07-11_20:06:00_086 WEST\n"
    "© Movella Technologies B. V. 2005-2025\n\n"
)


def dot(path: Path, mode: str = "rates", *, tag: str = "left_wrist", sync: str = "Synced", first_us: int = 0) -> Path:
    fine = [str((first_us + 10000 * k) % 2**32) for k in range(N)]
    modes: dict[str, dict[str, np.ndarray]] = {
        "rates": {
            "Quat_W,Quat_X,Quat_Y,Quat_Z": WXYZ,
            "Acc_X,Acc_Y,Acc_Z": own(ACCEL, path),
            "Gyr_X,Gyr_Y,Gyr_Z": np.degrees(GYRO),
        },
        "quaternion": {"Quat_W,Quat_X,Quat_Y,Quat_Z": WXYZ, "FreeAcc_X,FreeAcc_Y,FreeAcc_Z": ACCEL},
        "euler": {"Euler_X,Euler_Y,Euler_Z": np.degrees(R_WS.as_euler("ZYX"))[:, ::-1]},
    }
    names = ",".join(["PacketCounter", "SampleTimeFine", *modes[mode], "Status"])
    columns: list[Any] = [[str(k + 1) for k in range(N)], fine]
    columns += [*np.column_stack(list(modes[mode].values())).T, ["0"] * N]
    text = DOT.format(tag=tag, sync=sync) + names + "\n" + rows(columns)
    path.write_bytes(text.encode("latin-1"))  # the sign © in the encoding of some Windows
    return path


def ximu3(folder: Path, first_us: int = 52100347) -> Path:
    folder.mkdir()
    fine = [str(first_us + 10000 * k) for k in range(N)]
    names = "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
    names += "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n"
    (folder / "Inertial.csv").write_text(names + rows([fine, *np.degrees(GYRO).T, *(own(ACCEL, folder) / 9.80665).T]))
    (folder / "Quaternion.csv").write_text("Timestamp (us),W,X,Y,Z\n" + rows([fine, *WXYZ.T]))
    return folder


def sto(path: Path, labels: tuple[str, ...] = ("torso_imu", "humerus_r_imu")) -> Path:
    head = "DataRate=100.000000\nDataType=Quaternion\nversion=3\nOpenSimVersion=4.4\nendheader\n"
    columns = [[f"{t:.6f}" for t in TIME]]
    for k in range(len(labels)):  # no sensor is a copy of another
        quats = (Rotation.from_rotvec([0.0, 0.0, 2e-7 * k]) * R_WS).as_quat()[:, [3, 0, 1, 2]]
        columns.append([",".join(f"{value:.9f}" for value in quat) for quat in quats])
    path.write_text(head + table_text(columns, ["time", *labels], "\t"))
    return path


def hdf5(path: Path, turned: bool = False) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values in {"/imu/torso/gyro": GYRO, "/imu/torso/accel": ACCEL, "/q": WXYZ}.items():
            file[name] = values.T if turned else values
        file["/clock/time"] = TIME[None] if turned else TIME
        file["/note"] = "walking"
    return path


def mat(path: Path) -> Path:
    savemat(path, {"imu": {"torso": {"gyro": GYRO, "accel": ACCEL}}, "clock": {"time": TIME}, "q": WXYZ, "note": "a"})
    return path


def shimmer(path: Path, separator: str = ";", scale: float = 1.0, dates: bool = False) -> Path:
    names = ["TimestampSync_FormattedUnix" if dates else "Timestamp_Unix"]
    names += [f"Accel_{kind}_{a}" for kind in ("LN", "WR") for a in AXES] + ["Battery"]
    names += [f"{kind}_{a}" for kind in ("Gyro", "Mag") for a in AXES]
    units = ["yyyy/mm/dd hh:mm:ss.000" if dates else "ms", *["m/(s^2)"] * 6, "mV", *["deg/s"] * 3, *["local_flux"] * 3]
    date = "2026/03/12 08:00:{:06.3f}"
    stamps = [date.format(0.01 * k) if dates else f"{1e-3 * US0 + 10 * k:.1f}" for k in range(N)]
    noise = own(ACCEL, path)
    columns = [stamps, *(scale * noise).T, *(noise + 0.1).T, np.full(N, 4100.0), *np.degrees(GYRO).T, *ACCEL.T]
    head = f'"sep={separator}"\n' + separator.join([*(f"Shimmer_8665_{n}_CAL" for n in names), ""]) + "\n"
    body = rows(columns, separator).replace("\n", separator + "\n")
    path.write_text(head + separator.join([*units, ""]) + "\n" + body)
    return path


def noraxon(path: Path, accel: str = "Noraxon MyoMotion-Segments-{}-Acceleration-{} (mG)") -> Path:
    names, columns = ["time", "Activity", "Marker"], [TIME, ["walk"] * N, [""] * N]
    for segment in ("Upper spine", "Forearm RT"):
        names += [f"Noraxon MyoMotion-Segments-{segment}-Gyroscope-{a} (deg/s)" for a in "xyz"]
        columns += list(np.degrees(GYRO).T)
        if "Sensor" in accel:
            names += [
                f"{segment[:-3]} Accel Sensor {a} RT (mG)" if "RT" in segment else accel.format(segment, a)
                for a in AXES
            ]
        else:
            names += [accel.format(segment, a) for a in "xyz"]
        columns += list(1000.0 / G * own(ACCEL, Path(segment)).T)
        names += [f"Noraxon MyoMotion-Segments-{segment}-Course (deg)"]
        columns += [np.zeros(N)]
    path.write_text("Exported by MR3\nSubject: 7\n" + table_text(columns, names))
    return path


def delsys(path: Path, separator: str = ",", decimal: str = ".") -> Path:
    """Trigno Discover: muscles ten times as often as the IMUs, whose columns end early."""
    sensors = ("Forearm left (75657)", "Sternum (75758)")
    channels = ["EMG 1 (mV)", *(f"ACC {a} (G)" for a in AXES), *(f"GYRO {a} (deg/s)" for a in AXES)]
    head, kinds, columns = [], [], []
    for sensor in sensors:
        head += [sensor, *[""] * (2 * len(channels) - 1)]
        values = [np.zeros(10 * N), *(own(ACCEL, Path(sensor)) / G).T, *np.degrees(GYRO).T]
        for channel, column in zip(channels, values, strict=True):
            kinds += [f"{channel.rpartition(' (')[0]} Time Series (s)", channel]
            filled = [f"{v:.9g}" for v in column] + [""] * (10 * N - len(column))
            rate_hz = RATE * (10 if len(column) > N else 1)
            columns += [[f"{k / rate_hz:.6f}" if v else "" for k, v in enumerate(filled)], filled]
    about = {"Application": "Trigno Discover (2.1.0.7)", "Date/Time": "x", "Length": "4"}
    lines = [f"{key}:{separator}{value}" for key, value in about.items()]
    modes = separator.join("sensor mode: 609" if c else "" for c in head)
    lines += [f"{separator} ".join(head), modes, f"{separator} ".join(kinds)]
    lines += [separator.join([""] + ["1000 Hz" if k % 2 else "" for k in range(1, len(kinds))])] * 2
    path.write_text("\n".join(lines) + "\n" + rows(columns, separator, decimal))
    return path


def emgworks(path: Path) -> Path:
    names: list[str] = []
    columns: list[Any] = []
    for kind, unit, values in (("Acc", "g", ACCEL / G), ("Gyro", "deg/sec", np.degrees(GYRO))):
        for k, a in enumerate(AXES):
            names += ["X[s]", f"Trigno IM sensor 1: {kind} 1.{a} (IM) [{unit}]"]
            columns += [TIME, values[:, k]]
    path.write_text(table_text(columns, names))
    return path


def sensor_logger(folder: Path, platform: str = "android", late: float = 0.0, gravity: bool = False) -> Path:
    folder.mkdir(parents=True)
    stamps = [str(1000 * US0 + 10_000_000 * k) for k in range(N)]
    after = [str(1000 * US0 + 10_000_000 * k + round(1e9 * late)) for k in range(N)]
    sign = -1.0 if platform == "ios" else 1.0
    names = ["time", "seconds_elapsed"]
    (folder / "Gyroscope.csv").write_text(table_text([stamps, TIME, *GYRO[:, ::-1].T], [*names, *"zyx"]))
    total = own(ACCEL, folder)
    accel = {"TotalAcceleration": total, "Accelerometer": 0.3 * total}
    if gravity:
        accel = {"Accelerometer": 0.3 * total, "Gravity": 0.7 * total}
    for name, values in accel.items():
        (folder / f"{name}.csv").write_text(table_text([after, TIME, *sign * values[:, ::-1].T], [*names, *"zyx"]))
    quat = table_text(
        [stamps, TIME, *WXYZ[:, ::-1].T, TIME, TIME, TIME], [*names, "qz", "qy", "qx", "qw", "roll", "pitch", "yaw"]
    )
    (folder / "Orientation.csv").write_text(quat)
    (folder / "Metadata.csv").write_text(f"version,device name,platform,standardisation\n3,phone,{platform},false\n")
    return folder


def phyphox(folder: Path, separator: str = ",", decimal: str = ".", gyro: str = "Gyroscope {} (rad/s)") -> Path:
    folder.mkdir(parents=True)
    scale = 180.0 / np.pi if "deg" in gyro else 1.0
    sensors = {"Accelerometer": ("Acceleration {} (m/s^2)", ACCEL), "Gyroscope": (gyro, scale * GYRO)}
    for name, (column, values) in sensors.items():
        names = ["Time (s)", *(column.format(a) for a in "xyz")]
        (folder / f"{name}.csv").write_text(table_text([TIME, *values.T], names, separator, decimal))
    (folder / "Linear Acceleration.csv").write_text("Time (s),Linear Acceleration x (m/s^2)\n0,0\n1,0\n")
    return folder


def rosbag(path: Path, mcap: bool = False, frames: bool = False, raw: bool = True) -> Path:
    """Two IMUs, one of which begins later; as topics, or as frames of one topic."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = ("sensor_msgs", "Imu"), ("std_msgs", "Header"), ("builtin_interfaces", "Time")
    Imu, Header, Stamp = (store.types[f"{package}/msg/{name}"] for package, name in messages)
    Vector, Quaternion = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion"))
    covariance, unknown = np.zeros(9), np.array([-1.0, *np.zeros(8)])
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topics = ["/imu"] if frames else ["/torso/imu", "/left_forearm/imu"]
        connections = [writer.add_connection(topic, Imu.__msgtype__, typestore=store) for topic in topics]
        for k in range(N):
            for which, frame in enumerate(("torso", "left_forearm")):
                if which and k < 10:
                    continue
                ns = 1000 * US0 + 10_000_000 * k
                accel = own(ACCEL, path)[k] if which else ACCEL[k]
                turn = Quaternion(*WXYZ[k, [1, 2, 3, 0]]), covariance if which == 0 or not raw else unknown
                rate = Vector(*GYRO[k]), covariance if raw else unknown
                message = Imu(Header(Stamp(ns // 10**9, ns % 10**9), frame), *turn, *rate, Vector(*accel), covariance)
                data = store.serialize_cdr(message, Imu.__msgtype__)
                writer.write(connections[0 if frames else which], ns + 777, data)
    return path


def xdf(path: Path, streams: dict[str, tuple[list[str], list[str], np.ndarray]], cut: int = 0) -> Path:
    """Streams by name: labels, units, values; written chunk by chunk as the specification has it."""

    def chunk(tag: int, content: bytes) -> bytes:
        return b"\x04" + struct.pack("<IH", len(content) + 2, tag) + content

    data = b"XDF:" + chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>")
    for k, (name, (labels, units, values)) in enumerate(streams.items(), 1):
        channels = "".join(
            f"<channel><label>{label}</label><unit>{unit}</unit></channel>"
            for label, unit in zip(labels, units, strict=True)
        )
        head = (
            f"<info><name>{name}</name><type>IMU</type><channel_count>{len(labels)}</channel_count>"
            f"<nominal_srate>100</nominal_srate><channel_format>double64</channel_format><source_id>{k}</source_id>"
            f"<desc><channels>{channels}</channels></desc></info>"
        )
        data += chunk(2, struct.pack("<I", k) + head.encode())
        for first in range(0, N, 100):
            samples = b"".join(
                b"\x08" + struct.pack(f"<{1 + len(labels)}d", 5000.0 + TIME[i], *values[i])
                for i in range(first, first + 100)
            )
            data += chunk(3, struct.pack("<IBI", k, 4, 100) + samples)
        data += chunk(4, struct.pack("<Idd", k, 5001.0, -100.0))
    for k in range(1, len(streams) + 1):
        foot = f"<info><first_timestamp>5000</first_timestamp><sample_count>{N}</sample_count></info>"
        data += chunk(6, struct.pack("<I", k) + foot.encode())
    path.write_bytes(data[: len(data) - cut])
    return path


LABELS = [f"{kind}_{a}" for kind in ("acc", "gyr") for a in "xyz"]


def two_streams(path: Path, cut: int = 0) -> Path:
    """One in g and °/s, one in SI."""
    one, other = np.column_stack([own(ACCEL, Path("a")) / G, np.degrees(GYRO)]), np.column_stack([ACCEL, GYRO])
    units = [["g"] * 3 + ["deg/s"] * 3, ["m/s^2"] * 3 + ["rad/s"] * 3]
    return xdf(path, {"left_wrist": (LABELS, units[0], one), "Sternum": (LABELS, units[1], other)}, cut)


MVN_SEGMENTS = ("Pelvis", "T8", "LeftUpperArm", "LeftForeArm", "LeftHand", "RightUpperArm")
MVN_IDENTITY = "1 0 0 0 " * len(MVN_SEGMENTS)


def mvnx(
    folder: Path,
    quat_wxyz: np.ndarray,
    *,
    raw: bool = False,
    version: str = "3",
    index: list[int] | None = None,
    t_pose: str | None = MVN_IDENTITY,
) -> Path:
    """A file with these orientations (n, 6, 4) and, with `raw`, two sensors that rest with gravity on z.

    `t_pose`: the orientations in its frame of type tpose; None: it has no such frame.
    """
    lines = [f'<mvnx version="{version}"><mvn version="x"/><subject frameRate="50" segmentCount="6"><segments>']
    lines += [f'<segment label="{name}" id="{k}"><points/></segment>' for k, name in enumerate(MVN_SEGMENTS, 1)]
    lines += ["</segments><sensors>", '<sensor label="T8"/><sensor label="LeftForeArm"/>', "</sensors><frames>"]
    poses = {"npose" if version == "2" else "identity": MVN_IDENTITY} | ({"tpose": t_pose} if t_pose else {})
    lines += [f'<frame type="{pose}"><orientation>{quats}</orientation></frame>' for pose, quats in poses.items()]
    for k, quats in enumerate(quat_wxyz):
        number = k if index is None else index[k]
        lines.append(f'<frame time="{round(20 * number)}" index="{number}" type="normal">')
        lines.append(f"<orientation>{' '.join(f'{value:.9f}' for value in quats.ravel())}</orientation>")
        if raw:
            lines.append(f"<sensorAcceleration>{1e-3 * (k % 3)} 0 9.81 {1e-3 * (k % 2)} 9.81 0</sensorAcceleration>")
            lines.append(f"<sensorAngularVelocity>{0.1 + 1e-4 * (k % 2)} 0 0 0 0 {0.001 * k}</sensorAngularVelocity>")
        lines.append("</frame>")
    (folder / "trial.mvnx").write_text("\n".join([*lines, "</frames></subject></mvnx>"]), encoding="utf-8")
    return folder / "trial.mvnx"


def turning(n: int = 40) -> np.ndarray:
    """(n, 6, 4) wxyz: each segment turns about z by its own angle."""
    angles = np.linspace(0.0, 0.5, n)[:, None] * np.arange(1, len(MVN_SEGMENTS) + 1)
    xyzw = Rotation.from_rotvec(angles.reshape(-1, 1) * [0.0, 0.0, 1.0]).as_quat()
    return xyzw[:, [3, 0, 1, 2]].reshape(n, len(MVN_SEGMENTS), 4)


MAKERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "mt_manager": ("a.txt", mt_manager),
    "dot": ("a.csv", dot),
    "ximu3": ("x", ximu3),
    "opensim": ("a.sto", sto),
    "apdm": ("apdm.csv", apdm),
    "shimmer": ("torso.csv", shimmer),
    "noraxon": ("torso.csv", noraxon),
    "delsys": ("torso.csv", delsys),
    "sensor_logger": ("torso", sensor_logger),
    "phyphox": ("torso", phyphox),
    "rosbag": ("torso_bag", rosbag),
    "xdf": ("torso.xdf", two_streams),
}


def make(format: str, folder: Path) -> Path:
    """Write a file or folder of a format, and return it."""
    name, write = MAKERS[format]
    return write(folder / name)


def first_file(path: Path) -> Path:
    """The file, or that of the rates in a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    files.sort(key=lambda file: file.name not in ("Gyroscope.csv", "Inertial.csv"))
    return next(file for file in files if file.suffix != ".yaml")
