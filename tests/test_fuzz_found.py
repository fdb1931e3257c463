"""What fuzzing and faults found, each as it is told now; nothing of it may come back."""

from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run
from fuzz_targets import SESSION, TARGETS, live_log, pose, try_one
from test_bad_input import Files, good_table, refused

from wepose_pin import BadData, BadModel, BadOption, BadSession, BadSubject, MissingFile, WeposeError

BY_NAME = {target.name: target for target in TARGETS}


def test_an_error_is_one_printable_line_of_bounded_length() -> None:
    assert str(BadData("a\nb\x1b[31m \udcff é")) == "a\\nb\\x1b[31m \\udcff é"
    long = str(BadData("x" * 10**6 + "; the end"))
    assert len(long) < 2100
    assert long.endswith("; the end")


def test_names_in_a_file_do_not_steer_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = Files(tmp_path / "in", good_table(), 'name = "\\u001b[31mred"\n' + Files(tmp_path, good_table()).session)
    files.folder.mkdir()
    session = files.write()
    for command in (["info", str(session)], ["track", str(session), "-o", str(tmp_path / "out")]):
        assert run(*command) == 0
        captured = capsys.readouterr()
        assert "\x1b[31m" not in captured.out + captured.err
        assert "\\x1b[31mred" in captured.out


TOMLS = {"session": BadSession, "subject": BadSubject, "table": BadModel, "robot_map": BadModel, "protocol": BadOption}


@pytest.mark.parametrize("name", TOMLS)
@pytest.mark.parametrize("text", [b"a = " + b"9" * 5000, b"a = '\xff'"])
def test_toml_that_python_gives_up_on(name: str, text: bytes, tmp_path: Path) -> None:
    kind = (TOMLS[name], MissingFile)
    assert isinstance(try_one(BY_NAME[name], tmp_path, text), kind)


def change(name: str, old: str, new: str, k: int = 0) -> bytes:
    """The k-th well-formed input of a target with another text in it, once."""
    seed = BY_NAME[name].seeds()[k]
    assert old.encode() in seed, old
    return seed.replace(old.encode(), new.encode(), 1)


def change_pose(column: str, row: int, value: str) -> bytes:
    names, *rows = [line.split(",") for line in pose().write_csv().splitlines()]
    rows[row][names.index(column)] = value
    return "\n".join(",".join(line) for line in [names, *rows]).encode()


def change_direction(numbers: str) -> bytes:
    poses = BY_NAME["protocol"].seeds()[1]
    start = poses.index(b"= [", poses.index(b"directions"))
    return poses[: start + 3] + numbers.encode() + poses[poses.index(b"]", start) :]


def encoded(name: str) -> bytes:
    text = BY_NAME[name].seeds()[0]
    return b'<?xml version="1.0" encoding="utf-99"?>' + text[text.index(b"<robot") :]


