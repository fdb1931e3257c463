"""What goes wrong around a command, not in its input: full disks, places that cannot be written, no files, kills.

The outcome is a result that is whole, or exit code 2 (130 where a signal stopped it), one line and nothing left behind.
"""

import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from commands import run
from test_bad_input import Files, good_table, refused

from wepose_pin import simulate, simulate_person
from wepose_pin.writers import write_session

TRACKED = {"pose.parquet", "report.html", "subject.toml", "subject.urdf", "summary.json", "view.html"}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A person with both arms, who can be calibrated in a second."""
    folder = tmp_path_factory.mktemp("faults")
    made = simulate(simulate_person(1).lengths, seed=1, clasp_s=5.0, circles=0)
    write_session(folder, made.recording("made"), made.truth())
    return folder


@pytest.fixture(scope="module")
def result(session: Path) -> Path:
    out = session / "result"
    assert run(*["track", str(session), "--no-report", "-o", str(out)]) == 0
    return out


# A full disk -------------------------------------------------------------------------------------------------------


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file of this process can grow beyond `size` bytes, as on a disk that is full."""
    before, kept = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # Python would keep the first bytes of a module and fail at it ever after
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = kept


FORMATS = ("csv", "parquet", "mot", "sto", "trc", "bvh", "urdf")
FULL = [
    *(("track SESSION --no-report -o OUT", size) for size in (0, 200_000)),
    ("calibrate SESSION -o OUT", 20_000),
    ("view RESULT --no-open -o OUT/a.html", 1000),
    ("info SESSION/recording.parquet -o OUT/session.toml", 100),
    *((f"export RESULT -o OUT/a.{format}", size) for format in FORMATS for size in (100, 4000)),
    ("export RESULT --format rosbag -o OUT", 4000),
]


