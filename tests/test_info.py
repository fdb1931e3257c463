"""`wepose info`: what a file is, and a session that can be read as it is printed."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from device_files import ACCEL, GYRO, RATE, TIME, dot, mt_manager, mvnx, turning, ximu3

import wepose_pin as wp
from wepose_pin.writers import write_session


def info(capsys: pytest.CaptureFixture[str], *argv: object, code: int = 0) -> str:
    exit_code = run("info", *argv)
    out, err = capsys.readouterr()
    assert exit_code == code, err
    assert code == 0 or (out == "" and err.count("\n") == 1)
    return out if code == 0 else err


def written(capsys: pytest.CaptureFixture[str], path: Path) -> wp.Recording:
    """The recording by the session that info writes beside the file."""
    info(capsys, path, "--write")
    return wp.load_session(path.absolute().parent / "session.toml")


def table(names: str = "torso_gyr_{} torso_acc_{}", time: str = "time", sensor: int = 0) -> pl.DataFrame:
    """One sensor's samples; another `sensor` has noise of its own."""
    gyro, accel = names.split()
    columns = {time: TIME}
    noise = np.random.default_rng(sensor).normal(scale=1e-3, size=(2, *GYRO.shape)) if sensor else np.zeros(2)
    for k, axis in enumerate("xyz"):
        columns |= {gyro.format(axis): (GYRO + noise[0])[:, k], accel.format(axis): (ACCEL + noise[1])[:, k]}
    return pl.DataFrame(columns)


