"""Files of devices and programs (`device_files`) are read back in SI, and what is wrong in them is one line."""

import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import device_files as df
import numpy as np
import polars as pl
import pytest
from device_files import ACCEL, GYRO, MAKERS, R_WS, TIME, WXYZ, N, rows
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from test_info import info

import wepose_pin as wp
from wepose_pin import BadData, BadSession, OrientationSensor, Recording
from wepose_pin.commands import main

FORMATS_PAGE = Path(__file__).parents[1] / "docs" / "formats.md"
TORSO = "[sensors.torso]"


def load(folder: Path, text: str) -> Recording:
    (folder / "session.toml").write_text(text, encoding="utf-8")
    return wp.load_session(folder / "session.toml")


def load_file(folder: Path, file: str, sensors: str = TORSO, data: str = "") -> Recording:
    return load(folder, f'[data]\nfile = "{file}"\n{data}\n{sensors}')


def check_raw(recording: Recording, segment: str = "torso") -> None:
    sensor = recording.sensors[segment]
    np.testing.assert_allclose(sensor.gyro_S, GYRO, atol=1e-6)
    np.testing.assert_allclose(sensor.accel_S, ACCEL, atol=1e-6)
    np.testing.assert_allclose(recording.time, TIME, atol=1e-6)


def check_orientation(recording: Recording, segment: str = "torso") -> None:
    sensor = recording.sensors[segment]
    assert isinstance(sensor, OrientationSensor)
    assert (Rotation.from_quat(sensor.quat_VS).inv() * R_WS).magnitude().max() < 1e-6
    assert not sensor.aligned


# Each format, as its maker writes it ---------------------------------------------------------------------------------


def mt_quat(path: Path, names: str) -> Path:
    values = WXYZ if names.startswith("Quat") else np.degrees(R_WS.as_euler("ZYX"))[:, ::-1]
    columns: list[Any] = [[str(k) for k in range(N)], *values.T]
    path.write_text(df.PREAMBLE + "\t".join(["PacketCounter", *names.split()]) + "\n" + rows(columns, "\t"))
    return path


def mt_fine(path: Path) -> Path:
    """Without a rate the fine time counts tenths of milliseconds."""
    fine = [str((4294967000 + 100 * k) % 2**32) for k in range(N)]
    names = ",".join(["PacketCounter", "SampleTimeFine", *df.MT_RAW])
    path.write_text(f"// a\n{names}\n" + rows([[str(k) for k in range(N)], fine, *ACCEL.T, *GYRO.T]))
    return path


