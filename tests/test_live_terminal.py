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

import pytest

from wepose_pin.live.state import GuideAction, GuideStep, GuideView, Request, SensorStatus, Status
from wepose_pin.live.terminal import TerminalView


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


def test_without_a_terminal_a_line_a_change() -> None:
    file, time_s = io.StringIO(), 0.0
    with TerminalView(file, keys=False, clock=lambda: time_s) as view:
        time_s = 12.5
        for left in (3, 2, 1):
            view.status(status("start_pose", f"Stand still: {left} s more."))
        time_s = 13.0
        for rate in (3, 4):
            view.status(status("moved", f"rates of {rate} rad/s while gravity does not turn: deg/s?"))
        time_s = 20.0
        view.status(status(sensors=(sensor(lost=True),)))
        time_s = 21.0
        view.status(status(sensors=(sensor(lost=True),), problems={"[bad]": 1}))
        time_s = 22.0
        view.status(status(problems={"[bad]": 9}))
        time_s = 23.0
        view.status(status("ended", "The session has ended."))
    assert file.getvalue().splitlines() == [
        "12.5 s  start pose: Stand still: 3 s more.",
        "13.0 s  moved: rates of 3 rad/s while gravity does not turn: deg/s?",
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
    kinds = []
    while "quit" not in kinds:
        kinds += [request.kind for request in view.take_requests()]
        time.sleep(0.01)
finally:
    view.close()
print("asked", *kinds)
"""


def press(view: TerminalView, keys: str, now: Status) -> list[Request]:
    """What keys ask for, one after the other."""
    view.status(now)
    requests = []
    for key in keys:
        view._keyboard = SimpleNamespace(take=lambda key=key: [key], open=lambda: None, close=lambda: None)  # type: ignore
        requests += view.take_requests()
    return requests


def test_keys_while_tracking_mark_phases_and_texts() -> None:
    view, live = TerminalView(io.StringIO()), status()
    assert press(view, "tMr", live) == [Request("take"), Request("mark", "mark"), Request("reset")]
    assert press(view, "nTrialx\x7f 3\r", live) == [Request("mark", "Trial 3")]
    assert press(view, "n\r", live) == [Request("mark", "mark")]
    assert press(view, "nq\x1bq", live) == [Request("quit")]
    assert press(view, "p\rpbox\n", live) == [Request("begin", "clasp"), Request("begin", "box")]
    assert press(view, "p", status(open_phases=("take_1", "clasp"))) == [Request("end", "clasp")]
    assert press(view, "pn", status("start_pose", "Stand still.")) == []


def test_keys_of_the_guide_go_back_and_enter_a_length() -> None:
    states = {"a": "done", "b": "skipped", "c": "now"}
    steps = tuple(GuideStep(name, name.title(), state) for name, state in states.items())
    guide = GuideView("Result.", steps=steps, actions=(GuideAction("accept", "Accept", "y"),), measurable="biacromial")
    view, shown = TerminalView(io.StringIO()), status("guide", "Result.", guide=guide)
    assert press(view, "y2q", shown) == [Request("accept"), Request("go", "b"), Request("quit")]
    assert press(view, "3", shown) == []
    assert press(view, "l40.5\rl40,5\rlwide\r", shown) == 2 * [Request("measure", "biacromial", pytest.approx(0.405))]
    assert "y Accept, l enter the breadth of the shoulders, from acromion to acromion, 1 A again, 2 B again, q end" in (
        view._file.getvalue()  # type: ignore[attr-defined]
    )


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
        assert b" s  ready: Tracking." in seen
        until = time.monotonic() + 20.0
        while termios.tcgetattr(slave)[3] & termios.ICANON:
            assert time.monotonic() < until
            time.sleep(0.01)
        os.write(master, b"xR" + (b"q" if end == "q" else b"\x03"))
        seen = read_until(master, b"asked reset quit" if end == "q" else b"KeyboardInterrupt")
        run.wait(20)
        assert (run.returncode == 0) is (end == "q")
        assert termios.tcgetattr(slave) == before
    finally:
        run.kill()
        run.wait()
        os.close(master)
        os.close(slave)
