"""The terminal's view: what it says, when, and that it leaves the terminal as it found it."""

import contextlib
import io
import os
import pty
import select
import subprocess
import sys
import termios
import textwrap
import time

import pytest

from wepose_pin.live import Request, SensorStatus, Status
from wepose_pin.live.state import Action, GuideView
from wepose_pin.live.terminal import Keyboard, TerminalView


def sensor(segment: str = "torso", **other: object) -> SensorStatus:
    usual = {"rate_hz": 99.8, "lost": False}
    return SensorStatus(segment, **(usual | other))  # type: ignore[arg-type]


def status(state: str = "ready", message: str = "Tracking.", sensors: tuple = (), **other: object) -> Status:
    usual = {"progress": 1.0, "time": 12.5, "latency_ms": (3.2, 8.4), "recorded_s": 0.0, "problems": {}}
    usual |= {"state": state, "message": message, "sensors": sensors or (sensor(),)}
    usual |= {"actions": (Action("reset", "Reset headings", "r"),)}
    return Status(**(usual | other))  # type: ignore[arg-type]


def test_without_a_terminal_a_line_a_change() -> None:
    file, time_s = io.StringIO(), 0.0
    with contextlib.closing(TerminalView(file, clock=lambda: time_s)) as view:
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
from wepose_pin.live.terminal import Keyboard, TerminalView
view = TerminalView(keyboard=Keyboard())
try:
    view.status(status())
    asked = []
    while "quit" not in asked:
        asked += [request.action for request in view.take_requests()]
        time.sleep(0.01)
finally:
    view.close()
print("asked", *asked)
"""


class Keys(Keyboard):
    """A keyboard on which a test presses keys."""

    def __init__(self) -> None:
        self.pressed = ""

    def open(self) -> None: ...

    def take(self) -> list[str]:
        keys, self.pressed = self.pressed, ""
        return list(keys)

    def close(self) -> None: ...


def test_keys_ask_for_what_is_offered_with_the_text_that_is_typed() -> None:
    keys, file = Keys(), io.StringIO()
    view = TerminalView(file, keys)
    take, phase = Action("take", "Begin take", "t"), Action("phase", "Begin phase", "p", "name of the phase")
    for actions, pressed, requests in (
        ((take, phase), "tTx", [Request("take"), Request("take")]),
        ((take, phase), "pBoxx\x7f 3\rt", [Request("phase", "Box 3"), Request("take")]),
        ((take, phase), "p\rp1\n", [Request("phase"), Request("phase", "1")]),
        ((take, phase), "pq\x1bq", [Request("quit")]),
        ((phase._replace(label="End box", entry="", is_on=True),), "pt", [Request("phase")]),
        ((), "tp", []),
    ):
        view.status(status(actions=actions))
        keys.pressed = pressed
        assert view.take_requests() == requests
    assert "    keys: t Begin take, p Begin phase, q end\n" in file.getvalue()
    assert "    keys: p End box, q end\n" in file.getvalue()


def test_the_guide_says_why_and_what_can_be_done() -> None:
    file = io.StringIO()
    guide = GuideView("Result.", "Too wide.", reasons=("The scale is uncertain.",))
    TerminalView(file, Keys()).status(
        status("guide", "Result.", guide=guide, actions=(Action("accept", "Accept", "y"),))
    )
    lines = [line.partition(" s  ")[2] or line for line in file.getvalue().splitlines()]
    assert lines == ["Result. Too wide.", "    The scale is uncertain.", "    keys: y Accept, q end"]


def read_until(master: int, wanted: bytes, seconds: float = 120.0) -> bytes:
    got, until = b"", time.monotonic() + seconds
    while wanted not in got:
        assert select.select([master], [], [], until - time.monotonic())[0], got
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
    # The terminal is ours, and Ctrl-C an interrupt, also where the tests run in the background.
    take = "import fcntl, signal, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
    take += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    run = subprocess.Popen(
        [sys.executable, "-c", take + script], stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    )
    try:
        seen = read_until(master, b"latency")
        assert b" s  ready: Tracking." in seen
        until = time.monotonic() + 120.0
        while termios.tcgetattr(slave)[3] & termios.ICANON:
            assert time.monotonic() < until
            time.sleep(0.01)
        os.write(master, b"xR" + (b"q" if end == "q" else b"\x03"))
        seen = read_until(master, b"asked reset quit" if end == "q" else b"KeyboardInterrupt")
        run.wait(120)
        assert (run.returncode == 0) is (end == "q")
        assert termios.tcgetattr(slave) == before
    finally:
        run.kill()
        run.wait()
        os.close(master)
        os.close(slave)
