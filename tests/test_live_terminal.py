"""The terminal's view: what it says, when, and that it leaves the terminal as it found it."""

from __future__ import annotations

import io
import math
import os
import pty
import subprocess
import sys
import termios
import textwrap
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from wepose_pin.live.state import (
    UNKNOWN_HEADING_STD,
    GuideAction,
    GuideStep,
    GuideView,
    SensorStatus,
    Status,
    format_heading_std,
)
from wepose_pin.live.terminal import TerminalView, build_table


def sensor(segment: str = "torso", **other: object) -> SensorStatus:
    usual = {"rate_hz": 99.8, "lost": False, "static": False, "gyro_bias": (0.002, -0.005, 0.0)}
    usual |= {
        "heading_std": math.radians(1.3),
        "heading_age": 34.4,
        "missing": 2,
        "late": 1,
        "duplicate": 0,
        "frozen": False,
    }
    return SensorStatus(segment, **(usual | other))  # type: ignore[arg-type]


def status(state: str = "ready", message: str = "Tracking.", sensors: tuple = (), **other: object) -> Status:
    usual = {"progress": 1.0, "time": 12.5, "latency_ms": (3.2, 8.4), "recorded_s": 0.0, "problems": {}}
    usual |= {"state": state, "message": message, "sensors": sensors or (sensor(),)}
    return Status(**(usual | other))  # type: ignore[arg-type]


def printed(one: Status, keys: bool = False) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(build_table(one, keys=keys))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_row_a_sensor() -> None:
    lines = printed(
        status(
            sensors=(
                sensor(),
                sensor("left_forearm", static=True),
                sensor("head", lost=True),
                sensor("pelvis", lost=True, frozen=True),
            )
        )
    ).splitlines()
    torso, forearm, head, pelvis = (
        next(line for line in lines if line.startswith(name)) for name in ("torso", "left f", "head", "pelvis")
    )
    assert "✕ frozen" in pelvis
    assert torso.split() == "torso ▶ moving 100 0.11 −0.29 0.00 1.3 34 3".split()
    assert "■ static" in forearm
    assert "✕ lost" in head
    assert any("latency 3.2 ms (p50), 8.4 ms (p99)" in line for line in lines)


def test_what_is_not_known_is_a_dash() -> None:
    row = printed(status(sensors=(sensor(heading_std=math.nan, gyro_bias=(math.nan,) * 3),))).splitlines()
    assert next(line for line in row if line.startswith("torso")).split()[4:8] == ["–"] * 4


def test_a_heading_of_which_nothing_is_known_is_unknown() -> None:
    """A direction that is uniform on the circle has a standard deviation of 180°/√3 = 103.9°."""
    uniform = np.random.default_rng(0).uniform(-np.pi, np.pi, 100_000).std()
    assert abs(uniform - UNKNOWN_HEADING_STD) < 0.01
    assert format_heading_std(math.nan) == "–"
    assert format_heading_std(math.radians(103.0)) == "103.0"
    assert {format_heading_std(math.radians(degrees)) for degrees in (104.0, 230.0, 1e9)} == {"unknown"}
    rows = printed(status(sensors=(sensor(heading_std=math.radians(230.0)),))).splitlines()
    assert next(line for line in rows if line.startswith("torso")).split()[-3] == "unknown"


def test_the_start_pose_has_a_bar_and_the_rest_none() -> None:
    assert "█" * 12 + "░" * 18 in printed(status("start_pose", "Stand still: 2 s more.", progress=0.4))
    assert "░" not in printed(status())


def test_before_the_start_nothing_is_said_of_what_is_not_estimated() -> None:
    text = printed(status("waiting", "Waiting for head."))
    assert (
        next(line for line in text.splitlines() if line.startswith("torso")).split()[1:8]
        == "● there 100 – – – 1.3".split()
    )
    assert "latency" not in text


@pytest.mark.parametrize("width", [80, 79, 60, 58, 57, 50, 49, 44, 43, 36, 35, 30])
def test_a_narrow_terminal_shows_fewer_columns_and_those_whole(width: int) -> None:
    console = Console(file=io.StringIO(), width=width)
    many = sensor("right_upper_arm", rate_hz=1000.0, heading_age=1000.0, missing=1203, late=0, duplicate=0, lost=True)
    console.print(build_table(status(sensors=(many,)), width=width))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert not any("…" in line for line in lines)
    row = next(line for line in lines if line.startswith("right upper arm"))
    assert "✕ lost" in row
    assert ("1203" in row) == (width >= 44)
    assert ("°/s" in "".join(lines)) == (width >= 80)


def test_recording_and_problems() -> None:
    text = printed(status(recorded_s=7.0, problems={"bad checksums": 3, "none of it": 0}))
    assert "● recording 7.0 s" in text
    assert "bad checksums: 3" in text
    assert "none of it" not in text


