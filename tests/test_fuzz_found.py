"""What fuzzing and faults found, each as it is told now; nothing of it may come back."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from test_bad_input import Files, good_table, refused

from wepose_pin.cli import main
from wepose_pin.documents import whole_folder, written
from wepose_pin.errors import (
    BadData,
    BadModel,
    BadOption,
    BadPlan,
    BadSession,
    BadSubject,
    MissingFile,
    WeposeError,
    printable,
)
from wepose_pin.readers.arrays import ArrayFile
from wepose_pin.recording.faults import check_sensors
from wepose_pin.report.viewer import frame_indices

pytest.importorskip("hypothesis")
from fuzz import seeds
from fuzz.targets import TARGETS, try_one

BY_NAME = {target.name: target for target in TARGETS}


def told(name: str, folder: Path, data: bytes, kind: type[WeposeError]) -> str:
    """What a target refuses the input for."""
    error = try_one(BY_NAME[name], folder, data)
    assert isinstance(error, kind), repr(error)
    return str(error)


# One line, whatever a file holds -----------------------------------------------------------------------------------


def test_an_error_is_one_printable_line_of_bounded_length() -> None:
    assert str(BadData("a\nb\x1b[31m \udcff é")) == "a\\nb\\x1b[31m \\udcff é"
    long = str(BadData("x" * 10**6 + "; the end"))
    assert len(long) < 2100
    assert long.endswith("; the end")
    assert printable("± über 10 µm") == "± über 10 µm"


def test_names_in_a_file_do_not_steer_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = Files(tmp_path / "in", good_table(), 'name = "\\u001b[31mred"\n' + Files(tmp_path, good_table()).session)
    files.folder.mkdir()
    session = files.write()
    for command in (["info", str(session)], ["track", str(session), "-o", str(tmp_path / "out")]):
        with pytest.raises(SystemExit) as stop:
            main(command)
        captured = capsys.readouterr()
        assert stop.value.code == 0
        assert "\x1b[31m" not in captured.out + captured.err
        assert "\\x1b[31mred" in captured.out


# TOML --------------------------------------------------------------------------------------------------------------

TOMLS = {"session": BadSession, "subject": BadSubject, "table": BadModel, "robot_map": BadModel, "protocol": BadOption}


@pytest.mark.parametrize("name", TOMLS)
@pytest.mark.parametrize("text", [b"a = " + b"9" * 5000, b"a = " + b"[" * 3000, b"a = '\xff'"])
def test_toml_that_python_gives_up_on(name: str, text: bytes, tmp_path: Path) -> None:
    kind = (TOMLS[name], MissingFile)
    assert isinstance(try_one(BY_NAME[name], tmp_path, text), kind)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (b"matrix = [\n    [", b"matrix = [\n    [" + b"9" * 400 + b",", "covariance.matrix holds NaN"),
        (b"qw = 1.0", b"qw = " + b"9" * 400, "mounts.torso has qw = 9999"),
        (b"qw = 1.0", b"qw = 1e200", "mounts.torso has qw = 1e+200"),
        (b"y = 1.0\n", b"y = 1e200\n", "hinges.left_elbow has y = 1e+200"),
    ],
)
def test_numbers_in_a_subject_that_are_none(old: bytes, new: bytes, says: str, tmp_path: Path) -> None:
    text = seeds.subject()
    assert old in text
    assert says in told("subject", tmp_path, text.replace(old, new, 1), BadSubject)


def test_numbers_in_maps_tables_and_protocols_that_are_none(tmp_path: Path) -> None:
    (arm,) = BY_NAME["robot_map"].seeds()
    assert b"[rest]\n" in arm
    many = arm.replace(b"[rest]\n", b"[rest]\na = " + b"9" * 400 + b"\n")
    assert "a number is needed" in told("robot_map", tmp_path, many, BadModel)
    table = BY_NAME["table"].seeds()[0]
    assert "three numbers" in told("table", tmp_path, table.replace(b"[0.0, 0.0, 0.0]", b"[0.0, 1e308, 0.0]"), BadModel)
    poses = BY_NAME["protocol"].seeds()[1]
    start = poses.index(b"= [", poses.index(b"directions"))
    end = poses.index(b"]", start)
    for numbers in (b"0, 0, 0", b"1e308, 0, 0", b"nan, 0, 0"):
        spoiled = poses[: start + 3] + numbers + poses[end:]
        assert "three numbers are needed" in told("protocol", tmp_path, spoiled, BadOption)


# Devices' files ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["1e308", "nan"])
def test_increments_of_a_dot_that_are_no_rotation(cell: str, tmp_path: Path) -> None:
    lines = seeds.dot()[1].decode().splitlines(keepends=True)
    cells = lines[8].split(",")
    lines[8] = ",".join([*cells[:2], cell, *cells[3:]])
    error = try_one(BY_NAME["dot"], tmp_path, "".join(lines).encode())
    assert cell == "nan" or "no device measures as much" in str(error)  # one lost sample is bridged


def test_a_dot_whose_time_stands_still(tmp_path: Path) -> None:
    head = "PacketCounter,SampleTimeFine,dq_W,dq_X,dq_Y,dq_Z,dv[1],dv[2],dv[3]\n"
    text = head + "1,5,1,0,0,0,0,0,0.098\n" * 3
    assert "its time does not grow" in told("dot", tmp_path, text.encode(), BadData)


@pytest.mark.parametrize("rate", [".", "1.2.3", "..5Hz", "", "0"])
def test_an_mt_manager_export_whose_rate_is_none(rate: str, tmp_path: Path) -> None:
    text = seeds.mt_manager()[1].replace(b"Update Rate: 100.0Hz", f"Update Rate: {rate}".encode())
    assert "no times are known from 'PacketCounter' or 'SampleTimeFine'" in told("mt_manager", tmp_path, text, BadData)


def test_a_summary_that_is_none(tmp_path: Path) -> None:
    for text in (b"[1]", b"3", b"[" * 5000):
        assert "damaged" in told("summary", tmp_path, text, BadData)
    odd = b'{"sensors": 3, "points": [1.5], "warnings": "x", "recording": null}'
    assert try_one(BY_NAME["summary"], tmp_path, odd) is None


# Archives ----------------------------------------------------------------------------------------------------------


def test_what_an_hdf5_file_names_outside_is_not_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    np.arange(8.0).tofile(tmp_path / "secret")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(8.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["own"] = np.arange(8.0)
        file.create_dataset("raw", shape=(8,), dtype="f8", external=[(str(tmp_path / "secret"), 0, 64)])
        file["link"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/x")
        layout = h5py.VirtualLayout(shape=(8,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", shape=(8,))
        file.create_virtual_dataset("virtual", layout)
    assert list(ArrayFile(tmp_path / "a.h5").shapes) == ["/own"]


# URDF --------------------------------------------------------------------------------------------------------------

LAUGHS = b'<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'
SECRET = b'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/hostname">]><robot name="&a;"/>'


@pytest.mark.parametrize("text", [LAUGHS, SECRET])
@pytest.mark.parametrize("name", ["body", "robot"])
def test_a_urdf_with_entities_is_not_read(name: str, text: bytes, tmp_path: Path) -> None:
    assert "declares an entity, 'a'" in told(name, tmp_path, text, BadModel)


def test_joints_in_a_row_without_end(tmp_path: Path) -> None:
    n = 2000
    links = "".join(f'<link name="l{k}"/>' for k in range(n + 1))
    joint = '<joint name="j{0}" type="fixed"><parent link="l{0}"/><child link="l{1}"/></joint>'
    text = f'<robot name="a">{links}{"".join(joint.format(k, k + 1) for k in range(n))}</robot>'
    assert "2000 joints in a row" in told("robot", tmp_path, text.encode(), BadModel)


@pytest.mark.parametrize("axis", ["0 1", "0 1 0 0", "nan 0 1", "1e308 0 0"])
def test_an_axis_that_is_not_three_numbers(axis: str, tmp_path: Path) -> None:
    text = seeds.shipped("urdf/upper_body.urdf")[0].replace(b'<axis xyz="0 1 0"', f'<axis xyz="{axis}"'.encode(), 1)
    assert "three numbers each" in told("body", tmp_path, text, BadModel)


def test_a_mimic_joint_that_names_no_other(tmp_path: Path) -> None:
    text = seeds.URDF.replace('<mimic joint="shoulder"', "<mimic")
    assert "joint 'elbow' mimics '', which is no joint" in told("robot", tmp_path, text.encode(), BadModel)


def test_pinocchio_is_silent_on_a_urdf_that_it_refuses(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    try_one(BY_NAME["robot"], tmp_path, seeds.URDF.replace(' effort="10"', "").encode())
    assert capfd.readouterr().err == ""


# Recordings of a live session --------------------------------------------------------------------------------------


def test_a_live_recording_that_is_damaged(tmp_path: Path) -> None:
    good, live = seeds.live_log(), BY_NAME["live_log"]
    assert try_one(live, tmp_path, good) is None
    for old, new, says in (
        (b'"rate_hz": 100.0', b'"rate_hz": 1e300', "an event 'clock'"),
        (b'"wait_s": 0.5', b'"wait_s": 1e9', "an event 'clock'"),
        (b'"begin": 0, "end": 50', b'"begin": 50, "end": 0', "an event 'start'"),
        (b'"kind": "clock"', b'"kind": "clokc"', "broke off before the start pose"),
        (b'"mounts": {"torso": [0.0, 0.0', b'"mounts": {"torso": [7.0, 0.0', "mounts ="),
        (b'"name": "live"', b'"name": [1, 2]', "lacks name"),
        (b'"phases": {}', b'"phases": 3 ', "phases.phases = 3"),
        (b'["torso"]', b'[["a"]]  ', "this version reads format 3"),
        (b'"gyro": [0.0, 0.0, 0.0]', b'"gyro": [0.0, 0.0, "0"]', "of /sensors/torso"),
        (b'"gyro": [0.0, 0.0, 0.0]', b'"gyro": [0.0, 0.0     ]', "of /sensors/torso"),
        (b'"tick": 51', b'"tick": {}', "of /pose"),
        (b'{"t": 0.5', b'["t", 0.5', "holds JSON that is none"),
    ):
        assert old in good
        assert says in str(try_one(live, tmp_path, good.replace(old, new))), new


def test_times_in_a_live_recording_that_would_make_years_of_ticks(tmp_path: Path) -> None:
    wild = re.sub(rb'"t": 0\.[67]', lambda found: found[0].replace(b"0.", b"9e9"[:2]), seeds.live_log())
    assert "holds no as long recording" in told("live_log", tmp_path, wild, BadData)


# Results, tables ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("column", "row", "value", "says"),
    [
        ("time", 1, "-1e308", "time does not increase"),
        ("time", 1, "nan", "time does not increase"),
        ("time", 3, "1e300", "no pose has such a number"),
        ("left_palm_x", 2, "1e308", "left_palm_x is 1e+308 in row 3"),
        ("torso_std", 0, "-1e308", "torso_std is -1e+308 in row 1"),
    ],
)
def test_a_pose_with_numbers_that_no_pose_has(column: str, row: int, value: str, says: str, tmp_path: Path) -> None:
    """Pages, comparison and exports overflowed, each at another place."""
    assert says in told("result", tmp_path, _pose_with(column, row, value), BadData)


def _pose_with(column: str, row: int, value: str) -> bytes:
    names, *rows = [line.split(",") for line in seeds.pose_csv().decode().splitlines()]
    rows[row][names.index(column)] = value
    return "\n".join(",".join(line) for line in [names, *rows]).encode()


def test_a_pose_whose_time_jumps(tmp_path: Path) -> None:
    """A page of 30 frames a second would have had 3e12 of them."""
    text = told("result", tmp_path, _pose_with("time", 3, "1e11"), BadData)
    assert "time jumps from 0.02 to 100000000000 s in row 4" in text
    assert len(frame_indices(np.array([0.0, 0.1, 1e11]), 30.0)) == 3
    time = np.arange(0.0, 10.0, 0.01)
    assert np.ptp(np.diff(time[frame_indices(time, 30.0)])[:-1]) < 0.011


def test_a_pose_that_states_no_uncertainty(tmp_path: Path) -> None:
    """Deviations of zero: their covariance has no inverse."""
    table = pl.read_csv(io.BytesIO(seeds.pose_csv()))
    text = table.with_columns(pl.selectors.ends_with("_std") * 0.0).write_csv()
    assert try_one(BY_NAME["result"], tmp_path, text.encode()) is None


def test_a_pose_without_a_shoulder_is_no_bvh(tmp_path: Path) -> None:
    text = seeds.pose_csv().decode().replace("right_shoulder_x", "x")
    assert "no columns right_shoulder_x" in told("result", tmp_path, text.encode(), BadData)


def test_an_empty_pose(tmp_path: Path) -> None:
    text = seeds.pose_csv().splitlines(keepends=True)[0]
    assert "no rows" in told("result", tmp_path, text, BadData)


def test_an_axis_in_a_table_of_links_that_is_a_table(tmp_path: Path) -> None:
    text = BY_NAME["table"].seeds()[0].replace(b'forward = "+x"\n[', b'forward = { link = "a" }\n[')
    assert "forward = {'link': 'a'}" in told("table", tmp_path, text, BadModel)


@pytest.mark.parametrize("name", ["body", "robot"])
def test_a_urdf_in_an_encoding_that_nobody_knows(name: str, tmp_path: Path) -> None:
    text = BY_NAME[name].seeds()[0]
    text = b'<?xml version="1.0" encoding="utf-99"?>' + text[text.index(b"<robot") :]
    assert "unknown encoding" in told(name, tmp_path, text, BadModel)


@pytest.mark.parametrize("name", TOMLS)
def test_a_byte_order_mark_and_dos_lines(name: str, tmp_path: Path) -> None:
    """As editors on Windows write them."""
    for seed in BY_NAME[name].seeds():
        assert try_one(BY_NAME[name], tmp_path, b"\xef\xbb\xbf" + seed.replace(b"\n", b"\r\n")) is None


@pytest.mark.parametrize("name", ["..", ".", "..."])
def test_a_session_in_a_plan_whose_name_is_dots(name: str, tmp_path: Path) -> None:
    text = seeds.PLAN_TABLE.replace(b"first", name.encode())
    told("plan_table", tmp_path, text, BadPlan)


@pytest.mark.parametrize("name", ["retarget", "srdf"])
def test_a_robot_in_an_encoding_that_nobody_knows(name: str, tmp_path: Path) -> None:
    text = b'<?xml version="1.0" encoding="utf-99"?>' + BY_NAME[name].seeds()[0]
    assert "unknown encoding" in told(name, tmp_path, text, BadModel)


# Output ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def session(tmp_path: Path) -> Path:
    files = Files(tmp_path / "in", good_table())
    files.folder.mkdir()
    return files.write()


def test_paths_that_are_not_utf_8(tmp_path: Path, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    try:
        session.parent.rename(folder)
    except OSError:
        pytest.skip("this file system takes names in UTF-8 only")
    with pytest.raises(SystemExit) as stop:
        main(["track", str(folder / "session.toml"), "-o", str(folder / "out")])
    assert stop.value.code == 0, capsys.readouterr().err
    assert (folder / "out" / "pose.parquet").stat().st_size > 1000
    capsys.readouterr()
    line = refused(["track", str(folder / "none.toml"), "-o", str(folder / "out2")], capsys)
    assert "caf\\udce9/none.toml: no such file" in line


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no /dev/zero here")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5", ".mvnx", ".txt", ".sto", ".mcap", ".toml"])
def test_a_device_without_end_is_no_file(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / f"a{suffix}").symlink_to("/dev/zero")
    named = tmp_path / f"a{suffix}"
    if suffix not in (".mcap", ".toml"):
        named = tmp_path / "session.toml"
        named.write_text(seeds.SESSION.split("[sensors.left")[0].replace("arm.csv", f"a{suffix}"))
    assert "a" + suffix in refused(["track", str(named), "-o", str(tmp_path / "out")], capsys)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_under_stdout(tmp_path: Path, session: Path) -> None:
    command = [sys.executable, "-m", "wepose_pin.cli", "track", str(session), "-o", str(tmp_path / "out")]
    with open("/dev/full", "w") as full:
        run = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert run.returncode == 2
    assert run.stderr.splitlines()[-1].endswith("No space left on device; " + f"{tmp_path / 'out'} was written before")
    assert (tmp_path / "out" / "pose.parquet").is_file()


def test_a_signal_while_files_move_waits_until_they_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C between the first file and the last of an output folder that is there already."""
    (tmp_path / "out").mkdir()
    replace: Callable[[Path, Path], Path] = Path.replace

    def and_stop(path: Path, target: Path) -> Path:
        os.kill(os.getpid(), signal.SIGINT)
        return replace(path, target)

    def fill() -> None:
        with whole_folder(tmp_path / "out") as folder:
            for name in "abc":
                (folder / name).write_text(name)
            monkeypatch.setattr(Path, "replace", and_stop)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            fill()
    finally:
        signal.signal(signal.SIGINT, before)
    monkeypatch.undo()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a", "b", "c"]
    assert written[-1] == tmp_path / "out"