ARM = ("torso", "left_forearm")
MT = "MT_012345_001-000_00B40001.txt"
# How it is written, its name in the folder, what it holds, and the segments whose names it has.
FILES: list[tuple[Callable[[Path], Path], str, str, tuple[str, ...]]] = [
    *(
        (lambda p, s=s, d=d: df.mt_manager(p, separator=s, decimal=d), MT, "both", ("torso",))
        for s, d in [("\t", "."), (",", "."), (";", "."), (";", ","), ("\t", ","), (" ", ".")]
    ),
    *(
        (lambda p, names=names: mt_quat(p, names), "a.txt", "orientation", ("torso",))
        for names in ("Quat_q0 Quat_q1 Quat_q2 Quat_q3", "Quat_w Quat_x Quat_y Quat_z", "Roll Pitch Yaw")
    ),
    (mt_fine, "a.txt", "raw", ("torso",)),
    (df.apdm, "a.csv", "both", ("torso",)),
    (df.apdm_by_name, "a.csv", "both", ("torso",)),
    (df.apdm, "a.csv", "raw", ARM),
    (df.dot, "1_20250711.csv", "both", ("torso",)),
    (lambda p: df.dot(p, "quaternion"), "1.csv", "orientation", ("torso",)),
    (lambda p: df.dot(p, "euler"), "1.csv", "orientation", ("torso",)),
    (df.ximu3, "x-IMU3 12AB34CD (UDP)", "both", ("torso",)),
    (lambda p: df.ximu3(p, df.US0), "x-IMU3", "both", ("torso",)),
    (lambda p: df.ximu3(p) / "Inertial.csv", "x", "raw", ("torso",)),
    (lambda p: df.ximu3(p) / "Quaternion.csv", "x", "orientation", ("torso",)),
    (df.sto, "trial_orientations.sto", "orientation", ("torso", "right_upper_arm")),
    (df.shimmer, "left_wrist.csv", "raw", ("left_forearm",)),
    (lambda p: df.shimmer(p, "\t"), "left_wrist.csv", "raw", ("left_forearm",)),
    (lambda p: df.shimmer(p, ",", dates=True), "left_wrist.csv", "raw", ("left_forearm",)),
    (df.noraxon, "a.csv", "raw", ("torso", "right_forearm")),
    (lambda p: df.noraxon(p, "{} Accel Sensor {} (mG)"), "a.csv", "raw", ("torso", "right_forearm")),
    (df.delsys, "a.csv", "raw", ARM),
    (lambda p: df.delsys(p, ";", ","), "a.csv", "raw", ARM),
    (df.emgworks, "a.csv", "raw", ("torso",)),
    (df.sensor_logger, "left_wrist-2026-03-12", "both", ("left_forearm",)),
    (lambda p: df.sensor_logger(p) / "Gyroscope.csv", "left_wrist", "raw", ("left_forearm",)),
    (lambda p: df.sensor_logger(p, "ios"), "chest", "both", ("torso",)),
    (lambda p: df.sensor_logger(p, "ios", gravity=True), "chest", "raw", ("torso",)),
    (df.phyphox, "left_wrist 2026-03-12", "raw", ("left_forearm",)),
    (lambda p: df.phyphox(p, ";", ","), "left_wrist", "raw", ("left_forearm",)),
    (lambda p: df.phyphox(p, "\t", ".", "Gyro_{} (deg/s)"), "left_wrist", "raw", ("left_forearm",)),
    (lambda p: df.phyphox(p) / "Accelerometer.csv", "left_wrist", "raw", ("left_forearm",)),
    (df.rosbag, "bag", "both", ("torso",)),
    (lambda p: df.rosbag(p, raw=False), "bag", "orientation", ("torso",)),
    (lambda p: next(df.rosbag(p, mcap=True, frames=True).glob("*.mcap")), "bag", "both", ("torso",)),
    (df.two_streams, "a.xdf", "raw", ARM),
]


@pytest.mark.parametrize(("write", "name", "holds", "segments"), FILES)
def test_a_file_is_read_as_it_is_measured(
    write: Callable[[Path], Path], name: str, holds: str, segments: tuple[str, ...], tmp_path: Path
) -> None:
    file = write(tmp_path / name).relative_to(tmp_path)
    sensors = "".join(f"[sensors.{each}]\n" for each in segments)
    for use, check in (("raw", check_raw), ("orientation", check_orientation)):
        if holds in (use, "both"):
            recording = load_file(tmp_path, str(file), sensors, f'use = "{use}"')
            assert {each.code for each in recording.diagnostics} <= {"sensors-left-out"}
            for segment in segments:
                check(recording, segment)


@pytest.mark.parametrize(
    ("format", "use", "old"),
    [
        *((format, "raw", b"Gyr") for format in ("mt_manager", "dot", "ximu3", "apdm", "opensim")),
        *((format, "orientation", b"Q") for format in ("shimmer", "noraxon", "delsys", "phyphox")),
    ],
)
def test_what_is_not_there_cannot_be_used(format: str, use: str, old: bytes, tmp_path: Path) -> None:
    path = df.make(format, tmp_path)
    file = df.first_file(path)
    file.write_bytes(file.read_bytes().replace(old, b"Gxx"))
    with pytest.raises(BadData, match=r"(no sensor in it has|holds no) .*; leave out data\.use"):
        load_file(tmp_path, path.name, data=f'format = "{format}"\nuse = "{use}"')