MANY = "9" * 400
SECRET = b'<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/hostname">]><robot name="&a;"/>'
STANDS = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n" + "1,5,0,0,9.81,0,0,0\n" * 3
# The target, its input, and what the line says.
REFUSED: list[tuple[str, Callable[[], bytes], str]] = [
    (
        "subject",
        lambda: change("subject", "matrix = [[", f"matrix = [[{MANY},"),
        "covariance.matrix: rows of numbers are needed",
    ),
    ("subject", lambda: change("subject", "qw = 1.0", f"qw = {MANY}"), "mounts.torso.qw = 9999"),
    ("subject", lambda: change("subject", "qw = 1.0", "qw = 1e200"), "mounts.torso.qw = 1e+200"),
    ("subject", lambda: change("subject", "y = 1.0\n", "y = 1e200\n"), "hinges.left_elbow.y = 1e+200"),
    ("robot_map", lambda: change("robot_map", "[rest]\n", f"[rest]\na = {MANY}\n"), "a number from"),
    ("table", lambda: change("table", "[0.0, 0.0, 0.0]", "[0.0, 1e308, 0.0]"), "a number [m] from"),
    ("table", lambda: change("table", 'forward = "+x"\n[', 'forward = { link = "a" }\n['), "forward = {'link': 'a'}"),
    *(
        ("protocol", lambda text=text: change_direction(text), "three numbers are needed")
        for text in ("0, 0, 0", "1e308, 0, 0", "nan, 0, 0")
    ),
    ("dot", STANDS.replace("9.81", "1e308", 1).encode, "no device measures as much"),
    ("dot", STANDS.encode, "time stands still in row 2"),
    *(
        (
            "mt_manager",
            lambda rate=rate: change("mt_manager", "Update Rate: 100.0Hz", f"Update Rate: {rate}"),
            "no times are known from 'PacketCounter' or 'SampleTimeFine'",
        )
        for rate in (".", "1.2.3", "..5Hz", "", "0")
    ),
    ("body", lambda: SECRET, "reference to external entity"),
    *((name, lambda name=name: encoded(name), "unknown encoding") for name in ("body", "retarget")),
    *(
        ("body", lambda axis=axis: change("body", '<axis xyz="0 1 0"', f'<axis xyz="{axis}"'), "three numbers each")
        for axis in ("0 1", "0 1 0 0", "nan 0 1", "1e308 0 0")
    ),
    ("pose", lambda: change_pose("time", 1, "-1e308"), "time does not increase"),
    ("pose", lambda: change_pose("time", 1, "nan"), "time does not increase"),
    *(("summary", lambda text=text: text, "damaged") for text in (b"[1]", b"3", b"[" * 5000)),
]


@pytest.mark.parametrize(("name", "make", "says"), REFUSED)
def test_what_a_file_has_wrong_is_told(name: str, make: Callable[[], bytes], says: str, tmp_path: Path) -> None:
    error = try_one(BY_NAME[name], tmp_path, make())
    assert isinstance(error, WeposeError)
    assert says in str(error)


def test_a_live_recording_that_is_damaged(tmp_path: Path) -> None:
    good, live = live_log(), BY_NAME["live_log"]
    assert try_one(live, tmp_path, good) is None
    for old, new, says in (
        (b'"rate_hz": 100.0', b'"rate_hz": 1e300', "ticks at 1e+300 Hz"),
        (b'"kind": "clock"', b'"kind": "clokc"', "broke off before the start pose"),
        (b'"format": 4', b'"format": 3', "this version reads format 4"),
        (b'"gyro": [0.0, 0.0, 0.0]', b'"gyro": [0.0, 0.0, "0"]', "cannot be read as a recording of wepose live"),
        (b'"gyro": [0.0, 0.0, 0.0]', b'"gyro": [0.0, 0.0     ]', "cannot be read as a recording of wepose live"),
        (b'{"t": 0.5', b'["t", 0.5', "cannot be read as a recording of wepose live"),
    ):
        assert old in good
        assert says in str(try_one(live, tmp_path, good.replace(old, new))), new


@pytest.mark.parametrize("name", TOMLS)
def test_a_byte_order_mark_and_dos_lines(name: str, tmp_path: Path) -> None:
    """As editors on Windows write them."""
    for seed in BY_NAME[name].seeds():
        assert try_one(BY_NAME[name], tmp_path, b"\xef\xbb\xbf" + seed.replace(b"\n", b"\r\n")) is None


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no /dev/zero here")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5", ".mvnx", ".txt", ".sto", ".mcap", ".toml"])
def test_a_device_without_end_is_no_file(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / f"a{suffix}").symlink_to("/dev/zero")
    named = tmp_path / f"a{suffix}"
    if suffix not in (".mcap", ".toml"):
        named = tmp_path / "session.toml"
        named.write_text(SESSION.replace("arm.csv", f"a{suffix}"))
    assert "a" + suffix in refused(["track", str(named), "-o", str(tmp_path / "out")], capsys)