def test_what_a_killed_run_left_is_in_nobodys_way(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from wepose_pin.documents import whole_folder\n"
        "with whole_folder(Path(sys.argv[1])) as folder:\n"
        "    (folder / 'a').write_text('half'); print('now', flush=True); time.sleep(60)"
    )
    for out in (tmp_path / "new", tmp_path / "there"):
        if out.name == "there":
            out.mkdir()
        with subprocess.Popen([sys.executable, "-c", code, str(out)], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "now\n"
            process.kill()
        left = [path for path in (*tmp_path.iterdir(), *(tmp_path / "there").glob("*")) if path.name.startswith(".")]
        assert [path.name.startswith(f".{out.name}.partial-") for path in left if f".{out.name}." in path.name] == [
            True
        ]
        with whole_folder(out) as folder:
            (folder / "a").write_text("whole")
        assert (out / "a").read_text() == "whole"


def test_an_output_folder_appears_at_once(tmp_path: Path) -> None:
    """Whoever looks while it appears sees all files or none, and with the rights that the user's folders have."""
    with whole_folder(tmp_path / "out") as folder:
        for k in range(50):
            (folder / str(k)).write_text("")
        code = "import os, sys\nprint('now', flush=True)\nwhile not os.path.isdir(sys.argv[1]): pass\n"
        code += "print(len(os.listdir(sys.argv[1])))"
        words = [sys.executable, "-c", code, str(tmp_path / "out")]
        watcher = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert watcher.stdout is not None
        watcher.stdout.readline()
        time.sleep(0.05)
    assert watcher.communicate()[0] == "50\n"
    (tmp_path / "own").mkdir()
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "own").stat().st_mode


def test_numbers_whose_squares_are_none_are_scanned() -> None:
    """A stuck axis may hold any number; the whole package warns of none."""
    time_s = np.arange(900) / 100.0
    values = np.random.default_rng(1).normal(scale=1e-3, size=(900, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    values[:, 0] = 2.5e296
    values[300:500] = values[300]
    samples = {"torso": (time_s, values[:, :3], values[:, 3:]), "left_forearm": (time_s, np.full((900, 4), 1e308))}
    with pytest.raises(BadData, match="torso"):
        check_sensors("x", samples, None)