def test_an_mvnx_with_all_its_segments(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = mvnx(tmp_path, turning(100))
    text = info(capsys, path)
    assert f"{path}: Xsens MVNX, orientations, no raw data" in text
    assert "100 samples at 50 Hz, 0 to 1.98 s" in text
    assert 'file = "trial.mvnx"' in text
    assert not (tmp_path / "session.toml").exists()
    recording = written(capsys, path)
    assert text.endswith((tmp_path / "session.toml").read_text(encoding="utf-8"))  # it is written as it is printed
    segments = "torso left_upper_arm left_forearm right_upper_arm pelvis left_hand"
    assert list(recording.sensors) == segments.split()
    assert all(sensor.aligned for sensor in recording.sensors.values())
    assert "session.toml: exists; --force replaces it" in info(capsys, path, "--write", code=2)
    text = info(capsys, path, "--write", "--force")  # aligned orientations can be tracked at once
    assert f"wepose track {tmp_path / 'session.toml'} -o result" in text
    assert "calibrate" not in text
    monkeypatch.chdir(tmp_path)
    assert "Session: session.toml  (" in info(capsys, path.name, "--write", "--force")


def test_files_of_one_recording_make_one_session(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    dot(tmp_path / "D1.csv", tag="left_wrist")
    dot(tmp_path / "D2.csv", tag="chest", first_us=500_000)
    dot(tmp_path / "D3.csv", tag="D422CD00")
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    text = info(capsys, tmp_path / "D2.csv")
    assert '# [sensors.SEGMENT]\n# file = "D3.csv"' in text
    recording = written(capsys, tmp_path / "D2.csv")
    assert set(recording.sensors) == {"torso", "left_forearm"}
    assert recording.time[0] == pytest.approx(0.5)


def test_a_rate_is_proposed_for_files_without_one(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name in ("chest", "left_wrist"):
        mt_manager(tmp_path / f"{name}.txt", preamble="// MT Manager version: 2022.2.0\n")
    info(capsys, tmp_path / "chest.txt", "--write")
    recording = wp.load_session(tmp_path)
    session = (tmp_path / "session.toml").read_text(encoding="utf-8")
    assert session.count("rate_hz = 100.0   # CHECK: the file does not say its rate") == 1
    assert recording.rate_hz == pytest.approx(100.0, rel=0.01)


def test_an_ximu3_folder_and_what_to_check(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ximu3(tmp_path / "x-IMU3 12AB34CD (UDP)")
    text = info(capsys, tmp_path / "x-IMU3 12AB34CD (UDP)")
    assert "400 samples at 100 Hz" in text  # it was read, though nobody knows where it was worn
    assert '# [sensors.SEGMENT]\n# file = "x-IMU3 12AB34CD (UDP)"' in text
    assert "torso" not in text
    info(capsys, tmp_path / "x-IMU3 12AB34CD (UDP)", "--write")
    session = tmp_path / "session.toml"
    session.write_text(session.read_text().replace("# [sensors.SEGMENT]\n# file", "[sensors.left_forearm]\nfile"))
    np.testing.assert_allclose(wp.load_session(session).sensors["left_forearm"].gyro_S, GYRO, atol=1e-6)
    ximu3(tmp_path / "torso")
    monkeypatch.chdir(tmp_path / "torso")
    assert "2 files" in info(capsys, Path())


def test_a_session_elsewhere_names_the_data_from_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    path = mvnx(tmp_path / "data", turning(100))
    info(capsys, path, "-o", tmp_path / "mine.toml")
    assert 'file = "data/trial.mvnx"' in (tmp_path / "mine.toml").read_text(encoding="utf-8")
    assert len(wp.load_session(tmp_path / "mine.toml")) == 100
    for wrong in (tmp_path / "no" / "mine.toml", tmp_path / "data"):  # no such folder; a folder
        assert f"{wrong}: not a file that can be written" in info(capsys, path, "-o", wrong, code=2)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_units_of_a_table_are_told_by_its_values(
    suffix: str, capsys: pytest.CaptureFixture[str], simulation, tmp_path: Path
) -> None:
    """Nothing in the names says deg/s or g."""
    sensor = simulation.recording("made").sensors["left_forearm"]
    n = 4000
    values = np.column_stack([np.arange(n) / 100.0, np.degrees(sensor.gyro_S[:n]), sensor.accel_S[:n] / 9.80665])
    names = ["time", *(f"{kind}_{axis}" for kind in ("lower_arm_left_gyr", "lower_arm_left_acc") for axis in "xyz")]
    frame = pl.DataFrame(values, schema=names)
    path = tmp_path / f"a{suffix}"
    frame.write_csv(path) if suffix == ".csv" else frame.write_parquet(path)
    text = info(capsys, path)
    assert 'gyro_unit = "deg/s"' in text
    assert 'accel_unit = "g"' in text
    recording = written(capsys, path)
    np.testing.assert_allclose(recording.sensors["left_forearm"].gyro_S, sensor.gyro_S[:n], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "unit", "a_second", "first"),
    [
        ("timestamp", "us", 10**6, 0),
        ("time_ms", "ms", 10**3, 0),
        ("Timestamp [µs]", "us", 10**6, 1_700_000_000 * 10**6),
        ("unix_timestamp_microsec", "us", 10**6, 1_700_000_000 * 10**6),
        ("t_ns", "ns", 10**9, 5),
        ("SensorTime", "ms", 10**3, 77),
    ],
)
def test_times_in_another_unit_are_named_with_it(
    name: str, unit: str, a_second: int, first: int, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Lost rows are seen by the times, which a rate in their place would hide."""
    frame = table(time=name).with_columns(pl.Series(name, [first + k * a_second // 100 for k in range(len(TIME))]))
    pl.concat([frame[:100], frame[103:]]).write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert f"'{name}' is in {unit}" in text
    assert f'time_unit = "{unit}"' in text
    assert "rate_hz" not in text
    recording = written(capsys, tmp_path / "a.csv")
    assert recording.rate_hz == pytest.approx(RATE, rel=1e-4)
    assert len(recording) == len(TIME)
    assert recording.time[0] == pytest.approx(first / a_second)


def test_the_start_phase_is_one_in_which_no_sensor_moves(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Not even one whose segment nobody knows."""
    rng = np.random.default_rng(0)
    gyro, other = rng.normal(scale=2e-3, size=(2, 600, 3))
    accel, other_accel = [0.0, 0.0, 9.81] + rng.normal(scale=0.01, size=(2, 600, 3))
    other[:250] += np.sin(0.2 * np.arange(250))[:, None]
    values = np.column_stack([np.arange(600) / 100.0, gyro, accel, other, other_accel])
    names = [f"{who}_{kind}_{axis}" for who in ("torso", "imu7") for kind in ("gyr", "acc") for axis in "xyz"]
    pl.DataFrame(values, schema=["time", *names]).write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert "all sensors static [s]: 2.5 to 6.0" in text
    assert "start = [[2.50, 5.99]]   # CHECK" in text
    assert 'mount = { up = "+z", forward = "?" }' in text


@pytest.mark.parametrize(("begin", "seconds"), [(0.0, 8.0), (40.0, 100.0), (1.7e9, 66.0)])
def test_a_session_is_readable_once_the_marks_of_its_comments_are_gone(
    begin: float, seconds: float, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Never static, sensors of names that say nothing."""
    time = begin + np.arange(0.0, seconds, 0.02)
    columns = {"time": time}
    for n, sensor in enumerate(("s1", "s2"), 1):
        waves = np.sin(np.outer(time - begin, n + np.arange(1.0, 4.0)))
        for k, axis in enumerate("xyz"):
            columns |= {f"{sensor}_gyr_{axis}": waves[:, k], f"{sensor}_acc_{axis}": 9.81 * (k == 2) + waves[:, k]}
    pl.DataFrame(columns).write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv", "--write")
    assert ("CHECK" in text) == ("CHECK" in (tmp_path / "session.toml").read_text(encoding="utf-8"))
    assert "remove the #" in text
    with pytest.raises(wp.WeposeError, match="without # before its lines"):
        wp.load_session(tmp_path)
    session = (tmp_path / "session.toml").read_text(encoding="utf-8").replace("# # ", "# ")
    assert session.count('[["FROM", "TO"]]') == 3
    session = session.replace('[["FROM", "TO"]]', f"[[{begin + 0.5}, {begin + 4.5}]]")
    session = re.sub(r"^# (?!mount)", "", session, flags=re.MULTILINE)
    for segment in ("torso", "left_upper_arm"):
        session = session.replace("sensors.SEGMENT", f"sensors.{segment}", 1)
    (tmp_path / "session.toml").write_text(session, encoding="utf-8")
    recording = wp.load_session(tmp_path)
    assert set(recording.phases) == {"start", "clasp", "t_pose"}
    assert set(recording.sensors) == {"torso", "left_upper_arm"}


def test_what_cannot_be_read_is_said_and_a_session_still_proposed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    frame = table().with_columns(pl.col("torso_acc_x", "torso_acc_y", "torso_acc_z") * 0.0)
    frame.write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert re.search(r"it cannot be read: .*sensors\.torso", text)
    assert "[sensors.torso]" in text


def test_a_table_that_holds_no_sensor(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pl.DataFrame({"time": TIME, "temperature": TIME}).write_csv(tmp_path / "a.csv")
    assert "no gyroscope and accelerometer" in info(capsys, tmp_path / "a.csv")
    assert "there is no session to write" in info(capsys, tmp_path / "a.csv", "--write", code=2)


def test_sessions_subjects_and_results(capsys: pytest.CaptureFixture[str], simulation, person, tmp_path: Path) -> None:
    recording = simulation.recording("made")
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", recording, simulation.truth())
    text = info(capsys, tmp_path / "session")
    assert "a session, 'made'" in text
    assert "phase start [s]" in text
    replace(person.prior, quality="poor").save(tmp_path / "subject.toml")
    text = info(capsys, tmp_path / "subject.toml")
    assert "a subject, '" in text
    assert "quality of the calibration: poor" in text
    assert "left_upper_arm" in text
    wp.track(recording, person.prior).save(tmp_path / "result")
    text = info(capsys, tmp_path / "result")
    assert "a result of `wepose track`" in text
    assert "a pose, as `wepose track` writes it" in info(capsys, tmp_path / "result" / "pose.parquet")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.toml", b"x = 1\n", "neither a session ([data], [sensors.…]) nor a subject"),
        ("a.toml", b"\xff\xfe", "not valid TOML"),
        ("a.csv", b"", "is empty"),
        ("a.csv", b"a,b\rc,d\n1,2,3\n", "cannot be read as a CSV"),
        ("a.csv", b"\x00\x01\x02" * 90, "zero bytes"),
        ("a.parquet", b"PAR1", "cannot be read as a Parquet file"),
        ("a.mat", b"\x00" * 300, "cannot be read as an HDF5 or MATLAB file"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + b"\x00" * 90, "cannot be read as an HDF5 or MATLAB file"),
        ("a.mvnx", b"<mvnx", "cannot be read as an MVNX"),
        ("a.sto", b"time\t1\n", "no line 'endheader'"),
        ("a.txt", b"hello\n", "is nothing that is known here"),
    ],
)
def test_files_that_are_wrong_are_one_line(
    name: str, content: bytes, says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    if name == "a.h5":
        pytest.importorskip("h5py")
    (tmp_path / name).write_bytes(content)
    error = info(capsys, tmp_path / name, code=2)
    assert says in error
    assert name in error


def test_nothing_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "none.mvnx: no such file" in info(capsys, tmp_path / "none.mvnx", code=2)
    assert "a folder without session.toml" in info(capsys, tmp_path, code=2)


# What is guessed ---------------------------------------------------------------------------------------------------


def write_swing(
    path: Path, scale: float, names: str = "torso_gyr_{}", deg: float = 60.0, seconds: float = 20.0
) -> Path:
    """A sensor that swings slowly about x by `deg`, rates [rad/s] times `scale`; without a unit in the names."""
    n = round(100 * seconds)
    time = np.arange(n) / 100.0
    angle = np.radians(deg) * np.sin(0.5 * time)
    accel = 9.81 * np.column_stack([0.0 * time, np.sin(angle), np.cos(angle)])
    noise = np.random.default_rng(0).normal(0.0, 0.01, (n, 6))
    gyro = np.column_stack([np.gradient(angle, time), 0.0 * time, 0.0 * time]) + 0.1 * noise[:, :3]
    columns = {"time": time} | {names.format(axis): scale * gyro[:, k] for k, axis in enumerate("xyz")}
    columns |= {names.replace("gyr", "acc").format(axis): (accel + noise[:, 3:])[:, k] for k, axis in enumerate("xyz")}
    pl.DataFrame(columns).write_csv(path)
    return path


def test_a_unit_that_nothing_shows_is_to_be_checked(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert 'gyro_unit = "rad/s"   # CHECK: ' in info(capsys, write_swing(tmp_path / "a.csv", 1.0, deg=0.0))
    stated = write_swing(tmp_path / "b.csv", 1.0, "torso_gyr_{} [rad/s]", deg=0.0)
    assert 'gyro_unit = "rad/s"\n' in info(capsys, stated)
