"""`wepose info`: what a file is, and a session that can be read as it is printed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from test_formats import ACCEL, GYRO, RATE, TIME, WXYZ, dot, mat, mt_manager, sto, ximu3
from test_mvnx import mvnx, turning

import wepose_pin as wp
from wepose_pin.cli import main
from wepose_pin.recording import Recording


def info(capsys: pytest.CaptureFixture[str], *argv: object, code: int = 0) -> str:
    with pytest.raises(SystemExit) as stop:
        main(["info", *map(str, argv)])
    out, err = capsys.readouterr()
    assert stop.value.code == code, err
    assert code == 0 or (out == "" and err.count("\n") == 1)
    return out if code == 0 else err


def written(capsys: pytest.CaptureFixture[str], path: Path) -> Recording:
    """The recording by the session that info writes beside the file."""
    info(capsys, path, "--write")
    return wp.load_session(path.absolute().parent / "session.toml")


def table(names: str = "torso_gyr_{} torso_acc_{}", time: str = "time") -> pl.DataFrame:
    gyro, accel = names.split()
    columns = {time: TIME}
    for k, axis in enumerate("xyz"):
        columns |= {gyro.format(axis): GYRO[:, k], accel.format(axis): ACCEL[:, k]}
    return pl.DataFrame(columns)


def test_an_mvnx_with_all_its_segments(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = mvnx(tmp_path, turning(100))
    text = info(capsys, path)
    assert f"{path}: Xsens MVNX, orientations, no raw data" in text
    assert "100 samples at 50 Hz, 0 to 1.98 s" in text
    assert 'file = "trial.mvnx"' in text
    assert not (tmp_path / "session.toml").exists()
    recording = written(capsys, path)
    assert list(recording.sensors) == [
        "torso",
        "left_upper_arm",
        "left_forearm",
        "right_upper_arm",
        "pelvis",
        "left_hand",
    ]
    assert all(sensor.aligned for sensor in recording.sensors.values())


def test_the_session_that_is_printed_is_the_one_that_is_written(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = mvnx(tmp_path, turning(100))
    printed = info(capsys, path)
    info(capsys, path, "--write")
    session = (tmp_path / "session.toml").read_text(encoding="utf-8")
    assert printed.endswith(session)
    error = info(capsys, path, "--write", code=2)
    assert "session.toml: exists; --force replaces it" in error
    info(capsys, path, "--write", "--force")


def test_files_of_one_recording_make_one_session(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    dot(tmp_path / "D1.csv", tag="left_wrist")
    dot(tmp_path / "D2.csv", tag="chest", first_us=500_000)
    dot(tmp_path / "D3.csv", tag="D422CD00")
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    text = info(capsys, tmp_path / "D2.csv")
    assert "which segment is not said by the names of: D3.csv" in text
    assert '# [sensors.SEGMENT]\n# file = "D3.csv"' in text
    recording = written(capsys, tmp_path / "D2.csv")
    assert set(recording.sensors) == {"torso", "left_forearm"}
    assert recording.time[0] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (mt_manager, "chest.txt"),
        (lambda path: dot(path, tag="D422CD00"), "chest.csv"),
        (sto, "a.sto"),
        (mat, "a.mat"),
        (lambda path: dot(path, tag="D422CD00"), "D422CD00.csv"),
    ],
)
def test_each_format_by_what_it_says_of_its_segment(
    make: Callable[[Path], Path], name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    recording = written(capsys, make(tmp_path / name))
    assert "torso" in recording.sensors
    assert len(recording) == len(TIME)


def test_an_ximu3_folder_and_what_to_check(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    ximu3(tmp_path / "x-IMU3 12AB34CD (UDP)")
    text = info(capsys, tmp_path / "x-IMU3 12AB34CD (UDP)")
    assert 'file = "x-IMU3 12AB34CD (UDP)"   # CHECK: which segment?' in text
    recording = written(capsys, tmp_path / "x-IMU3 12AB34CD (UDP)")
    np.testing.assert_allclose(recording.sensors["torso"].gyro_S, GYRO, atol=1e-6)


def test_a_session_elsewhere_names_the_data_from_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    path = mvnx(tmp_path / "data", turning(100))
    info(capsys, path, "-o", tmp_path / "mine.toml")
    assert 'file = "data/trial.mvnx"' in (tmp_path / "mine.toml").read_text(encoding="utf-8")
    assert len(wp.load_session(tmp_path / "mine.toml")) == 100
    assert "not a file that can be written" in info(capsys, path, "-o", tmp_path / "no" / "mine.toml", code=2)


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


def test_rest_is_found_and_proposed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    gyro, accel = np.full((600, 3), 0.002), np.tile([0.0, 0.0, 9.81], (600, 1))
    gyro[250:, 2] += np.sin(0.2 * np.arange(350))  # about the vertical, as accel says
    values = np.column_stack([np.arange(600) / 100.0, gyro, accel])
    names = ["time", *table().columns[1::2], *table().columns[2::2]]
    pl.DataFrame(values, schema=names).write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert "all sensors at rest [s]: 0.0 to 2.5" in text
    assert "start = [[0.00, 2.49]]   # CHECK" in text
    assert 'mount = { up = "+z", forward = "+x" }' in text


def test_time_in_another_unit_becomes_a_rate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    frame = table(time="timestamp").with_columns(timestamp=(1e6 * pl.col("timestamp")).round().cast(pl.Int64))
    frame.write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert "rate_hz = 100" in text
    assert "'timestamp' is in microseconds" in text
    assert written(capsys, tmp_path / "a.csv").rate_hz == pytest.approx(RATE)


def test_gaps_are_counted(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    frame = table()
    pl.concat([frame[:100], frame[130:]]).write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert "1, up to 0.30 s" in text


def test_what_cannot_be_read_is_said_and_a_session_still_proposed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    frame = table().with_columns(pl.col("torso_acc_x", "torso_acc_y", "torso_acc_z") * 0.0)
    frame.write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert "cannot be read so: sensors.torso.accel: norm 0 m/s^2" in text
    assert "[sensors.torso]" in text


def test_a_table_that_holds_no_sensor(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pl.DataFrame({"time": TIME, "temperature": TIME}).write_csv(tmp_path / "a.csv")
    assert "no gyroscope and accelerometer" in info(capsys, tmp_path / "a.csv")
    assert "there is no session to write" in info(capsys, tmp_path / "a.csv", "--write", code=2)


def test_sessions_subjects_and_results(capsys: pytest.CaptureFixture[str], simulation, person, tmp_path: Path) -> None:
    from wepose_pin.subject import subject_toml
    from wepose_pin.writers import write_result, write_session

    recording = simulation.recording("made")
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", recording, simulation.truth())
    text = info(capsys, tmp_path / "session")
    assert "a session, 'made'" in text
    assert "phase start [s]" in text
    (tmp_path / "subject.toml").write_text(subject_toml(person.average), encoding="utf-8")
    text = info(capsys, tmp_path / "subject.toml")
    assert "a subject, '" in text
    assert "left_upper_arm" in text
    (tmp_path / "result").mkdir()
    write_result(tmp_path / "result", wp.track(recording, person.average), phases=recording.phases)
    text = info(capsys, tmp_path / "result")
    assert "a result of `wepose track`" in text
    assert json.loads((tmp_path / "result" / "summary.json").read_text())["recording"] in text
    assert "a pose, as `wepose track` writes it" in info(capsys, tmp_path / "result" / "pose.parquet")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.toml", b"x = 1\n", "neither a session ([data], [sensors.…]) nor a subject"),
        ("a.toml", b"\xff\xfe", "is not UTF-8 text"),
        ("a.csv", b"", "is empty"),
        ("a.csv", b"a,b\rc,d\n1,2,3\n", "its line of names cannot be read"),
        ("a.csv", b"\x00\x01\x02" * 90, "zero bytes"),
        ("a.parquet", b"PAR1", "cannot be read as a Parquet file"),
        ("a.mat", b"\x00" * 300, "is neither HDF5 nor a MATLAB file"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + b"\x00" * 90, "is damaged, cut off, or no MATLAB or HDF5 file"),
        ("a.mvnx", b"<mvnx", "is damaged or cut off"),
        ("a.sto", b"time\t1\n", "no line 'endheader'"),
        ("a.txt", b"hello\n", "is nothing that is known here"),
        ("a.png", b"\x89PNG", "is nothing that is known here"),
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


def test_quaternions_of_a_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    names = ["t", *(f"left_hand_q{c}" for c in "wxyz")]
    pl.DataFrame(np.column_stack([TIME, WXYZ]), schema=names).write_csv(tmp_path / "a.csv")
    recording = written(capsys, tmp_path / "a.csv")
    np.testing.assert_allclose(recording.sensors["left_hand"].quat_WS[:, 3], WXYZ[:, 0], atol=1e-6)


def test_sensors_without_a_segment_are_left_to_the_user(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    frames = [table(f"seg{k}_gyr_{{}} seg{k}_acc_{{}}").drop("time") for k in (1, 2, 3)]
    pl.concat([table().select("time"), *frames], how="horizontal").write_csv(tmp_path / "a.csv")
    text = info(capsys, tmp_path / "a.csv")
    assert "which segment is not said by the names of: seg2, seg3" in text
    assert text.count("# [sensors.SEGMENT]") == 2
    assert list(written(capsys, tmp_path / "a.csv").sensors) == ["torso"]
