"""Files of devices and programs: each written as its maker writes it, of one known motion, and read back in SI."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from test_mvnx import mvnx, turning

import wepose_pin as wp
from wepose_pin.body import load_table
from wepose_pin.diagnostics import WARNING, Diagnostic
from wepose_pin.errors import BadData, BadSession, MissingFile, UnknownColumn, WeposeError
from wepose_pin.readers.guess import guess_columns
from wepose_pin.readers.registry import detect_format, read_device
from wepose_pin.readers.table_format import unwrap_counter
from wepose_pin.recording import OrientationSensor, Recording

N, RATE = 400, 100.0
FORMATS_PAGE = Path(__file__).parents[1] / "docs" / "formats.md"
TIME = np.arange(N) / RATE
R_WS = Rotation.from_euler("ZYX", np.column_stack([0.8 * np.sin(TIME), 0.5 * np.sin(2 * TIME), 0.3 * TIME]))
GYRO = np.concatenate([np.zeros((1, 3)), (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE])
ACCEL = R_WS.inv().apply([0.0, 0.0, 9.80665])
WXYZ = R_WS.as_quat()[:, [3, 0, 1, 2]]


def rows(columns: list[np.ndarray | list[str]], separator: str = ",", decimal: str = ".") -> str:
    cells = [[v if isinstance(v, str) else f"{v:.9g}" for v in column] for column in columns]
    return "".join(separator.join(row).replace(".", decimal) + "\n" for row in zip(*cells, strict=True))


def load(folder: Path, text: str) -> Recording:
    (folder / "session.toml").write_text(text, encoding="utf-8")
    return wp.load_session(folder / "session.toml")


def check_raw(recording: Recording, segment: str = "torso") -> None:
    sensor = recording.sensors[segment]
    np.testing.assert_allclose(sensor.gyro_S, GYRO, atol=1e-6)
    np.testing.assert_allclose(sensor.accel_S, ACCEL, atol=1e-6)
    np.testing.assert_allclose(recording.time, TIME, atol=1e-6)


def own(values: np.ndarray, path: Path) -> np.ndarray:
    """With a noise of its own, far below what is compared: no two sensors give the same values."""
    return values + 1e-7 * np.random.default_rng(list(str(path).encode())).standard_normal(values.shape)


def check_orientation(recording: Recording, segment: str = "torso") -> None:
    sensor = recording.sensors[segment]
    assert isinstance(sensor, OrientationSensor)
    assert (Rotation.from_quat(sensor.quat_VS).inv() * R_WS).magnitude().max() < 1e-6
    assert not sensor.aligned


# Xsens MT Manager --------------------------------------------------------------------------------------------------

PREAMBLE = (
    "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n// Firmware Version: 4.6.0\n"
)
MT_RAW = [f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ"]


def mt_manager(
    path: Path, *, separator: str = "\t", decimal: str = ".", preamble: str = PREAMBLE, first: int = 0, raw: bool = True
) -> Path:
    matrix = R_WS.as_matrix().transpose(0, 2, 1).reshape(N, 9)  # columns of the matrix one after the other
    names = ["PacketCounter", "SampleTimeFine", *(MT_RAW if raw else [])]
    names += [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
    columns: list[Any] = [[f"{(first + k) % 65536:05d}" for k in range(N)], [""] * N]
    columns += [*own(ACCEL, path).T, *GYRO.T, *matrix.T] if raw else [*matrix.T]
    path.write_text(preamble + separator.join(names) + "\n" + rows(columns, separator, decimal), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("separator", "decimal"), [("\t", "."), (",", "."), (";", "."), (";", ","), ("\t", ","), (" ", ".")]
)
def test_mt_manager_in_every_separator(separator: str, decimal: str, tmp_path: Path) -> None:
    path = mt_manager(tmp_path / "MT_012345_001-000_00B40001.txt", separator=separator, decimal=decimal)
    assert detect_format(path) == "mt_manager"
    check_raw(load(tmp_path, f'[data]\nfile = "{path.name}"\n[sensors.torso]'))
    check_orientation(load(tmp_path, f'[data]\nfile = "{path.name}"\nuse = "orientation"\n[sensors.torso]'))


@pytest.mark.parametrize("names", ["Quat_q0 Quat_q1 Quat_q2 Quat_q3", "Quat_w Quat_x Quat_y Quat_z", "Roll Pitch Yaw"])
def test_mt_manager_orientations_of_each_kind(names: str, tmp_path: Path) -> None:
    values = WXYZ if names.startswith("Quat") else np.degrees(R_WS.as_euler("ZYX"))[:, ::-1]
    columns: list[Any] = [[str(k) for k in range(N)], *values.T]
    text = PREAMBLE + "\t".join(["PacketCounter", *names.split()]) + "\n" + rows(columns, "\t")
    (tmp_path / "a.txt").write_text(text)
    check_orientation(load(tmp_path, '[data]\nfile = "a.txt"\n[sensors.torso]'))


def test_sensors_of_one_station_share_its_counter(tmp_path: Path) -> None:
    """One sensor comes ten packets later and after the counter began anew."""
    mt_manager(tmp_path / "a.txt", first=65530)
    mt_manager(tmp_path / "b.txt", first=4)
    sensors = '[sensors.torso]\nfile = "a.txt"\n[sensors.left_forearm]\nfile = "b.txt"\n'
    recording = load(tmp_path, f"[data]\n{sensors}")
    assert recording.time[0] == pytest.approx(0.10)
    assert len(recording) == N - 10
    np.testing.assert_allclose(recording.sensors["left_forearm"].accel_S, ACCEL[:-10], atol=1e-6)
    np.testing.assert_allclose(recording.sensors["torso"].accel_S, ACCEL[10:], atol=1e-6)


def test_packets_lost_on_the_air_are_gaps(tmp_path: Path) -> None:
    path = mt_manager(tmp_path / "a.txt")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:100] + lines[103:]))
    recording = load(tmp_path, '[data]\nfile = "a.txt"\n[sensors.torso]')
    assert len(recording) == N


def test_without_a_rate_the_fine_time_counts_tenths_of_milliseconds(tmp_path: Path) -> None:
    fine = [str((4294967000 + 100 * k) % 2**32) for k in range(N)]
    text = "// a\n" + ",".join(["PacketCounter", "SampleTimeFine", *MT_RAW]) + "\n"
    (tmp_path / "a.txt").write_text(text + rows([[str(k) for k in range(N)], fine, *ACCEL.T, *GYRO.T]))
    check_raw(load(tmp_path, '[data]\nfile = "a.txt"\n[sensors.torso]'))


@pytest.mark.parametrize("separator", ["\t", ",", ";", " "])
@pytest.mark.parametrize("fine", ["NaN", ""])
def test_mt_manager_without_a_rate_is_read_with_that_of_the_session(fine: str, separator: str, tmp_path: Path) -> None:
    """MT Manager 2022 states no update rate, and writes NaN for what was not measured; its counter shows lost rows."""
    for name in ("a.txt", "b.txt"):
        lines = mt_manager(tmp_path / name, separator=separator, preamble="// MT Manager version: 2022.2.0\n")
        rows_ = lines.read_text().splitlines(keepends=True)
        rows_[2:] = [row.replace(separator, f"{separator}{fine}", 1) for row in rows_[2:]]
        lines.write_text("".join(rows_))
    check_raw(load(tmp_path, '[data]\nfile = "a.txt"\nrate_hz = 100.0\n[sensors.torso]'))
    # The rate of [data] is that of all; a sensor's own goes before it.
    both = '[sensors.torso]\nfile = "a.txt"\n[sensors.left_forearm]\nfile = "b.txt"\n'
    check_raw(load(tmp_path, f"[data]\nrate_hz = 100\n{both}"), "left_forearm")
    own = both.replace('"\n', '"\nrate_hz = 100\n')
    check_raw(load(tmp_path, f"[data]\n{own}"))
    (tmp_path / "c.txt").write_text("".join(rows_[:50] + rows_[53:]))
    lost = load(tmp_path, '[data]\nfile = "c.txt"\nrate_hz = 100.0\n[sensors.torso]')
    assert len(lost) == N
    with pytest.raises(BadData, match=r"state the update rate as rate_hz in \[data\]"):
        load(tmp_path, f"[data]\n{both}")


def test_real_exports_of_mt_manager_2022(data: Path, tmp_path: Path) -> None:
    values = []
    for file in sorted((data / "mt_manager").glob("MT2022_*.txt")):
        recording = load(tmp_path, f"[data]\nfile = '{file}'\nrate_hz = 100.0\n[sensors.torso]")
        assert len(recording) == 5
        sensor = recording.sensors["torso"]
        np.testing.assert_allclose(sensor.accel_S[3], [0.045482, -0.00984, 9.967645])
        np.testing.assert_allclose(sensor.gyro_S[3], [0.002354, 0.003944, 0.001659])
        ready = load(tmp_path, f"[data]\nfile = '{file}'\nrate_hz = 100.0\nuse = 'orientation'\n[sensors.torso]")
        values.append(Rotation.from_quat(ready.sensors["torso"].quat_VS))
    assert len(values) == 2
    assert (values[0].inv() * values[1]).magnitude().max() < 1e-5  # one as a quaternion, one as a matrix


@pytest.mark.parametrize("format", ["mt_manager", "dot", "ximu3", "opensim", "apdm", "mvnx"])
@pytest.mark.parametrize("where", ["data", "sensor"])
def test_a_rate_goes_before_the_files_own_times(format: str, where: str, tmp_path: Path) -> None:
    path = made(format, tmp_path).relative_to(tmp_path)
    label = {"apdm": 'label = "Chest"', "opensim": 'label = "torso_imu"'}.get(format, "")
    rate = "rate_hz = 50.0"
    sensor = f"[sensors.torso]\n{label}\n{rate}" if where == "sensor" else f"{rate}\n[sensors.torso]\n{label}"
    recording = load(tmp_path, f'[data]\nfile = "{path}"\n{sensor}')
    assert recording.rate_hz == pytest.approx(50.0)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("where", ["data", "sensor"])
@pytest.mark.parametrize(("unit", "a_second"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_the_unit_that_is_stated(unit: str, a_second: float, where: str, suffix: str, tmp_path: Path) -> None:
    frame = pl.DataFrame(np.column_stack([a_second * TIME, GYRO, ACCEL]), schema=["t", *"abcdef"])
    frame.write_csv(tmp_path / "a.csv") if suffix == ".csv" else frame.write_parquet(tmp_path / "a.parquet")
    own = f"file = 'a{suffix}'\ntime = 't'\ntime_unit = '{unit}'"
    sensor = "[sensors.torso]\ngyro = ['a', 'b', 'c']\naccel = ['d', 'e', 'f']"
    text = f"[data]\ngyro_unit = 'rad/s'\naccel_unit = 'm/s^2'\n{own}\n{sensor}"
    if where == "sensor":
        text = f"[data]\ngyro_unit = 'rad/s'\naccel_unit = 'm/s^2'\n{sensor}\n{own}"
    check_raw(load(tmp_path, text))
    with pytest.raises(BadSession, match=r"time_unit = 'min' is not known; there is: s, ms, us, ns"):
        load(tmp_path, text.replace(f"'{unit}'", "'min'"))


def test_the_clock_in_data_is_that_of_all_sensors_without_their_own(tmp_path: Path) -> None:
    values = "gyro = ['a', 'b', 'c']\naccel = ['d', 'e', 'f']\n"
    sensors = ""
    for file, name in (("a.csv", "torso"), ("b.csv", "left_forearm")):
        accel = own(ACCEL, Path(file))
        pl.DataFrame(np.column_stack([1e3 * TIME, GYRO, accel]), schema=["t", *"abcdef"]).write_csv(tmp_path / file)
        sensors += f"[sensors.{name}]\nfile = '{file}'\n{values}"
    units = "[data]\ngyro_unit = 'rad/s'\naccel_unit = 'm/s^2'\n"
    check_raw(load(tmp_path, f"{units}time = 't'\ntime_unit = 'ms'\n{sensors}"), "left_forearm")
    check_raw(load(tmp_path, f"{units}rate_hz = 100\n{sensors}"), "left_forearm")
    own_times = sensors.replace("file = 'b.csv'", "file = 'b.csv'\ntime = 't'\ntime_unit = 'ms'")
    check_raw(load(tmp_path, f"{units}rate_hz = 100\n{own_times}"), "left_forearm")


# APDM --------------------------------------------------------------------------------------------------------------


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
    names = [
        f"Chest/{kind}/{axis}" for kind in ("Acceleration", "Angular Velocity", "Magnetic Field") for axis in "XYZ"
    ]
    names += [f"Chest/Orientation/{axis}" for axis in ("Scalar", "X", "Y", "Z")]
    units = ["s", *["m/s^2"] * 3, *["deg/s"] * 3, *["uT"] * 3, *[""] * 4]
    head = f"Test Name:,walk,,\nSample Rate:,100,Hz,\n{','.join(['Time', *names])}\n{','.join(units)}\n"
    magnetic = [np.zeros(N)] * 3
    path.write_text(head + rows([TIME, *ACCEL.T, *np.degrees(GYRO).T, *magnetic, *WXYZ.T]))
    return path


@pytest.mark.parametrize("make", [apdm, apdm_by_name])
def test_apdm(make: Callable[[Path], Path], tmp_path: Path) -> None:
    assert detect_format(make(tmp_path / "a.csv")) == "apdm"
    check_raw(load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]'))
    check_orientation(load(tmp_path, '[data]\nfile = "a.csv"\nuse = "orientation"\n[sensors.torso]'))


def test_apdm_knows_its_sensors_by_name(tmp_path: Path) -> None:
    apdm(tmp_path / "a.csv")
    check_raw(load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]\n[sensors.left_forearm]'), "left_forearm")
    with pytest.raises(BadSession, match=r"label is missing; which of a\.csv is it\? there is: Left Wrist, Chest"):
        load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.head]')
    device = read_device(tmp_path / "a.csv", "apdm", "orientation")
    assert list(device.sensors) == ["Chest"]
    (missing,) = device.diagnostics
    assert (missing.code, missing.facts["devices"]) == ("sensors-left-out", "Left Wrist")


def test_a_real_export_of_apdm(data: Path, tmp_path: Path) -> None:
    """Gravity is up in the world of its orientations, and 128 Hz come from its microseconds."""
    file = data / "mt_manager" / "apdm_format7.csv"
    device = read_device(file, "apdm")
    assert list(device.sensors) == ["Lumbar", "Right Ankle", "Left Ankle", "Left Foot", "Chest", "Right Foot"]
    recording = load(tmp_path, f"[data]\nfile = '{file}'\n[sensors.torso]\nlabel = 'Right Foot'")
    assert recording.rate_hz == pytest.approx(128.0, rel=1e-3)
    ready = load(tmp_path, f"[data]\nfile = '{file}'\nuse = 'orientation'\n[sensors.torso]\nlabel = 'Right Foot'")
    up = Rotation.from_quat(ready.sensors["torso"].quat_VS).apply(recording.sensors["torso"].accel_S)
    np.testing.assert_allclose(up, np.tile([0.0, 0.0, 9.81], (3, 1)), atol=0.3)


# Movella DOT -------------------------------------------------------------------------------------------------------

DOT = (
    "sep=,\nDeviceTag:,{tag}\nFirmwareVersion:,3.0.0\nAppVersion:,2023.6.0\nSyncStatus:,{sync}\nOutputRate:,100Hz\n"
    "FilterProfile:,General\nMeasurement Mode:,Custom Mode 5\nStartTime: ,2025-07-11_20:06:00_086 WEST\n"
    "© Movella Technologies B. V. 2005-2025\n\n"
)


def dot(path: Path, mode: str = "rates", *, tag: str = "left_wrist", sync: str = "Synced", first_us: int = 0) -> Path:
    fine = [str((first_us + 10000 * k) % 2**32) for k in range(N)]
    step = np.concatenate([np.zeros((1, 3)), (R_WS[:-1].inv() * R_WS[1:]).as_rotvec()])
    modes: dict[str, dict[str, np.ndarray]] = {
        "rates": {
            "Quat_W,Quat_X,Quat_Y,Quat_Z": WXYZ,
            "Acc_X,Acc_Y,Acc_Z": own(ACCEL, path),
            "Gyr_X,Gyr_Y,Gyr_Z": np.degrees(GYRO),
        },
        "increments": {
            "dq_W,dq_X,dq_Y,dq_Z": Rotation.from_rotvec(step).as_quat()[:, [3, 0, 1, 2]],
            "dv[1],dv[2],dv[3]": ACCEL / RATE,
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


@pytest.mark.parametrize("mode", ["rates", "increments"])
def test_dot_rates_and_increments(mode: str, tmp_path: Path) -> None:
    path = dot(tmp_path / "1_20250711.csv", mode)
    assert detect_format(path) == "dot"
    recording = load(tmp_path, f'[data]\nfile = "{path.name}"\n[sensors.left_forearm]')
    check_raw(recording, "left_forearm")


@pytest.mark.parametrize("mode", ["rates", "quaternion", "euler"])
def test_dot_orientations(mode: str, tmp_path: Path) -> None:
    path = dot(tmp_path / "1.csv", mode)
    check_orientation(load(tmp_path, f'[data]\nfile = "{path.name}"\nuse = "orientation"\n[sensors.torso]'))


def test_dot_clocks_that_were_synchronised_are_one_even_where_they_begin_anew(tmp_path: Path) -> None:
    dot(tmp_path / "a.csv", first_us=2**32 - 2_000_000)
    dot(tmp_path / "b.csv", first_us=2**32 - 1_800_000)
    dot(tmp_path / "c.csv", first_us=100_000)  # 2.1 s after the first
    sensors = "".join(
        f'[sensors.{name}]\nfile = "{file}.csv"\n'
        for name, file in (("torso", "a"), ("left_forearm", "b"), ("right_forearm", "c"))
    )
    recording = load(tmp_path, f"[data]\n{sensors}")
    assert recording.time[0] == pytest.approx(2.1)
    np.testing.assert_allclose(recording.sensors["torso"].accel_S[0], ACCEL[210], atol=1e-6)
    np.testing.assert_allclose(recording.sensors["left_forearm"].accel_S[0], ACCEL[190], atol=1e-6)
    np.testing.assert_allclose(recording.sensors["right_forearm"].accel_S[0], ACCEL[0], atol=1e-6)


def test_dot_that_was_not_synchronised_is_said(tmp_path: Path) -> None:
    dot(tmp_path / "a.csv", sync="Un-synced")
    recording = load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]')
    assert recording.diagnostics == (Diagnostic("device-not-synchronized", WARNING, "a.csv"),)
    dot(tmp_path / "a.csv", sync="Synced")
    assert not load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]').diagnostics


def test_a_dot_without_its_preamble_must_be_named_if_rates_alone_are_in_it(tmp_path: Path) -> None:
    path = dot(tmp_path / "a.csv")
    table = path.read_bytes().partition(b"\n\n")[2]
    path.write_bytes(table)
    assert detect_format(path) == "dot"  # Quat_W is the DOT's word
    path.write_bytes(table.replace(b"Quat_", b"Other_"))
    assert detect_format(path) is None  # Gyr_X could be in deg/s or rad/s
    with pytest.raises(BadSession, match=r"sensors\.torso\.gyro is missing"):
        load(tmp_path, '[data]\nfile = "a.csv"\n[sensors.torso]')
    check_raw(load(tmp_path, '[data]\nfile = "a.csv"\nformat = "dot"\n[sensors.torso]'))


# x-io x-IMU3 -------------------------------------------------------------------------------------------------------


def ximu3(folder: Path, first_us: int = 52100347) -> Path:
    folder.mkdir()
    fine = [str(first_us + 10000 * k) for k in range(N)]
    names = "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
    names += "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n"
    (folder / "Inertial.csv").write_text(names + rows([fine, *np.degrees(GYRO).T, *(own(ACCEL, folder) / 9.80665).T]))
    (folder / "Quaternion.csv").write_text("Timestamp (us),W,X,Y,Z\n" + rows([fine, *WXYZ.T]))
    return folder


@pytest.mark.parametrize("first_us", [52100347, 1_700_000_000_000_000])
def test_ximu3_by_its_folder_or_a_file_of_it(first_us: int, tmp_path: Path) -> None:
    ximu3(tmp_path / "x-IMU3 12AB34CD (UDP)", first_us)
    for file in ("x-IMU3 12AB34CD (UDP)", "x-IMU3 12AB34CD (UDP)/Inertial.csv"):
        assert detect_format(tmp_path / file) == "ximu3"
        check_raw(load(tmp_path, f'[data]\nfile = "{file}"\n[sensors.torso]'))
    file = "x-IMU3 12AB34CD (UDP)"
    check_orientation(load(tmp_path, f'[data]\nfile = "{file}"\nuse = "orientation"\n[sensors.torso]'))
    check_orientation(load(tmp_path, f'[data]\nfile = "{file}/Quaternion.csv"\n[sensors.torso]'))


def test_ximu3_devices_that_were_switched_on_at_other_times_need_an_offset(tmp_path: Path) -> None:
    ximu3(tmp_path / "a")
    ximu3(tmp_path / "b", 90_000_000)
    text = '[data]\n[sensors.torso]\nfile = "a"\n[sensors.left_forearm]\nfile = "b"\n'
    with pytest.raises(BadData, match=r"clocks do not overlap .*check each sensor's time and offset_s"):
        load(tmp_path, text)
    recording = load(tmp_path, f"{text}offset_s = -37.899653\n")
    assert len(recording) >= N - 1


def test_ximu3_folder_without_what_is_asked_for(tmp_path: Path) -> None:
    (ximu3(tmp_path / "a") / "Quaternion.csv").unlink()
    with pytest.raises(BadData, match=r"no Quaternion\.csv in it"):
        load(tmp_path, '[data]\nfile = "a"\nuse = "orientation"\n[sensors.torso]')


# OpenSim -----------------------------------------------------------------------------------------------------------


def sto(path: Path, kind: str = "Quaternion", labels: tuple[str, ...] = ("torso_imu", "humerus_r_imu")) -> Path:
    cells = [",".join(f"{value:.9f}" for value in quat) for quat in WXYZ]
    head = f"DataRate=100.000000\nDataType={kind}\nversion=3\nOpenSimVersion=4.4\nendheader\n"
    names = "\t".join(["time", *labels]) + "\n"
    path.write_text(
        head + names + "".join(f"{t:.6f}" + f"\t{c}" * len(labels) + "\n" for t, c in zip(TIME, cells, strict=True))
    )
    return path


def test_opensim_orientations(tmp_path: Path) -> None:
    sto(tmp_path / "trial_orientations.sto")
    text = '[data]\nfile = "trial_orientations.sto"\n[sensors.torso]\n[sensors.right_upper_arm]\n'
    recording = load(tmp_path, text)
    check_orientation(recording)
    check_orientation(recording, "right_upper_arm")
    recording = load(tmp_path, '[data]\nfile = "trial_orientations.sto"\n[sensors.head]\nlabel = "humerus_r_imu"')
    check_orientation(recording, "head")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("DataType=Quaternion", "DataType=double"), "DataType=double; orientations are needed"),
        (("endheader", "end"), "no line 'endheader'"),
        (("0.010000\t", "0.010000\tmore\t"), "cannot be read as an OpenSim .sto; .* more fields"),
        (("time\ttorso_imu", "torso_imu\ttime"), "cannot be read as an OpenSim .sto"),
        (("1.000000000,0.", "one,0."), "in column 'torso_imu'; .*one"),
    ],
)
def test_opensim_files_that_are_wrong(change: tuple[str, str], says: str, tmp_path: Path) -> None:
    path = sto(tmp_path / "a.sto")
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(BadData, match=says):
        read_device(path, "opensim")


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
READY = """
[data]
file = "{file}"
rate_hz = 100.0
[sensors.torso]
orientation = ["/q[1]", "/q[2]", "/q[3]", "/q[0]"]
"""


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


@pytest.mark.parametrize("make", [hdf5, lambda path: hdf5(path, True), mat], ids=["hdf5", "turned", "mat"])
def test_arrays_by_their_path(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path / ("a.mat" if make is mat else "a.h5"))
    check_raw(load(tmp_path, ARRAYS.format(file=path.name)))
    check_raw(load(tmp_path, ARRAYS.format(file=path.name).replace("/imu/torso/gyro", "imu.torso.gyro")))
    check_orientation(load(tmp_path, READY.format(file=path.name)))


def test_a_mat_file_of_version_7_3_is_hdf5(tmp_path: Path) -> None:
    h5 = hdf5(tmp_path / "a.h5", True).read_bytes()
    with pytest.importorskip("h5py").File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        for name, values in {"/imu/torso/gyro": GYRO, "/imu/torso/accel": ACCEL, "/clock/time": TIME[None]}.items():
            file[name] = values.T if values.shape[0] == N else values
    (tmp_path / "a.h5").unlink()
    raw = bytearray((tmp_path / "b.mat").read_bytes())
    raw[:10] = b"MATLAB 7.3"
    (tmp_path / "b.mat").write_bytes(raw)
    assert h5[:8] == raw[512:520]
    check_raw(load(tmp_path, ARRAYS.format(file="b.mat")))


def test_without_h5py_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hdf5(tmp_path / "a.h5")
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(BadData, match=r"a\.h5: is HDF5 .* pip install h5py"):
        load(tmp_path, ARRAYS.format(file="a.h5"))


@pytest.mark.parametrize(
    ("change", "kind", "says"),
    [
        (("/imu/torso/gyro", "/imu/torso/gyr"), UnknownColumn, "no array '/imu/torso/gyr' in a.mat; did you mean"),
        (("/imu/torso/gyro", "/q"), BadData, r"/q in a\.mat has shape \(400, 4\); \(n, 3\) is needed"),
        (("/clock/time", "/q"), UnknownColumn, r"name one as /q\[0\]"),
        (('"/imu/torso/gyro"', '["/q[0]", "/q[1]", "/q[9]"]'), UnknownColumn, r"/q\[9\] is not one column"),
    ],
)
def test_arrays_that_are_not_there(change: tuple[str, str], kind: type, says: str, tmp_path: Path) -> None:
    mat(tmp_path / "a.mat")
    with pytest.raises(kind, match=says):
        load(tmp_path, ARRAYS.format(file="a.mat").replace(*change))


def test_arrays_of_unlike_length_are_named(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"imu": {"torso": {"gyro": GYRO[:-1], "accel": ACCEL}}, "clock": {"time": TIME}})
    with pytest.raises(BadData, match=r"differ in length: .*gyro\[0\] 399"):
        load(tmp_path, ARRAYS.format(file="a.mat"))


def test_an_array_named_in_a_csv_is_an_error(tmp_path: Path) -> None:
    pl.DataFrame({"clock": TIME}).write_csv(tmp_path / "a.csv")
    with pytest.raises(BadSession, match=r"sensors\.torso\.gyro = '/imu/torso/gyro'; a list of 3 different column"):
        load(tmp_path, ARRAYS.format(file="a.csv"))


# What every reader does --------------------------------------------------------------------------------------------

MAKERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "mt_manager": ("a.txt", mt_manager),
    "dot": ("a.csv", dot),
    "ximu3": ("x", ximu3),
    "opensim": ("a.sto", sto),
    "apdm": ("apdm.csv", apdm),
}


def made(format: str, folder: Path) -> Path:
    if format == "mvnx":
        return mvnx(folder, turning(100))
    name, make = MAKERS[format]
    path = make(folder / name)
    return path / "Inertial.csv" if path.is_dir() else path


@pytest.mark.parametrize("format", ["mt_manager", "dot", "ximu3", "apdm"])
def test_a_last_line_that_was_cut_off_is_left_out(format: str, tmp_path: Path) -> None:
    path = made(format, tmp_path)
    path.write_bytes(path.read_bytes()[:-60])
    recording = load(tmp_path, f'[data]\nfile = "{path.relative_to(tmp_path)}"\n[sensors.torso]')
    assert N - 2 <= len(recording) < N
    np.testing.assert_allclose(recording.sensors["torso"].accel_S, ACCEL[: len(recording)], atol=1e-6)


@pytest.mark.parametrize("format", ["mt_manager", "dot", "ximu3", "apdm"])
def test_gigantic_numbers_are_refused(format: str, tmp_path: Path) -> None:
    path = made(format, tmp_path)
    text = path.read_text(encoding="latin-1")
    lines = text.splitlines()
    cell = "\t" if format == "mt_manager" else ","
    cells = lines[-40].split(cell)
    cells[{"mt_manager": 2, "dot": 7, "ximu3": 4, "apdm": 16}[format]] = "1e300"
    lines[-40] = cell.join(cells)
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    with pytest.raises(BadData, match=r"in row 361; no device measures as much"):
        load(tmp_path, f'[data]\nfile = "{path.relative_to(tmp_path)}"\n[sensors.torso]')


@pytest.mark.parametrize("format", MAKERS)
def test_raw_data_that_are_not_there_cannot_be_used(format: str, tmp_path: Path) -> None:
    path = made(format, tmp_path)
    path.write_bytes(path.read_bytes().replace(b"Gyr", b"Gxx"))
    assert format != "apdm" or b"Gxx" in path.read_bytes()
    with pytest.raises(BadData, match=r"no sensor in it has .*; leave out data\.use"):
        read_device(path, format, "raw")


# A description of one's own ----------------------------------------------------------------------------------------


def own_format(folder: Path) -> str:
    """Write the description and the table of the page, with the known motion of two sensors, and return the former."""
    page = FORMATS_PAGE.read_text(encoding="utf-8")
    text = page.partition("## A device of your own")[2].partition("```toml\n")[2].partition("```")[0]
    head, names, *_ = page.partition("```text\n")[2].splitlines()
    names = ";".join([names, *(name.replace("chest", "left_wrist") for name in names.split(";")[1:])])
    sensor = [*np.degrees(GYRO).T, *(1e3 / 9.80665 * ACCEL).T]
    other = [*np.degrees(GYRO).T, *(1e3 / 9.80665 * own(ACCEL, Path("other"))).T]
    table = rows([5e3 + 1e3 * TIME, *sensor, *other], ";")
    (folder / "walk.csv").write_text(f"{head}\n{names}\n{table}")
    return text


@pytest.mark.parametrize("stated", ["", 'format = "lab.toml"\n'])
def test_a_description_beside_the_session_is_read(stated: str, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(own_format(tmp_path))
    recording = load(tmp_path, f'[data]\nfile = "walk.csv"\n{stated}[sensors.torso]\n[sensors.left_forearm]')
    check_raw(recording)
    check_raw(recording, "left_forearm")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[xyz]", "[xyz"), r"lab\.toml: '.*' is no regular expression"),
        (("(?P<axis>[xyz])", "[xyz]"), "no line of names with 't_ms' and columns of a signal|no sensor in it has"),
        (("unit_s", "unit"), r"clock 1\.unit is not a known key; did you mean 'unit_s'"),
        (("[[clock]]", "[[accel]]"), "is not a known key"),
        (('"mg"', '"furlong"'), r"'chest fx' is in 'furlong'; there is: m/s\^2, g, mg"),
        (('"t_ms"', '"t_s"'), r"walk\.csv: no line of names with 't_s' and columns of a signal"),
        (("title", "[title"), r"lab\.toml: not valid TOML"),
        (("[[accel]]", "[[gyro]]\ncolumns = []\n[[accel]]"), r"gyro 2\.columns = \[\]; one pattern or 3 names are"),
        (
            ("[[accel]]", '[[gyro]]\ncolumns = ["GX", "GY"]\n[[accel]]'),
            r"gyro 2\.columns = \['GX', 'GY'\]; one pattern",
        ),
        (("[[accel]]", "increments = true\n[[accel]]"), r"gyro 1\.columns = \['.*'\]; 4 names are needed"),
    ],
)
def test_a_description_that_is_wrong_is_one_line(change: tuple[str, str], says: str, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(own_format(tmp_path).replace(*change))
    with pytest.raises(WeposeError, match=says) as error:
        load(tmp_path, '[data]\nfile = "walk.csv"\nformat = "lab.toml"\n[sensors.torso]\nlabel = "chest"')
    assert "\n" not in str(error.value)


def test_units_beside_a_format_have_no_effect(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(own_format(tmp_path))
    with pytest.raises(WeposeError, match=r"data\.gyro_unit has no effect, as the format of the file defines it"):
        load(tmp_path, '[data]\nfile = "walk.csv"\nformat = "lab.toml"\ngyro_unit = "deg/s"\n[sensors.torso]')


def test_a_format_that_is_not_known_names_the_choices(tmp_path: Path) -> None:
    own_format(tmp_path)
    for name, says in (("dott", "did you mean 'dot'"), ("lab.toml", r"lab\.toml: no such file")):
        with pytest.raises(WeposeError, match=says):
            load(tmp_path, f'[data]\nfile = "walk.csv"\nformat = "{name}"\n[sensors.torso]')


def test_a_counter_that_begins_anew_goes_on() -> None:
    counter = np.array([65534.0, 65535.0, np.nan, 1.0, 2.0])
    np.testing.assert_array_equal(unwrap_counter(counter, 65536.0), [65534.0, 65535.0, np.nan, 65537.0, 65538.0])


@pytest.mark.parametrize(
    ("label", "segment"),
    [
        ("torso_imu", "torso"),
        ("humerus_r_imu", "right_upper_arm"),
        ("ulna_l_imu", "left_forearm"),
        ("LeftForeArm", "left_forearm"),
        ("T8", "torso"),
        ("Right upper arm", "right_upper_arm"),
        ("left_wrist", "left_forearm"),
        ("hand_r", "right_hand"),
        ("sternum", "torso"),
        ("pelvis_imu", "pelvis"),
        ("MT_012345_001-000_00B40001", None),
        ("forearm", None),
        ("tibia_r_imu", None),
        ("head", "head"),
        ("UA_L", "left_upper_arm"),
        ("FA right", "right_forearm"),
        ("fast_l", None),
    ],
)
def test_segments_by_their_names(label: str, segment: str | None) -> None:
    assert load_table().guess_segment(label) == segment


def test_columns_by_their_names() -> None:
    names = (
        "Time (s),chest_gyro_x [deg/s],chest_gyro_y [deg/s],chest_gyro_z [deg/s],chest_acc_x,chest_acc_y,chest_acc_z"
    )
    guess = guess_columns([*names.split(","), "chest_mag_x", "chest_mag_y", "chest_mag_z", "left_wrist_qw"])
    assert guess.times == ["Time (s)"]
    assert guess.units == {"Time (s)": "s", "gyro": "deg/s"}
    assert list(guess.sensors) == ["torso"]
    assert guess.sensors["torso"]["accel"] == ["chest_acc_x", "chest_acc_y", "chest_acc_z"]
    guess = guess_columns(["t", "gx", "gy", "gz", "ax", "ay", "az"])
    assert guess.sensors == {"?": {"gyro": ["gx", "gy", "gz"], "accel": ["ax", "ay", "az"]}}
    guess = guess_columns(["head_q0", "head_q1", "head_q2", "head_q3"])
    assert guess.sensors == {"head": {"orientation": ["head_q1", "head_q2", "head_q3", "head_q0"]}}
    assert guess_columns(["a", "b", "velocity_x"]).sensors == {}


def test_the_examples_of_the_page_are_sessions_that_lack_their_data_alone(tmp_path: Path) -> None:
    blocks = FORMATS_PAGE.read_text(encoding="utf-8").partition("## A device of your own")[0].split("```toml\n")[1:]
    assert len(blocks) == 7
    for block in blocks:
        with pytest.raises(MissingFile):
            load(tmp_path, block.partition("```")[0])