def test_what_goes_before_what_in_a_file_with_both(tmp_path: Path) -> None:
    df.rosbag(tmp_path / "bag")
    recording = load_file(tmp_path, "bag", "[sensors.torso]\n[sensors.left_forearm]")
    assert len(recording) == N - 10
    np.testing.assert_allclose(recording.time, TIME[10:], atol=1e-6)
    np.testing.assert_allclose(recording.sensors["left_forearm"].accel_S, ACCEL[10:], atol=1e-4)
    df.apdm(tmp_path / "a.csv")
    (left_out,) = load_file(tmp_path, "a.csv", data='use = "orientation"').diagnostics
    assert (left_out.code, left_out.facts["devices"]) == ("sensors-left-out", "Left Wrist")
    with pytest.raises(BadSession, match=r"label is missing; which of a\.csv is it\? there is: Left Wrist, Chest"):
        load_file(tmp_path, "a.csv", "[sensors.head]")
    df.sto(tmp_path / "a.sto")
    check_orientation(load_file(tmp_path, "a.sto", '[sensors.head]\nlabel = "humerus_r_imu"'), "head")


def test_real_exports_of_mt_manager_2022(data: Path, tmp_path: Path) -> None:
    values = []
    for file in sorted((data / "mt_manager").glob("MT2022_*.txt")):
        recording = load_file(tmp_path, str(file), data="rate_hz = 100.0")
        assert len(recording) == 5
        sensor = recording.sensors["torso"]
        np.testing.assert_allclose(sensor.accel_S[3], [0.045482, -0.00984, 9.967645])
        np.testing.assert_allclose(sensor.gyro_S[3], [0.002354, 0.003944, 0.001659])
        ready = load_file(tmp_path, str(file), data="rate_hz = 100.0\nuse = 'orientation'")
        values.append(Rotation.from_quat(ready.sensors["torso"].quat_VS))
    assert len(values) == 2
    assert (values[0].inv() * values[1]).magnitude().max() < 1e-5  # one as a quaternion, one as a matrix


def test_a_real_export_of_apdm(data: Path, tmp_path: Path) -> None:
    """Gravity is up in the world of its orientations, and 128 Hz come from its microseconds."""
    file = data / "mt_manager" / "apdm_format7.csv"
    sensor = f"{TORSO}\nlabel = 'Right Foot'"
    recording = load_file(tmp_path, str(file), sensor)
    assert recording.rate_hz == pytest.approx(128.0, rel=1e-3)
    ready = load_file(tmp_path, str(file), sensor, "use = 'orientation'")
    up = Rotation.from_quat(ready.sensors["torso"].quat_VS).apply(recording.sensors["torso"].accel_S)
    np.testing.assert_allclose(up, np.tile([0.0, 0.0, 9.81], (3, 1)), atol=0.3)


# Clocks --------------------------------------------------------------------------------------------------------------


def test_sensors_of_one_station_share_its_counter(tmp_path: Path) -> None:
    """One sensor comes ten packets later; both count from 0 again; a packet that was lost is a gap."""
    df.mt_manager(tmp_path / "a.txt", first=65430)
    df.mt_manager(tmp_path / "b.txt", first=65440)
    recording = load(tmp_path, f'[data]\n{TORSO}\nfile = "a.txt"\n[sensors.left_forearm]\nfile = "b.txt"\n')
    assert recording.time[0] == pytest.approx(0.10)
    assert len(recording) == N - 10
    np.testing.assert_allclose(recording.sensors["left_forearm"].accel_S, ACCEL[:-10], atol=1e-6)
    np.testing.assert_allclose(recording.sensors["torso"].accel_S, ACCEL[10:], atol=1e-6)
    lines = (tmp_path / "a.txt").read_text().splitlines(keepends=True)
    (tmp_path / "a.txt").write_text("".join(lines[:100] + lines[103:]))
    assert len(load_file(tmp_path, "a.txt")) == N


