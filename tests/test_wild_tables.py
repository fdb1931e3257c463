"""CSV files as loggers and spreadsheets write them: `wepose info --write` finds their columns, units and clock."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from device_files import ACCEL, GYRO, TIME, N
from test_info import info

import wepose_pin as wp
from wepose_pin import BadData, Recording

G = 9.80665
EPOCH = 1_700_000_000


def values(sensor: int, gyro: float = 1.0, accel: float = 1.0) -> np.ndarray:
    """Accel and gyro (n, 6) of a sensor in other units than SI by these factors; each has noise of its own."""
    noise = np.random.default_rng(sensor).normal(scale=1e-3, size=(N, 6))
    return np.column_stack([accel * ACCEL, gyro * GYRO]) + noise


def lines(time: list[str], columns: np.ndarray, separator: str, decimal: str = ".") -> str:
    rows = zip(time, columns, strict=True)
    return "".join(separator.join([t, *(f"{v:.6f}".replace(".", decimal) for v in row)]) + "\n" for t, row in rows)


def german(path: Path) -> None:
    """A byte-order mark, semicolons, decimal commas; milliseconds; g and °/s; lines of remarks before the names."""
    where = ("Brust", "Unterarm links")
    names = [f"{s} {k} {a} {u}" for s in where for k, u in KINDS_DE for a in "XYZ"]
    table = np.column_stack([values(k, 180.0 / np.pi, 1.0 / G) for k in range(2)])
    text = "Messung vom;12.03.2026\nProband;7\n\n" + ";".join(["Zeit (ms)", *names]) + "\n"
    path.write_bytes(("\ufeff" + text + lines([str(10 * k) for k in range(N)], table, ";", ",")).encode())


KINDS_DE = (("Beschleunigung", "(g)"), ("Winkelgeschwindigkeit", "(°/s)"))


def windows(path: Path) -> None:
    """As `german`, in the encoding of Windows and with its line ends."""
    german(path)
    path.write_bytes(path.read_text("utf-8-sig").replace("\n", "\r\n").encode("cp1252"))


def epoch_ms(path: Path) -> None:
    """Whole milliseconds since 1970; the sensor between the signal and the axis, and after the axis."""
    names = [f"acc_chest_{a}" for a in "xyz"] + [f"gyr_chest_{a}" for a in "xyz"]
    names += [f"a{a}_left_wrist" for a in "xyz"] + [f"g{a}_left_wrist" for a in "xyz"]
    table = np.column_stack([values(k) for k in range(2)])
    time = [str(1000 * EPOCH + 10 * k) for k in range(N)]
    path.write_text(",".join(["unix", *names]).replace("unix", "unix_timestamp") + "\n" + lines(time, table, ","))


def epoch_ns(path: Path) -> None:
    """Nanoseconds since 1970, tabs; units in a line of their own, the columns in another order."""
    names = [f"{a}.gyr.{s}" for s in ("Sternum", "L_ForeArm") for a in "zyx"]
    names += [f"{a}.acc.{s}" for s in ("Sternum", "L_ForeArm") for a in "zyx"]
    table = [values(k, 180.0 / np.pi, 1000.0 / G) for k in range(2)]
    columns = np.column_stack([t[:, [5, 4, 3]] for t in table] + [t[:, [2, 1, 0]] for t in table])
    units = ["ns", *["deg/s"] * 6, *["mG"] * 6]
    time = [str(10**9 * EPOCH + 10**7 * k) for k in range(N)]
    path.write_text("\t".join(["timestamp", *names]) + "\n" + "\t".join(units) + "\n" + lines(time, columns, "\t"))


@pytest.mark.parametrize(
    ("write", "start", "fact"),
    [
        (german, 0.0, "'Zeit (ms)' is in ms, as its name says: 100 Hz"),
        (windows, 0.0, "'Zeit (ms)' is in ms, as its name says: 100 Hz"),
        (epoch_ms, EPOCH, "'unix_timestamp' is in ms, as it grows by 10 from row to row: 100 Hz"),
        (epoch_ns, EPOCH, "'timestamp' is in ns, as its name says: 100 Hz"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_the_session_that_is_proposed_needs_no_editing(
    write: Callable[[Path], None], start: float, fact: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    write(tmp_path / "a.csv")
    assert fact in info(capsys, tmp_path / "a.csv", "--write")
    recording = wp.load_session(tmp_path / "session.toml")
    assert set(recording.sensors) == {"torso", "left_forearm"}
    np.testing.assert_allclose(recording.time - recording.time[0], TIME, atol=2e-6)
    assert recording.time[0] == pytest.approx(start, abs=1e-6)
    for k, segment in enumerate(("torso", "left_forearm")):
        sensor = recording.sensors[segment]
        np.testing.assert_allclose(sensor.gyro_S, GYRO, atol=0.006)
        np.testing.assert_allclose(sensor.accel_S, ACCEL, atol=0.05)
        assert not np.array_equal(sensor.gyro_S, recording.sensors["torso"].gyro_S) or k == 0


@pytest.mark.parametrize("name", ["a.txt", "a.tsv"])
def test_a_table_of_a_spreadsheet_may_be_a_text(name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    names = ["t", *(f"chest {k} {a}" for k in ("acc", "gyr") for a in "xyz")]
    time = [f"{0.01 * k:.2f}".replace(".", ",") for k in range(N)]
    (tmp_path / name).write_text("\t".join(names) + "\n" + lines(time, values(0), "\t", ","))
    assert f"{name}: CSV table, 7 columns" in info(capsys, tmp_path / name, "--write")
    recording = wp.load_session(tmp_path / "session.toml")
    np.testing.assert_allclose(recording.sensors["torso"].gyro_S, GYRO, atol=0.006)


def test_dates_are_read_and_what_holds_no_times_or_several_sensors_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    names = ",".join(["timestamp", *(f"torso_{k}_{a}" for k in ("acc", "gyr") for a in "xyz")])
    time, path = [f"08:00:{0.02 * k:09.6f}" for k in range(N)], tmp_path / "a.csv"
    path.write_text(names + "\n" + lines([f"2026-03-12 {each}" for each in time], values(0), ","))
    assert f"{N} samples at 50 Hz, 1773302400 to" in info(capsys, path)
    path.write_text(names + "\n" + lines(time, values(0), ","))
    assert "100 Hz is a guess, as 'timestamp' holds no times" in info(capsys, path)
    path.write_text(lines(time, values(0), ",").split("08:00:")[-1])
    assert "the first line holds numbers; write the names" in info(capsys, path, code=2)
    rows = [f"{k // 2},{'ab'[k % 2]}" for k in range(N)]
    path.write_text(names.replace("stamp", "_ms,who") + "\n" + lines(rows, values(0), ","))
    assert "rows of several sensors, told apart by 'who'" in info(capsys, path, code=2)


def test_a_jump_of_microseconds_is_a_gap_of_its_length(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Half a second is lost; and the counter never runs backwards."""
    names = ",".join(["t_us", *(f"torso_{k}_{a}" for k in ("acc", "gyr") for a in "xyz")])
    time = [str(1_700_000_000_000_000 + 10_000 * k + 500_000 * (k >= 200)) for k in range(N)]
    (tmp_path / "a.csv").write_text(names + "\n" + lines(time, values(0), ","))
    assert "1, up to 0.50 s" in info(capsys, tmp_path / "a.csv", "--write")
    recording: Recording = wp.load_session(tmp_path / "session.toml", gaps=True)
    assert len(recording) == N + 50
    assert recording.sensors["torso"].gap is not None
    assert np.flatnonzero(recording.sensors["torso"].gap).tolist() == list(range(200, 250))
    back = time[:200] + [str(int(t) - 3_000_000) for t in time[200:]]
    (tmp_path / "a.csv").write_text(names + "\n" + lines(back, values(0), ","))
    assert "mend what cannot be read" in info(capsys, tmp_path / "a.csv", "--write", "--force")
    with pytest.raises(BadData, match=r"time .* in row 201"):
        wp.load_session(tmp_path / "session.toml", gaps=True)