def test_without_a_terminal_a_line_a_change() -> None:
    file = io.StringIO()
    with TerminalView(file, keys=False) as view:
        for left in (3, 2, 1):
            view.status(status("start_pose", f"Stand still: {left} s more."))
        view.status(status(sensors=(sensor(lost=True),), time=20.0))
        view.status(status(sensors=(sensor(lost=True),), time=21.0, problems={"[bad]": 1}))
        view.status(status(time=22.0, problems={"[bad]": 9}))
        view.status(status("ended", "The session has ended.", time=23.0))
    assert file.getvalue().splitlines() == [
        "12.5 s  start pose: Stand still: 3 s more.",
        "20.0 s  ready: Tracking.",
        "20.0 s  torso: lost",
        "21.0 s  [bad]: since now",
        "22.0 s  torso: there",
        "23.0 s  ended: The session has ended.",
    ]


SESSION = """
import sys, time
sys.path.insert(0, {tests!r})
from test_live_terminal import status
from wepose_pin.live.terminal import TerminalView
view = TerminalView()
try:
    view.status(status())
    keys = []
    while "q" not in keys:
        keys += view.take_keys()
        time.sleep(0.01)
finally:
    view.close()
print("keys", "".join(keys))
"""


def press(view: TerminalView, keys: str, now: Status) -> list[str]:
    """What keys ask for, one after the other."""
    view.status(now)
    requests = []
    for key in keys:
        view._keyboard = SimpleNamespace(take=lambda key=key: [key], open=lambda: None, close=lambda: None)  # type: ignore
        requests += view.take_keys()
    return requests


def test_keys_while_tracking_mark_phases_and_texts() -> None:
    view, live = TerminalView(io.StringIO()), status()
    assert press(view, "tMr", live) == ["take", "mark mark", "r"]
    assert press(view, "nTrialx\x7f 3\r", live) == ["mark Trial 3"]
    assert press(view, "n\r", live) == ["mark mark"]
    assert press(view, "nq\x1bq", live) == ["q"]
    assert press(view, "p\rpbox\n", live) == ["begin clasp", "begin box"]
    assert press(view, "p", status(open_phases=("take_1", "clasp"))) == ["end clasp"]
    assert press(view, "pn", status("start_pose", "Stand still.")) == []


def test_keys_of_the_guide_go_back_and_enter_a_length() -> None:
    steps = tuple(GuideStep(name, name.title(), state) for name, state in (("a", "done"), ("b", "done"), ("c", "now")))
    guide = GuideView("Result.", steps=steps, actions=(GuideAction("accept", "Accept", "y"),), measurable="biacromial")
    view, shown = TerminalView(io.StringIO()), status("guide", "Result.", guide=guide)
    assert press(view, "y2q", shown) == ["accept", "go b", "q"]
    assert press(view, "3", shown) == []
    assert press(view, "l40.5\rl40,5\rlwide\r", shown) == 2 * ["measure biacromial=0.4050"]
    text = printed(shown._replace(sensors=(sensor(battery=0.4, missing=7),)), keys=True)
    for said in ("again: 1 A 2 B", "l enter the breadth of the shoulders", "torso 100 Hz 40 % 7 lost"):
        assert said in " ".join(text.split())


def read_until(master: int, wanted: bytes, seconds: float = 60.0) -> bytes:
    got, until = b"", time.monotonic() + seconds
    while wanted not in got:
        assert time.monotonic() < until, got
        try:
            got += os.read(master, 65536)
        except OSError:
            break
    assert wanted in got, got
    return got


@pytest.mark.parametrize("end", ["q", "interrupt"])
def test_keys_and_the_terminal_afterwards(end: str) -> None:
    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    script = textwrap.dedent(SESSION.format(tests=os.path.dirname(__file__)))
    take = (
        "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"  # the terminal is ours, and Ctrl-C an interrupt
    )
    run = subprocess.Popen(
        [sys.executable, "-c", take + script], stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    )
    try:
        seen = read_until(master, b"latency")
        assert "▶ ready".encode() in seen
        until = time.monotonic() + 20.0
        while termios.tcgetattr(slave)[3] & termios.ICANON:
            assert time.monotonic() < until
            time.sleep(0.01)
        os.write(master, b"xR" + (b"q" if end == "q" else b"\x03"))
        seen = read_until(master, b"keys rq" if end == "q" else b"KeyboardInterrupt")
        run.wait(20)
        assert (run.returncode == 0) is (end == "q")
        assert termios.tcgetattr(slave) == before
        assert b"\x1b[?25h" in seen  # the cursor is there again
    finally:
        run.kill()
        run.wait()
        os.close(master)
        os.close(slave)
