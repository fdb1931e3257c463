"""The live view for those without a browser: a table that redraws itself, or plain lines where there is no terminal."""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import select
import sys
from typing import Any, TextIO

from .state import LivePose, SensorStatus, Stage, Status

REFRESH_HZ = 4
KEYS = ("r", "q")
STATES = {"waiting": "…", "hold": "■", "moved": "✕", "ready": "▶", "ended": "■"}
# What a row tells, and the width of the terminal from which there is room for it.
COLUMNS = (
    ("sensor", 0),
    ("state", 0),
    ("rate\n[Hz]", 36),
    ("gyro bias x y z\n[°/s]", 80),
    ("heading\n± [°]", 50),
    ("set ago\n[s]", 58),
    ("missed\nsamples", 44),
)


class TerminalView:
    """An `Output` for a terminal; where `file` is none, a line whenever a state changes.

    Parameters
    ----------
    file : where to write; None: standard output
    keys : whether to take keys from standard input, if that is a terminal: "r" for headings anew, "q" to end
    """

    def __init__(self, file: TextIO | None = None, keys: bool = True) -> None:
        from rich.console import Console

        self._console = Console(file=file)
        self._live: Any = None
        self._newest: Status | None = None
        self._told: dict[str, str] = {}
        self._keyboard = Keyboard() if keys else None
        self._opened = False

    def open(self) -> None:
        """Begin to draw, and to listen to keys; the first status does it where nobody has."""
        self._opened = True
        if self._keyboard is not None:
            self._keyboard.open()
        if self._console.is_terminal and self._live is None:
            from rich.live import Live

            # Live draws in a thread of its own: the loop does not wait for the terminal.
            self._live = Live(
                console=self._console, get_renderable=self._drawn, refresh_per_second=REFRESH_HZ, transient=False
            )
            self._live.start()

    def start(self, stage: Stage) -> None:
        """Nothing to do: the status says it."""

    def show(self, pose: LivePose) -> None:
        """Nothing to do: a terminal shows no body."""

    def status(self, status: Status) -> None:
        self._newest = status
        if not self._opened:
            self.open()
        if not self._console.is_terminal:
            for line in self._changes(status):
                self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def take_keys(self) -> list[str]:
        """Keys since the last call, of "r" and "q"."""
        return [] if self._keyboard is None else [key for key in self._keyboard.take() if key in KEYS]

    def close(self) -> None:
        """The terminal as it was; the last table stays. May be called twice."""
        live, self._live = self._live, None
        if live is not None:
            live.stop()
        if self._keyboard is not None:
            self._keyboard.close()

    def __enter__(self) -> TerminalView:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _changes(self, status: Status) -> list[str]:
        """Lines on what is not as it was told before; the seconds of a countdown are no change."""
        now = {"": status.state} | {
            f"{s.segment}: ": "frozen" if s.frozen else "lost" if s.lost else "there" for s in status.sensors
        }
        now |= {f"{problem}: ": "since now" for problem, count in status.problems.items() if count}
        changed = [what for what, state in now.items() if self._told.get(what, "there") != state]
        self._told |= now
        clock = f"{status.time:.1f} s  "
        return [clock + (f"{status.state}: {status.message}" if not what else what + now[what]) for what in changed]

    def _drawn(self) -> Any:
        from rich.text import Text

        if self._newest is None:
            return Text("Connecting …")
        return table(self._newest, keys=self._keyboard is not None, width=self._console.width)


def table(status: Status, *, keys: bool = False, width: int = 80) -> Any:
    """A status for a terminal of `width` letters; what there is no room for is left out, the bias first."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    begun = status.state in ("ready", "ended")  # before, nothing is estimated
    rows = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    shown = [k for k, (_, least) in enumerate(COLUMNS) if width >= least]
    for k in shown:
        rows.add_column(Text(COLUMNS[k][0]), justify="left" if k < 2 else "right", no_wrap=True)
    for sensor in status.sensors:
        cells = _row(sensor, begun)
        rows.add_row(*(Text(cells[k]) for k in shown), style="bold red" if sensor.lost else "")
    head = Text.assemble(
        (f"{STATES.get(status.state, '')} {status.state}  ", "bold"), (status.message, "" if begun else "bold")
    )
    parts: list[Any] = [head]
    if status.state in ("hold", "moved"):
        done = round(30 * min(max(status.progress, 0.0), 1.0))
        parts.append(Text("█" * done + "░" * (30 - done)))
    half, most = status.latency_ms
    facts = f"latency {half:.1f} ms median, {most:.1f} ms in 99 of 100   " if begun else ""
    facts += f"time {status.time:.1f} s"
    if status.recorded_s:
        facts += f"   ● recording {status.recorded_s:.1f} s"
    parts += [rows, Text(facts)]
    problems = ", ".join(f"{problem}: {count}" for problem, count in status.problems.items() if count)
    if problems:
        parts.append(Text(problems, style="red"))
    if keys:
        parts.append(Text("r headings anew (stand in the start pose)   q end", style="dim"))
    return Group(*parts)


def _row(sensor: SensorStatus, begun: bool) -> tuple[str, ...]:
    state = "● there" if not begun else "■ at rest" if sensor.static else "▶ moving"
    if sensor.lost:
        state = "✕ frozen" if sensor.frozen else "✕ lost"
    bias = " ".join(f"{_known(math.degrees(axis) if begun else math.nan, 2):>6}" for axis in sensor.gyro_bias)
    heading = _known(math.degrees(sensor.heading_std), 1)
    age = _known(sensor.heading_age if begun else math.nan, 0)
    missed = str(sensor.missing + sensor.late + sensor.duplicate)
    return sensor.segment.replace("_", " "), state, _known(sensor.rate_hz, 0), bias, heading, age, missed


def _known(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "–"


class Keyboard:
    """Keys of the terminal at standard input as they are pressed, without a return; none where it is no terminal."""

    def __init__(self) -> None:
        self._fd: int | None = None
        self._before: list[Any] = []

    def open(self) -> None:
        try:
            import termios
            import tty

            fd = sys.stdin.fileno()
            # A job in the background that touches the terminal would be stopped.
            if self._fd is None and os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp():
                self._before = termios.tcgetattr(fd)
                tty.setcbreak(fd)  # Ctrl-C stays an interrupt
                self._fd = fd
                atexit.register(self.close)
        except (ImportError, OSError, ValueError, AttributeError):
            return  # no standard input, or none that is a terminal

    def take(self) -> list[str]:
        """What was pressed since the last call; never waits."""
        if self._fd is None or not select.select([self._fd], [], [], 0.0)[0]:
            return []
        try:
            pressed = os.read(self._fd, 64)
        except OSError:
            pressed = b""
        if not pressed:
            self.close()  # the terminal is gone
        return list(pressed.decode("ascii", "ignore").lower())

    def close(self) -> None:
        """The terminal as it was before."""
        fd, self._fd = self._fd, None
        if fd is not None:
            import termios

            with contextlib.suppress(termios.error):
                termios.tcsetattr(fd, termios.TCSADRAIN, self._before)
            atexit.unregister(self.close)
