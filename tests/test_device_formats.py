"""Files of Shimmer, Noraxon, Delsys, phones, ROS and LabRecorder: one known motion, read back in SI.

Bags are written by rosbags; the XDF by the few lines here, from the specification. Tables are as docs/formats.md has
them, from files that labs have published.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_formats import ACCEL, GYRO, RATE, TIME, WXYZ, N, check_orientation, check_raw, load, own, rows
from test_formats import MAKERS as FIRST_MAKERS
from test_info import info

import wepose_pin as wp
from wepose_pin.commands import main
from wepose_pin.errors import BadData, WeposeError
from wepose_pin.readers.device import Signal, join_signals, spread_equal_times
from wepose_pin.readers.registry import detect_format, read_device

G = 9.80665
US0 = 1_700_000_000_000_000  # µs since 1970
AXES = "XYZ"


def text(columns: Sequence[Any], names: Sequence[str], separator: str = ",", decimal: str = ".") -> str:
    return separator.join(names) + "\n" + rows(list(columns), separator, decimal)


# Shimmer -----------------------------------------------------------------------------------------------------------


def shimmer(path: Path, separator: str = ";", scale: float = 1.0, dates: bool = False) -> Path:
    names = ["TimestampSync_FormattedUnix" if dates else "Timestamp_Unix"]
    names += [f"Accel_{kind}_{a}" for kind in ("LN", "WR") for a in AXES] + ["Battery"]
    names += [f"{kind}_{a}" for kind in ("Gyro", "Mag") for a in AXES]
    units = [
        *("yyyy/mm/dd hh:mm:ss.000" if dates else "ms",),
        *["m/(s^2)"] * 6,
        "mV",
        *["deg/s"] * 3,
        *["local_flux"] * 3,
    ]
    stamps = [f"{1e-3 * US0 + 10 * k:.1f}" for k in range(N)]
    if dates:
        stamps = [f"2026/03/12 08:00:{0.01 * k:06.3f}" for k in range(N)]
    noise = own(ACCEL, path)
    columns = [stamps, *(scale * noise).T, *(noise + 0.1).T, np.full(N, 4100.0), *np.degrees(GYRO).T, *ACCEL.T]
    head = f'"sep={separator}"\n' + separator.join([*(f"Shimmer_8665_{n}_CAL" for n in names), ""]) + "\n"
    body = rows(columns, separator).replace("\n", separator + "\n")
    path.write_text(head + separator.join([*units, ""]) + "\n" + body)
    return path


@pytest.mark.parametrize(("separator", "dates"), [(";", False), ("\t", False), (",", True)])
def test_shimmer(separator: str, dates: bool, tmp_path: Path) -> None:
    assert detect_format(shimmer(tmp_path / "left_wrist.csv", separator, dates=dates)) == "shimmer"
    check_raw(load(tmp_path, '[data]\nfile = "left_wrist.csv"\n[sensors.left_forearm]'), "left_forearm")
    sensors = read_device(tmp_path / "left_wrist.csv", "shimmer").sensors
    assert {label: sensor.segment for label, sensor in sensors.items()} == {"Shimmer_8665": "left_forearm"}


def test_a_shimmer_beyond_the_range_of_its_low_noise_accelerometer_is_read_by_the_other(tmp_path: Path) -> None:
    shimmer(tmp_path / "a.csv", scale=2.1)
    accel = read_device(tmp_path / "a.csv", "shimmer").sensors["Shimmer_8665"].signals["accel"]
    np.testing.assert_allclose(accel, ACCEL + 0.1, atol=1e-6)


def test_samples_of_one_packet_are_spread() -> None:
    """As a Shimmer stamped them on its way to a phone: 810157 twice."""
    time = np.array([810111.0, 810157.0, 810157.0, 810175.0, 810175.0])
    np.testing.assert_allclose(spread_equal_times(time), [810111.0, 810157.0, 810166.0, 810175.0, 810196.3333333])


# Noraxon -----------------------------------------------------------------------------------------------------------


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
    path.write_text("Exported by MR3\nSubject: 7\n" + text(columns, names))
    return path


@pytest.mark.parametrize("accel", ["Noraxon MyoMotion-Segments-{}-Acceleration-{} (mG)", "{} Accel Sensor {} (mG)"])
def test_noraxon(accel: str, tmp_path: Path) -> None:
    assert detect_format(noraxon(tmp_path / "a.csv", accel)) == "noraxon"
    recording = load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]\n[sensors.right_forearm]')
    check_raw(recording)
    check_raw(recording, "right_forearm")


# Delsys ------------------------------------------------------------------------------------------------------------


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
            columns += [
                [f"{k / (10 if len(column) > N else 1) / RATE:.6f}" if v else "" for k, v in enumerate(filled)],
                filled,
            ]
    lines = [
        "Application:" + separator + "Trigno Discover (2.1.0.7)",
        "Date/Time:" + separator + "x",
        "Length:" + separator + "4",
    ]
    lines += [
        f"{separator} ".join(head),
        separator.join("sensor mode: 609" if c else "" for c in head),
        f"{separator} ".join(kinds),
    ]
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
    path.write_text(text(columns, names))
    return path


def emgworks_with_labels(path: Path) -> Path:
    """Units in a line for each channel, before the names; as emgio describes it."""
    names = [f"{kind}1.{a}" for kind in ("ACC", "GYRO") for a in AXES]
    lines = [f"Label: {n}  Sampling frequency: 100 Unit: {'g' if 'ACC' in n else 'deg/s'}  Domain: Time" for n in names]
    columns = [column for values in (ACCEL / G, np.degrees(GYRO)) for v in values.T for column in (TIME, v)]
    path.write_text("\n".join(lines) + "\n\n" + text(columns, [x for name in names for x in ("X[s]", f'"{name}"')]))
    return path


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ",")])
def test_delsys(separator: str, decimal: str, tmp_path: Path) -> None:
    assert detect_format(delsys(tmp_path / "a.csv", separator, decimal)) == "delsys"
    recording = load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]\n[sensors.left_forearm]')
    check_raw(recording)
    check_raw(recording, "left_forearm")


@pytest.mark.parametrize("write", [emgworks, emgworks_with_labels])
def test_emgworks(write: Callable[[Path], Path], tmp_path: Path) -> None:
    assert detect_format(write(tmp_path / "a.csv")) == "delsys"
    check_raw(load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]'))


# Phones ------------------------------------------------------------------------------------------------------------


def sensor_logger(folder: Path, platform: str = "android", late: float = 0.0, gravity: bool = False) -> Path:
    folder.mkdir(parents=True)
    stamps = [str(1000 * US0 + 10_000_000 * k) for k in range(N)]
    after = [str(1000 * US0 + 10_000_000 * k + round(1e9 * late)) for k in range(N)]
    sign = -1.0 if platform == "ios" else 1.0
    names = ["time", "seconds_elapsed"]
    (folder / "Gyroscope.csv").write_text(text([stamps, TIME, *GYRO[:, ::-1].T], [*names, *"zyx"]))
    total = own(ACCEL, folder)
    accel = {"TotalAcceleration": total, "Accelerometer": 0.3 * total}
    if gravity:
        accel = {"Accelerometer": 0.3 * total, "Gravity": 0.7 * total}
    for name, values in accel.items():
        (folder / f"{name}.csv").write_text(text([after, TIME, *sign * values[:, ::-1].T], [*names, *"zyx"]))
    quat = text(
        [stamps, TIME, *WXYZ[:, ::-1].T, TIME, TIME, TIME], [*names, "qz", "qy", "qx", "qw", "roll", "pitch", "yaw"]
    )
    (folder / "Orientation.csv").write_text(quat)
    about = f"version,device name,platform,standardisation\n3,phone,{platform},false\n"
    (folder / "Metadata.csv").write_text(about)
    return folder


@pytest.mark.parametrize("platform", ["android", "ios"])
@pytest.mark.parametrize("gravity", [False, True])
def test_sensor_logger(platform: str, gravity: bool, tmp_path: Path) -> None:
    """The signs of an iPhone are opposite."""
    folder = sensor_logger(tmp_path / "left_wrist-2026-03-12", platform, gravity=gravity)
    assert detect_format(folder) == "sensor_logger"
    for file in (folder.name, f"{folder.name}/Gyroscope.csv"):
        recording = load(tmp_path, f'[data]\nfile = "{file}"\n[sensors.left_forearm]')
        check_raw(recording, "left_forearm")
        assert not recording.diagnostics
    check_orientation(load(tmp_path, f'[data]\nfile = "{folder.name}"\nuse = "orientation"\n[sensors.torso]'))
    (folder / "Metadata.csv").unlink()
    device = read_device(folder, "sensor_logger")
    assert [each.code for each in device.diagnostics] == ["file-assumption"]


def test_phones_side_by_side_make_one_session(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name in ("chest", "left_wrist"):
        sensor_logger(tmp_path / name)
    info(capsys, tmp_path / "chest", "--write")
    recording = wp.load_session(tmp_path / "session.toml")
    assert set(recording.sensors) == {"torso", "left_forearm"}
    out = info(capsys, tmp_path / "chest" / "TotalAcceleration.csv", "--write")
    assert out.count("[sensors.") <= 1
    assert set(wp.load_session(tmp_path / "chest").sensors) == {"torso"}
    assert "a session" in info(capsys, tmp_path / "chest")


def test_sensor_logger_as_zip_and_json(tmp_path: Path) -> None:
    folder = sensor_logger(tmp_path / "in" / "chest")
    with zipfile.ZipFile(tmp_path / "chest.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in folder.iterdir():
            archive.write(file, f"chest/{file.name}")
    entries = [{"sensor": "Metadata", "platform": "ios"}]
    for name, values in (("Gyroscope", GYRO), ("TotalAcceleration", -ACCEL)):
        for k in range(N):
            axes = dict(zip("zyx", (f"{v:.9g}" for v in values[k, ::-1]), strict=True))
            stamp = {"time": str(1000 * US0 + 10_000_000 * k), "seconds_elapsed": f"{TIME[k]}"}
            entries.append({"sensor": name, **stamp, **axes})
    (tmp_path / "chest.json").write_text(json.dumps(entries))
    for file in ("chest.zip", "chest.json"):
        assert detect_format(tmp_path / file) == "sensor_logger"
        check_raw(load(tmp_path, f'[data]\nfile = "{file}"\n[sensors.torso]'))


def test_the_signals_of_two_clocks_are_joined_at_the_times_of_the_rates(tmp_path: Path) -> None:
    """Specific force came 3 ms later; between its samples it is a line, as the true one is to 0.6 mm/s²."""
    folder = sensor_logger(tmp_path / "chest", late=0.003)
    device = read_device(folder, "sensor_logger")
    assert not device.diagnostics
    true = np.column_stack([np.interp(TIME[1:], TIME + 0.003, axis) for axis in ACCEL.T])
    accel = device.sensors["chest"].signals["accel"]
    np.testing.assert_allclose(accel, true, atol=1e-5)
    force = ACCEL[[*range(100), *range(110, N)]]
    own_time = TIME[[*range(100), *range(110, N)]]
    time, values = join_signals("a", {"gyro": Signal(TIME, GYRO), "accel": Signal(own_time, force)})
    assert np.flatnonzero(np.isnan(values["accel"][:, 0])).tolist() == list(range(100, 110))
    assert len(time) == N
    with pytest.raises(BadData, match="no time in common"):
        join_signals("a", {"gyro": Signal(TIME, GYRO), "accel": Signal(TIME + 60.0, ACCEL)})


def phyphox(folder: Path, separator: str = ",", decimal: str = ".", gyro: str = "Gyroscope {} (rad/s)") -> Path:
    folder.mkdir(parents=True)
    scale = 180.0 / np.pi if "deg" in gyro else 1.0
    sensors = {"Accelerometer": ("Acceleration {} (m/s^2)", ACCEL), "Gyroscope": (gyro, scale * GYRO)}
    for name, (column, values) in sensors.items():
        names = ["Time (s)", *(column.format(a) for a in "xyz")]
        (folder / f"{name}.csv").write_text(text([TIME, *values.T], names, separator, decimal))
    (folder / "Linear Acceleration.csv").write_text("Time (s),Linear Acceleration x (m/s^2)\n0,0\n1,0\n")
    return folder


@pytest.mark.parametrize(
    ("separator", "decimal", "gyro"),
    [(",", ".", "Gyroscope {} (rad/s)"), (";", ",", "Gyroscope {} (rad/s)"), ("\t", ".", "Gyro_{} (deg/s)")],
)
def test_phyphox(separator: str, decimal: str, gyro: str, tmp_path: Path) -> None:
    folder = phyphox(tmp_path / "left_wrist 2026-03-12", separator, decimal, gyro)
    assert detect_format(folder) == detect_format(folder / "Gyroscope.csv") == "phyphox"
    with zipfile.ZipFile(tmp_path / "left_wrist.zip", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, file.name)
    for file in (folder.name, f"{folder.name}/Accelerometer.csv", "left_wrist.zip"):
        check_raw(load(tmp_path, f'[data]\nfile = "{file}"\n[sensors.left_forearm]'), "left_forearm")


# ROS ---------------------------------------------------------------------------------------------------------------


def rosbag(path: Path, mcap: bool = False, frames: bool = False, raw: bool = True, version: int = 9) -> Path:
    """Two IMUs, one of which begins later; as topics, or as frames of one topic."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    Imu, Header, Stamp = (
        types[f"{name}"] for name in ("sensor_msgs/msg/Imu", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    Vector, Quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    covariance = np.zeros(9)
    unknown = np.array([-1.0, *np.zeros(8)])
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=version, storage_plugin=plugin) as writer:
        topics = ["/imu"] if frames else ["/torso/imu", "/left_forearm/imu"]
        connections = [writer.add_connection(topic, Imu.__msgtype__, typestore=store) for topic in topics]
        for k in range(N):
            for which, frame in enumerate(("torso", "left_forearm")):
                if which and k < 10:
                    continue
                ns = 1000 * US0 + 10_000_000 * k
                accel = own(ACCEL, path)[k] if which else ACCEL[k]
                message = Imu(
                    Header(Stamp(ns // 10**9, ns % 10**9), frame),
                    Quaternion(*WXYZ[k, [1, 2, 3, 0]]),
                    covariance if which == 0 or not raw else unknown,
                    Vector(*GYRO[k]),
                    covariance if raw else unknown,
                    Vector(*accel),
                    covariance,
                )
                writer.write(
                    connections[0 if frames else which], ns + 777, store.serialize_cdr(message, Imu.__msgtype__)
                )
    return path


@pytest.mark.parametrize("mcap", [False, True])
@pytest.mark.parametrize("frames", [False, True])
def test_rosbag(mcap: bool, frames: bool, tmp_path: Path) -> None:
    path = rosbag(tmp_path / "bag", mcap, frames)
    assert detect_format(path) == "rosbag"
    recording = load(tmp_path, '[data]\nfile = "bag"\n[sensors.torso]\n[sensors.left_forearm]')
    assert len(recording) == N - 10
    np.testing.assert_allclose(recording.time, TIME[10:], atol=1e-6)
    for segment in recording.sensors:
        np.testing.assert_allclose(recording.sensors[segment].gyro_S[1:], GYRO[11:], atol=1e-4)
        np.testing.assert_allclose(recording.sensors[segment].accel_S, ACCEL[10:], atol=1e-4)
    check_raw(load(tmp_path, '[data]\nfile = "bag"\n[sensors.torso]'))
    check_orientation(load(tmp_path, '[data]\nfile = "bag"\nuse = "orientation"\n[sensors.torso]'))
    file = next(each for each in path.iterdir() if each.suffix in (".db3", ".mcap"))
    check_raw(load(tmp_path, f'[data]\nfile = "bag/{file.name}"\n[sensors.torso]'))


def test_what_a_bag_does_not_provide_is_not_read(tmp_path: Path) -> None:
    rosbag(tmp_path / "bag", raw=False)
    check_orientation(load(tmp_path, '[data]\nfile = "bag"\n[sensors.torso]'))
    with pytest.raises(BadData, match=r"no sensor in it has angular_velocity .*; leave out data\.use"):
        read_device(tmp_path / "bag", "rosbag", "raw")


# XDF ---------------------------------------------------------------------------------------------------------------


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
SI = ["m/s^2"] * 3 + ["rad/s"] * 3


def two_streams(path: Path, cut: int = 0) -> Path:
    """One in g and °/s, with both sensors' channels in one stream; one in SI."""
    one = np.column_stack([own(ACCEL, Path("a")) / G, np.degrees(GYRO)])
    return xdf(
        path,
        {
            "left_wrist": (LABELS, ["g"] * 3 + ["deg/s"] * 3, one),
            "Sternum": (LABELS, SI, np.column_stack([ACCEL, GYRO])),
        },
        cut,
    )


def test_xdf(tmp_path: Path) -> None:
    assert detect_format(two_streams(tmp_path / "a.xdf")) == "xdf"
    recording = load(tmp_path, '[data]\nfile = "a.xdf"\n[sensors.torso]\n[sensors.left_forearm]')
    check_raw(recording)
    check_raw(recording, "left_forearm")
    assert not recording.diagnostics


def test_an_xdf_that_was_cut_off_is_said_to_be(tmp_path: Path) -> None:
    two_streams(tmp_path / "a.xdf", cut=100)
    (diagnostic,) = load(tmp_path, '[data]\nfile = "a.xdf"\n[sensors.torso]\n[sensors.left_forearm]').diagnostics
    assert (diagnostic.code, diagnostic.place) == ("file-incomplete", "a.xdf")


def test_xdf_with_rates_and_forces_in_streams_of_their_own(tmp_path: Path) -> None:
    """And without units: gravity says that of the forces."""
    streams = {"torso Gyroscope": (["gyr_x", "gyr_y", "gyr_z"], [""] * 3, GYRO)}
    streams["torso Accelerometer"] = ["acc_x", "acc_y", "acc_z"], [""] * 3, ACCEL / G
    xdf(tmp_path / "a.xdf", streams)
    recording = load(tmp_path, '[data]\nfile = "a.xdf"\n[sensors.torso]')
    check_raw(recording)
    assumed = {each.facts["unit"] for each in recording.diagnostics if each.code == "file-assumption"}
    assert assumed == {"rad/s", "g"}


def test_an_unknown_unit_is_named(tmp_path: Path) -> None:
    values = np.column_stack([ACCEL, GYRO])
    xdf(tmp_path / "a.xdf", {"torso": (LABELS, ["furlong"] * 3 + ["rad/s"] * 3, values)})
    with pytest.raises(BadData, match=r"'torso acc_x' is in 'furlong'; there is: m/s\^2, g, mg"):
        read_device(tmp_path / "a.xdf", "xdf")


# What all do -------------------------------------------------------------------------------------------------------

MAKERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "shimmer": ("torso.csv", shimmer),
    "noraxon": ("torso.csv", noraxon),
    "delsys": ("torso.csv", delsys),
    "sensor_logger": ("torso", sensor_logger),
    "phyphox": ("torso", phyphox),
    "rosbag": ("torso_bag", rosbag),
    "xdf": ("torso.xdf", two_streams),
}


@pytest.mark.parametrize("format", MAKERS)
def test_the_session_that_is_proposed_needs_no_editing(
    format: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    name, make = MAKERS[format]
    path = make(tmp_path / name)
    out = info(capsys, path, "--write")
    assert "CHECK: the file" not in out
    recording = wp.load_session(tmp_path / "session.toml")
    assert "torso" in recording.sensors
    check_raw(recording) if format != "rosbag" else None
    assert recording.time[0] == pytest.approx(0.1 if format == "rosbag" else 0.0, abs=1e-6)
    rate = load(tmp_path, f'[data]\nfile = "{name}"\nrate_hz = 50.0\n[sensors.torso]')
    assert rate.rate_hz == pytest.approx(50.0)


def _first_file(path: Path) -> Path:
    files = (
        sorted(path.iterdir(), key=lambda file: file.name not in ("Gyroscope.csv", "Inertial.csv"))
        if path.is_dir()
        else [path]
    )
    return next(file for file in files if file.suffix != ".yaml")


LABELS_IN_FILE = {"noraxon": "Upper spine", "delsys": "Sternum", "apdm": "Chest", "opensim": "torso_imu"}
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "binary": lambda _: b"\x00\xff\xfe\x01" * 300,
    "head alone": lambda raw: raw[:120],
    "UTF-16": lambda raw: raw.decode("latin-1").encode("utf-16"),
    "garbage after the names": lambda raw: raw[: raw.rfind(b"\n", 0, 700)] + b"\n" + b"\xff\x00" * 300,
    "text in the cells": lambda raw: raw.replace(b"\n", b"\n###", 900),
    "zeros in the middle": lambda raw: raw[:1500] + b"\x00" * 3000 + raw[4500:],
}


@pytest.mark.parametrize(
    ("format", "damage"),
    [
        (format, damage)
        for format in (*MAKERS, *FIRST_MAKERS)
        for damage in DAMAGES
        if format not in ("rosbag", "xdf") or damage not in ("garbage after the names", "text in the cells")
    ],
)
def test_a_damaged_file_is_one_line(
    format: str, damage: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Exit 2 with one line that names the file; not one is read as if nothing were wrong."""
    name, make = {**MAKERS, **FIRST_MAKERS}[format]
    file = _first_file(make(tmp_path / name))
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    label = f"label = {LABELS_IN_FILE[format]!r}\n" if format in LABELS_IN_FILE else ""
    sensor = f'[sensors.torso]\n{label}mount = {{ up = "+x", forward = "-z" }}\n'
    (tmp_path / "session.toml").write_text(f'[data]\nfile = "{name}"\nformat = "{format}"\n{sensor}')
    with pytest.raises(SystemExit) as stop:
        main(["track", str(tmp_path / "session.toml"), "-o", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    assert stop.value.code == 2, err
    assert (out, err.count("\n")) == ("", 1), err
    assert name in err


@pytest.mark.parametrize(
    ("format", "change", "says"),
    [
        ("shimmer", (b"deg/s", b"furl"), r"'Shimmer_8665_Gyro_X_CAL' is in 'furl'; there is: rad/s, deg/s"),
        ("shimmer", (b"Gyro", b"Gxxx"), "no sensor in it has Gyro and Accel_LN or Accel_WR, nor Quat"),
        ("noraxon", (b"Gyroscope", b"Gxxx"), "no sensor in it has both Gyroscope and Acceleration"),
        ("noraxon", (b"(mG)", b"(V)"), "is in 'V'; there is: m/s"),
        ("delsys", (b"GYRO Z (deg/s)", b"EMG 2 (mV)"), "no sensor in it has three channels of ACC and three of GYRO"),
        ("delsys", (b"ACC X Time Series (s)", b"ACC W"), "no time in common|no column of times"),
        ("sensor_logger", (b"time,seconds", b"tame,seconds"), "no column 'time' in Gyroscope.csv"),
        ("phyphox", (b"rad/s", b"m"), "is in 'm'; there is: rad/s, deg/s"),
    ],
)
def test_spoiled_contents(format: str, change: tuple[bytes, bytes], says: str, tmp_path: Path) -> None:
    name, make = MAKERS[format]
    path = make(tmp_path / name)
    file = _first_file(path)
    file.write_bytes(file.read_bytes().replace(*change))
    with pytest.raises(WeposeError, match=says) as error:
        read_device(path, format)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("format", "module", "package"), [("rosbag", "rosbags.highlevel", "rosbags"), ("xdf", "pyxdf", "pyxdf")]
)
def test_what_to_install_is_said(
    format: str, module: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, make = MAKERS[format]
    path = make(tmp_path / name)
    monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(BadData, match=f"pip install {package}"):
        read_device(path, format)