@pytest.mark.parametrize(("separator", "fine"), [("\t", "NaN"), (",", ""), (" ", "NaN")])
def test_mt_manager_without_a_rate_is_read_with_that_of_the_session(fine: str, separator: str, tmp_path: Path) -> None:
    """MT Manager 2022 states no update rate, and writes NaN for what was not measured; its counter shows lost rows."""
    for name in ("a.txt", "b.txt"):
        lines = df.mt_manager(tmp_path / name, separator=separator, preamble="// MT Manager version: 2022.2.0\n")
        rows_ = lines.read_text().splitlines(keepends=True)
        rows_[2:] = [row.replace(separator, f"{separator}{fine}", 1) for row in rows_[2:]]
        lines.write_text("".join(rows_))
    # The rate of [data] is that of all; a sensor's own goes before it.
    both = f'{TORSO}\nfile = "a.txt"\n[sensors.left_forearm]\nfile = "b.txt"\n'
    check_raw(load(tmp_path, f"[data]\nrate_hz = 100\n{both}"), "left_forearm")
    own = both.replace('"\n', '"\nrate_hz = 100\n')
    check_raw(load(tmp_path, f"[data]\n{own}"))
    (tmp_path / "c.txt").write_text("".join(rows_[:50] + rows_[53:]))
    assert len(load_file(tmp_path, "c.txt", data="rate_hz = 100.0")) == N
    with pytest.raises(BadData, match=r"state the update rate as rate_hz in \[data\]"):
        load(tmp_path, f"[data]\n{both}")


def test_dots_that_were_synchronised_have_one_clock_even_where_it_begins_anew(tmp_path: Path) -> None:
    sensors = ""
    for name, file, first_us in (
        ("torso", "a", 2**32 - 2_000_000),
        ("left_forearm", "b", 2**32 - 1_800_000),
        ("right_forearm", "c", 2**32 - 100_000),  # 1.9 s after the first
    ):
        df.dot(tmp_path / f"{file}.csv", first_us=first_us)
        sensors += f'[sensors.{name}]\nfile = "{file}.csv"\n'
    recording = load(tmp_path, f"[data]\n{sensors}")
    assert recording.time[0] == pytest.approx(1.9)
    for name, k in (("torso", 190), ("left_forearm", 170), ("right_forearm", 0)):
        np.testing.assert_allclose(recording.sensors[name].accel_S[0], ACCEL[k], atol=1e-6)
    df.dot(tmp_path / "d.csv", sync="Un-synced")
    (unsynced,) = load_file(tmp_path, "d.csv").diagnostics
    assert (unsynced.code, unsynced.place) == ("device-not-synchronized", "d.csv")


def test_a_dot_without_its_preamble_must_be_named_if_rates_alone_are_in_it(tmp_path: Path) -> None:
    path = df.dot(tmp_path / "a.csv")
    table = path.read_bytes().partition(b"\n\n")[2]
    path.write_bytes(table)
    check_raw(load_file(tmp_path, "a.csv"))  # Quat_W is the DOT's word
    path.write_bytes(table.replace(b"Quat_", b"Other_"))  # Gyr_X could be in deg/s or rad/s
    with pytest.raises(BadSession, match=r"sensors\.torso\.gyro is missing"):
        load_file(tmp_path, "a.csv")
    check_raw(load_file(tmp_path, "a.csv", data='format = "dot"'))


def test_devices_that_were_switched_on_at_other_times_need_an_offset(tmp_path: Path) -> None:
    df.ximu3(tmp_path / "a")
    df.ximu3(tmp_path / "b", 90_000_000)
    text = f'[data]\n{TORSO}\nfile = "a"\n[sensors.left_forearm]\nfile = "b"\n'
    with pytest.raises(BadData, match=r"clocks do not overlap .*check each sensor's time and offset_s"):
        load(tmp_path, text)
    assert len(load(tmp_path, f"{text}offset_s = -37.899653\n")) >= N - 1
    (tmp_path / "a" / "Quaternion.csv").unlink()
    with pytest.raises(BadData, match=r"no Quaternion\.csv in it"):
        load_file(tmp_path, "a", data='use = "orientation"')