def test_a_folder_with_a_file_for_each_sensor(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Not a table of something else; a name that tells no segment leaves it to the user."""
    names = ",".join(["t_ms", *(f"{k}_{a}" for k in ("acc", "gyr") for a in "xyz")])
    time = [str(10 * k) for k in range(N)]
    for k, name in enumerate(("chest", "left_wrist", "right_wrist_2", "imu7")):
        (tmp_path / f"{name}.csv").write_text(names + "\n" + lines(time, values(k), ","))
    for name in ("a_list", "right_upper_arm"):
        (tmp_path / f"{name}.csv").write_text("t_ms,emg\n0,1\n")
    session = tmp_path.parent / f"{tmp_path.name}.toml"
    out = info(capsys, tmp_path, "-o", session)
    assert "CSV table, 7 columns, 4 files" in out
    assert "also in the folder, not used: a_list.csv, right_upper_arm.csv\n" in out
    assert f'# [sensors.SEGMENT]\n# file = "{tmp_path.name}/imu7.csv"' in session.read_text(encoding="utf-8")
    recording = wp.load_session(session)
    assert recording.name == tmp_path.name
    assert set(recording.sensors) == {"torso", "left_forearm", "right_forearm"}
    np.testing.assert_allclose(recording.sensors["left_forearm"].gyro_S, values(1)[:, 3:], atol=1e-5)


def test_a_rate_that_the_file_states(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = info(capsys, data / "ring" / "trial1" / "imu_rigid.csv")
    assert "rate_hz = 40.0\n" in out
    assert "the file says 'sampling frequency: 40'" in out


@pytest.mark.parametrize(
    ("names", "sensors", "columns"),
    [
        (  # numbers are those of sensors while letters are axes
            [f"imu{s}_{k}_{a}" for s in range(3) for k in ("acc", "gyro") for a in "xyz"],
            "imu0 imu1 imu2",
            '"imu0_gyro_x", "imu0_gyro_y", "imu0_gyro_z"',
        ),
        ([f"{k}[{a}]" for k in ("ACC", "GYR") for a in range(3)], "SEGMENT", '"GYR[0]", "GYR[1]", "GYR[2]"'),
        ([f"chest_{k}_{a}" for k in ("acc", "gyro", "mag") for a in "xyz"], "[sensors.torso]", '"chest_acc_x", '),
        (["ax", "ay", "az", "gx", "gy", "gz"], "SEGMENT", '"ax", "ay", "az"'),
        (["head_q0", "head_q1", "head_q2", "head_q3"], "[sensors.head]", '"head_q1", "head_q2", "head_q3", "head_q0"'),
        ([*(f"Linear Acceleration {a}" for a in "xyz"), "gx", "gy", "gz"], "", ""),
    ],
)
def test_columns_by_their_names(
    names: list[str], sensors: str, columns: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    table = np.column_stack([values(k) for k in range(3)])[:, : len(names)]
    (tmp_path / "a.csv").write_text(",".join(["t", *names]) + "\n" + lines([str(t) for t in TIME], table, ","))
    text = info(capsys, tmp_path / "a.csv")
    assert all(each in text for each in sensors.split())
    assert columns in text
    assert ("no gyroscope and accelerometer" in text) == (not sensors)