@pytest.mark.parametrize(("words", "size"), FULL)
def test_a_full_disk(
    words: str, size: int, session: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    if "OUT/" in words:
        out.mkdir()
    command = [
        word.replace("SESSION", str(session)).replace("RESULT", str(result)).replace("OUT", str(out))
        for word in words.split()
    ]
    capsys.readouterr()
    with files_of_at_most(size):
        code = run(*command)
    captured = capsys.readouterr()
    assert code == 2, captured.err
    assert captured.err.count("\n") == 1
    assert f"wepose: {command[-1]}: " in captured.err
    assert "too large" in captured.err.lower() or "rosbag" in words
    assert [path.name for path in tmp_path.rglob("*")] == (["out"] if "OUT/" in words else [])


# Places that cannot be written -------------------------------------------------------------------------------------

NOWHERE = [place for place in ("/proc/wepose", "/dev/null", "/dev/null/out") if Path("/proc/self").exists()]


@pytest.mark.parametrize("place", NOWHERE)
@pytest.mark.parametrize("command", ["track SESSION", "calibrate SESSION", "simulate"])
def test_a_place_that_nobody_can_write_to(
    command: str, place: str, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused([*command.replace("SESSION", str(session)).split(), "-o", place], capsys)
    assert f"{place}: " in line


def test_no_home_and_no_cache(session: Path, tmp_path: Path) -> None:
    """Nothing but the output is wanted: no folder of settings, no cache of fonts."""
    nowhere = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR"), "/dev/null/nowhere")
    command = [sys.executable, "-m", "wepose_pin", "track", str(session), "-o", str(tmp_path / "out")]
    done = subprocess.run(command, env=os.environ | nowhere, cwd="/", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == TRACKED
    assert all(line.startswith("info: ") for line in done.stderr.splitlines()), done.stderr


# What is no file ---------------------------------------------------------------------------------------------------


@contextmanager
def seconds_at_most(seconds: int) -> Iterator[None]:
    def late(*_: object) -> None:
        raise AssertionError("it waits for a pipe that nobody writes to")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


READS = [
    *("track ODD.toml -o OUT", "track ODD.mcap -o OUT", "track SESSION --subject ODD.toml -o OUT"),
    *("track SESSION --model ODD.urdf -o OUT", "track SESSION --model ODD.toml -o OUT", "evaluate ODD SESSION"),
    *("calibrate SESSION --protocol ODD.toml -o OUT", "evaluate RESULT ODD.parquet", "evaluate RESULT ODD.csv"),
    *("evaluate RESULT ODD.toml", "export ODD -o OUT.csv", "view ODD --no-open"),
    *("batch ODD.toml -o OUT", "live --no-page --source replay:ODD.toml"),
    *("live --no-page --source udp:9 --session ODD.toml", "info ODD.csv", "info ODD.parquet", "info ODD.h5"),
    *("info ODD.mat", "info ODD.mvnx", "info ODD.sto", "info ODD.toml", "info ODD"),
]


@pytest.mark.parametrize("kind", ["pipe", "folder", "empty", "loop"])
def test_what_is_no_file_is_refused_wherever_one_is_read(
    kind: str, session: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make: dict[str, Callable[[Path], object]] = {
        "pipe": os.mkfifo,
        "folder": Path.mkdir,
        "empty": Path.touch,
        "loop": lambda path: path.symlink_to(path),
    }
    for words in READS:
        odd = next(word for word in words.replace("replay:", "").split() if "ODD" in word)
        path = tmp_path / odd.replace("ODD", "odd")
        if not os.path.lexists(path):
            make[kind](path)
        there = sorted(tmp_path.iterdir())
        names = {"ODD": tmp_path / "odd", "SESSION": session, "RESULT": result, "OUT": tmp_path / "out"}
        command = words
        for name, place in names.items():
            command = command.replace(name, str(place))
        with seconds_at_most(60):
            refused(command.split(), capsys)
        assert sorted(tmp_path.iterdir()) == there, words


# Paths -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["../outside/arm.csv", "ABSOLUTE", "link.csv"])
def test_data_may_lie_where_the_lab_keeps_them(name: str, tmp_path: Path) -> None:
    """docs/install.md says so, and why."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (tmp_path / "in").mkdir()
    files = Files(tmp_path / "in", good_table())
    good_table().write_csv(outside / "arm.csv")
    (tmp_path / "in" / "link.csv").symlink_to(outside / "arm.csv")
    files.say("arm.csv", str(outside / "arm.csv") if name == "ABSOLUTE" else name)
    session = files.write()
    (tmp_path / "in" / "arm.csv").unlink()
    assert run(*["track", str(session), "--no-report", "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "pose.parquet").is_file()


# Kills -------------------------------------------------------------------------------------------------------------


@pytest.mark.kill
@pytest.mark.usefixtures("result")  # numba has compiled
def test_a_run_that_is_killed_at_any_moment_leaves_the_whole_result_or_nothing(session: Path, tmp_path: Path) -> None:
    """Two moments of those in which it writes; twenty by hand: docs/install.md. The page comes after the result."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "wepose_pin", "track", str(session), "--no-report", "-o", str(out)]
    begun = time.monotonic()
    subprocess.run(command, check=True, capture_output=True)
    whole, took = {path.name for path in out.iterdir()}, time.monotonic() - begun
    moments = random.Random(5)
    for _ in range(2):
        for path in list(out.iterdir()) if out.exists() else ():
            path.unlink()
        if out.exists():
            out.rmdir()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(moments.uniform(0.5, 1.0) * took)
        process.kill()
        process.wait()
        left = {path.name for path in out.iterdir() if path.name != ".view.html.partial"} if out.exists() else set()
        assert left in (set(), whole, whole - {"view.html"})
        assert all(path == out or path.name.startswith(".out.partial-") for path in tmp_path.iterdir())
    subprocess.run([*command, "--force"], check=True, capture_output=True)
    assert {path.name for path in out.iterdir()} == whole