def test_equal_stamps_are_spread_and_two_clocks_joined_at_the_times_of_the_rates(tmp_path: Path) -> None:
    """A Shimmer stamps two samples alike. A phone's force comes 3 ms later, and ten samples of it are lost."""
    file = df.shimmer(tmp_path / "a.csv")
    lines = file.read_text().splitlines(keepends=True)
    lines[60] = lines[59].partition(";")[0] + lines[60][lines[60].index(";") :]
    file.write_text("".join(lines))
    assert len(load_file(tmp_path, "a.csv")) == N
    phone = df.sensor_logger(tmp_path / "chest", late=0.003)
    true = np.column_stack([np.interp(TIME[1:], TIME + 0.003, axis) for axis in ACCEL.T])
    np.testing.assert_allclose(load_file(tmp_path, "chest").sensors["torso"].accel_S, true, atol=1e-5)
    force = phone / "TotalAcceleration.csv"
    lines = force.read_text().splitlines(keepends=True)
    force.write_text("".join(lines[:101] + lines[111:]))
    with pytest.raises(BadData, match=r"accel: samples are missing for 0\.110 s from 0\.990 s"):
        load_file(tmp_path, "chest")


# What devices leave open ---------------------------------------------------------------------------------------------


def test_a_shimmer_beyond_the_range_of_its_low_noise_accelerometer_is_read_by_the_other(tmp_path: Path) -> None:
    df.shimmer(tmp_path / "a.csv", scale=2.1)
    accel = load_file(tmp_path, "a.csv").sensors["torso"].accel_S
    np.testing.assert_allclose(accel, ACCEL + 0.1, atol=1e-6)


def test_phones_as_zip_and_side_by_side(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name in ("chest", "left_wrist"):
        df.sensor_logger(tmp_path / name)
    info(capsys, tmp_path / "chest", "--write")
    assert set(wp.load_session(tmp_path / "session.toml").sensors) == {"torso", "left_forearm"}
    for zipped, folder in (("a.zip", tmp_path / "chest"), ("b.zip", df.phyphox(tmp_path / "in"))):
        with zipfile.ZipFile(tmp_path / zipped, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in folder.iterdir():
                archive.write(file, file.name)
        check_raw(load_file(tmp_path, zipped))
    (tmp_path / "chest" / "Metadata.csv").unlink()
    assert [each.code for each in load_file(tmp_path, "chest").diagnostics] == ["file-assumption"]


def test_xdf_with_streams_of_their_own_without_units_or_cut_off(tmp_path: Path) -> None:
    """Gravity says the unit of the forces."""
    streams = {"torso Gyroscope": (["gyr_x", "gyr_y", "gyr_z"], [""] * 3, GYRO)}
    streams["torso Accelerometer"] = ["acc_x", "acc_y", "acc_z"], [""] * 3, ACCEL / df.G
    df.xdf(tmp_path / "a.xdf", streams)
    recording = load_file(tmp_path, "a.xdf")
    check_raw(recording)
    assumed = {each.facts["unit"] for each in recording.diagnostics if each.code == "file-assumption"}
    assert assumed == {"rad/s", "g"}
    df.two_streams(tmp_path / "b.xdf", cut=100)
    (diagnostic,) = load_file(tmp_path, "b.xdf").diagnostics
    assert (diagnostic.code, diagnostic.place) == ("file-incomplete", "b.xdf")
    df.xdf(tmp_path / "c.xdf", {"torso": (df.LABELS, ["furlong"] * 3 + ["rad/s"] * 3, np.column_stack([ACCEL, GYRO]))})
    with pytest.raises(BadData, match=r"'torso acc_x' is in 'furlong'; there is: m/s\^2, g, mg"):
        load_file(tmp_path, "c.xdf")


# HDF5 and MATLAB ---------------------------------------------------------------------------------------------------

ARRAYS = """
[data]
file = "{file}"
time = "/clock/time"
gyro_unit = "rad/s"
accel_unit = "m/s^2"
[sensors.torso]
gyro = "/imu/torso/gyro"
accel = "/imu/torso/accel"
"""
READY = '{file}"\nrate_hz = 100.0\n[sensors.torso]\norientation = ["/q[1]", "/q[2]", "/q[3]", "/q[0]"]\n#"'


def mat73(path: Path) -> Path:
    with pytest.importorskip("h5py").File(path, "w", userblock_size=512) as file:
        for name, values in {"/imu/torso/gyro": GYRO.T, "/imu/torso/accel": ACCEL.T, "/q": WXYZ.T}.items():
            file[name] = values
        file["/clock/time"] = TIME[None]
    path.write_bytes(b"MATLAB 7.3" + path.read_bytes()[10:])
    return path


@pytest.mark.parametrize(
    "make", [df.hdf5, lambda path: df.hdf5(path, True), df.mat, mat73], ids=["hdf5", "turned", "mat", "mat 7.3"]
)
def test_arrays_by_their_path(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path / ("a.mat" if make in (df.mat, mat73) else "a.h5"))
    check_raw(load(tmp_path, ARRAYS.format(file=path.name)))
    check_raw(load(tmp_path, ARRAYS.format(file=path.name).replace("/imu/torso/gyro", "imu.torso.gyro")))
    check_orientation(load_file(tmp_path, READY.format(file=path.name), ""))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("/imu/torso/gyro", "/imu/torso/gyr"), "no array '/imu/torso/gyr' in a.mat; did you mean"),
        (("/imu/torso/gyro", "/q"), r"/q in a\.mat has shape \(400, 4\); \(n, 3\) is needed"),
        (("/clock/time", "/q"), r"name one as /q\[0\]"),
        (('"/imu/torso/gyro"', '["/q[0]", "/q[1]", "/q[9]"]'), r"/q\[9\] is not one column"),
        (("/imu/torso/gyro", "/short"), r"differ in length: .*/short\[0\] 399"),
        (("a.mat", "a.csv"), r"torso\.gyro = '/imu/torso/gyro'; a list of 3 different column"),
    ],
)
def test_arrays_that_are_not_there(change: tuple[str, str], says: str, tmp_path: Path) -> None:
    content = {"imu": {"torso": {"gyro": GYRO, "accel": ACCEL}}, "clock": {"time": TIME}, "q": WXYZ, "short": GYRO[1:]}
    savemat(tmp_path / "a.mat", content)
    pl.DataFrame({"clock": TIME}).write_csv(tmp_path / "a.csv")
    with pytest.raises(wp.WeposeError, match=says):
        load(tmp_path, ARRAYS.format(file="a.mat").replace(*change))


# What every reader does --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", MAKERS)
def test_the_session_that_is_proposed_needs_no_editing(
    format: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Where the segment is in a name; and a rate goes before the file's own times."""
    path = df.make(format, tmp_path)
    if format not in ("mt_manager", "dot", "ximu3"):  # whose files name no segment
        assert "CHECK: the file" not in info(capsys, path, "--write")
        recording = wp.load_session(tmp_path / "session.toml")
        assert "torso" in recording.sensors
        assert recording.time[0] == pytest.approx(0.1 if format == "rosbag" else 0.0, abs=1e-6)
    for keys in (("rate_hz = 50.0", TORSO), ("", f"{TORSO}\nrate_hz = 50.0")):
        assert load_file(tmp_path, path.name, keys[1], keys[0]).rate_hz == pytest.approx(50.0)


TABLES = ("mt_manager", "dot", "ximu3", "apdm")


@pytest.mark.parametrize("format", TABLES)
def test_a_last_line_that_was_cut_off_is_left_out_and_gigantic_numbers_refused(format: str, tmp_path: Path) -> None:
    path = df.make(format, tmp_path)
    file = df.first_file(path)
    whole = file.read_bytes()
    file.write_bytes(whole[:-60])
    recording = load_file(tmp_path, path.name)
    assert N - 2 <= len(recording) < N
    np.testing.assert_allclose(recording.sensors["torso"].accel_S, ACCEL[: len(recording)], atol=1e-6)
    lines, separator = whole.splitlines(keepends=True), b"\t" if format == "mt_manager" else b","
    cells = lines[-40].split(separator)
    cells[{"mt_manager": 2, "dot": 7, "ximu3": 4, "apdm": 16}[format]] = b"1e300"
    lines[-40] = separator.join(cells)
    file.write_bytes(b"".join(lines))
    with pytest.raises(BadData, match=r"in row 361; no device measures as much"):
        load_file(tmp_path, path.name)


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


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("format", MAKERS)
def test_a_damaged_file_is_one_line(
    format: str, damage: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Exit 2 with one line that names the file; not one is read as if nothing were wrong."""
    if format in ("rosbag", "xdf") and damage in ("garbage after the names", "text in the cells"):
        return
    path = df.make(format, tmp_path)
    file = df.first_file(path)
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    label = f"label = {LABELS_IN_FILE[format]!r}\n" if format in LABELS_IN_FILE else ""
    sensor = f'{TORSO}\n{label}mount = {{ up = "+x", forward = "-z" }}\n'
    (tmp_path / "session.toml").write_text(f'[data]\nfile = "{path.name}"\nformat = "{format}"\n{sensor}')
    with pytest.raises(SystemExit) as stop:
        main(["track", str(tmp_path / "session.toml"), "-o", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    assert stop.value.code == 2, err
    assert (out, err.count("\n")) == ("", 1), err
    assert path.name in err


@pytest.mark.parametrize(
    ("format", "change", "says"),
    [
        ("opensim", (b"DataType=Quaternion", b"DataType=double"), "DataType=double; orientations are needed"),
        ("opensim", (b"0.010000\t", b"0.010000\tmore\t"), "cannot be read as an OpenSim .sto; .* more fields"),
        ("opensim", (b"1.000000000,0.", b"one,0."), "in column 'torso_imu'; .*one"),
        ("shimmer", (b"deg/s", b"furl"), r"'Shimmer_8665_Gyro_X_CAL' is in 'furl'; there is: rad/s, deg/s"),
        ("shimmer", (b"Gyro", b"Gxxx"), "no sensor in it has Gyro and Accel_LN or Accel_WR, or Quat"),
        ("delsys", (b"GYRO Z (deg/s)", b"EMG 2 (mV)"), "no sensor in it has three channels of ACC and three of GYRO"),
        ("delsys", (b"ACC X Time Series (s)", b"ACC W"), "no time in common|no column of times"),
        ("sensor_logger", (b"time,seconds", b"tame,seconds"), "no column 'time' in Gyroscope.csv"),
    ],
)
def test_spoiled_contents(format: str, change: tuple[bytes, bytes], says: str, tmp_path: Path) -> None:
    path = df.make(format, tmp_path)
    file = df.first_file(path)
    file.write_bytes(file.read_bytes().replace(*change))
    with pytest.raises(wp.WeposeError, match=says) as error:
        load_file(tmp_path, path.name, data=f'format = "{format}"')
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("write", "module", "package"),
    [
        (lambda f: df.rosbag(f / "a"), "rosbags.highlevel", "rosbags"),
        (lambda f: df.two_streams(f / "a.xdf"), "pyxdf", "pyxdf"),
        (lambda f: df.hdf5(f / "a.h5"), "h5py", "h5py"),
    ],
)
def test_what_to_install_is_said(
    write: Callable[[Path], Path], module: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(BadData, match=f"pip install {package}"):
        load(tmp_path, ARRAYS.format(file=path.name)) if package == "h5py" else load_file(tmp_path, path.name)


# A description of one's own ----------------------------------------------------------------------------------------


def own_format(folder: Path) -> str:
    """Write the description and the table of the page, with the known motion of two sensors, and return the former."""
    page = FORMATS_PAGE.read_text(encoding="utf-8")
    text = page.partition("## A device of your own")[2].partition("```toml\n")[2].partition("```")[0]
    head, names, *_ = page.partition("```text\n")[2].splitlines()
    names = ";".join([names, *(name.replace("chest", "left_wrist") for name in names.split(";")[1:])])
    sensor = [*np.degrees(GYRO).T, *(1e3 / df.G * ACCEL).T]
    other = [*np.degrees(GYRO).T, *(1e3 / df.G * df.own(ACCEL, Path("other"))).T]
    table = rows([5e3 + 1e3 * TIME, *sensor, *other], ";")
    (folder / "walk.csv").write_text(f"{head}\n{names}\n{table}")
    return text


@pytest.mark.parametrize("stated", ["", 'format = "lab.toml"\n'])
def test_a_description_beside_the_session_is_read(stated: str, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(own_format(tmp_path))
    recording = load_file(tmp_path, "walk.csv", f"{TORSO}\n[sensors.left_forearm]", stated)
    check_raw(recording)
    check_raw(recording, "left_forearm")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[xyz]", "[xyz"), r"lab\.toml: '.*' is no regular expression"),
        (("(?P<axis>[xyz])", "[xyz]"), r"gyro 1\.columns = \['.*'\]; needed: a pattern with \(\?P<axis>"),
        (("unit_s", "unit"), r"clock 1\.unit is not a known key; did you mean 'unit_s'"),
        (('"mg"', '"furlong"'), r"'chest fx' is in 'furlong'; there is: m/s\^2, g, mg"),
        (('"t_ms"', '"t_s"'), r"walk\.csv: no line of names with 't_s' and columns of a signal"),
        (("[[accel]]", "[[gyro]]\ncolumns = []\n[[accel]]"), r"gyro 2\.columns = \[\]; needed: one pattern or 3 names"),
    ],
)
def test_a_description_that_is_wrong_is_one_line(change: tuple[str, str], says: str, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(own_format(tmp_path).replace(*change))
    with pytest.raises(wp.WeposeError, match=says) as error:
        load_file(tmp_path, "walk.csv", f'{TORSO}\nlabel = "chest"', 'format = "lab.toml"')
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('format = "lab.toml"\n[sensors.torso]\ngyro_unit = "deg/s"', r"gyro_unit has no effect, as the format of the"),
        ('format = "lab.toml"\ntime = "t"', r"data\.time has no effect, as the format of the file defines it"),
        ('format = "dott"', "did you mean 'dot'"),
        ('format = "mine.toml"', r"mine\.toml: no such file"),
    ],
)
def test_keys_beside_a_format(keys: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(own_format(tmp_path))
    with pytest.raises(wp.WeposeError, match=says):
        load_file(tmp_path, "walk.csv", "" if TORSO in keys else TORSO, keys)


@pytest.mark.parametrize(
    ("labels", "segments"),
    [
        ("humerus_r_imu LeftForeArm T8", "right_upper_arm left_forearm torso"),
        ("hand_r UA_L left_wrist", "right_hand left_upper_arm left_forearm"),
        (
            "Right_upper_arm FA_right MT_012345_001-000_00B40001 forearm tibia_r_imu fast_l",
            "right_upper_arm right_forearm",
        ),
    ],
)
def test_segments_by_their_names(
    labels: str, segments: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    df.sto(tmp_path / "a.sto", labels=tuple(labels.split()))
    info(capsys, tmp_path / "a.sto", "--write")
    assert set(wp.load_session(tmp_path).sensors) == set(segments.split())


def test_the_examples_of_the_page_are_sessions_that_lack_their_data_alone(tmp_path: Path) -> None:
    blocks = FORMATS_PAGE.read_text(encoding="utf-8").partition("## A device of your own")[0].split("```toml\n")[1:]
    assert len(blocks) == 7
    for block in blocks:
        with pytest.raises(wp.MissingFile):
            load(tmp_path, block.partition("```")[0])
