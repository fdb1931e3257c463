"""The live view in a terminal: a table that redraws itself, or plain lines where the output is no terminal."""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import select
import sys
from collections.abc import Callable
from typing import Any, NamedTuple, TextIO

from .state import GuideView, Output, SensorStatus, Status, format_heading_std, name_length

REFRESH_HZ = 4
KEYS = {"r": "r", "q": "q", "t": "take", "m": "mark mark"}  # key → what it asks for
RETURN, ESCAPE, ERASE = "\r\n", "\x1b", "\b\x7f"
STATES = {"waiting": "…", "start_pose": "■", "moved": "✕", "ready": "▶", "ended": "■"}
# Columns, and the width of the terminal from which each is shown.
COLUMNS = (
    ("sensor", 0),
    ("state", 0),
    ("rate\n[Hz]", 36),
    ("gyro bias x y z\n[°/s]", 80),
    ("heading\n± [°]", 50),
    ("set ago\n[s]", 58),
    ("missing\nsamples", 44),
)


class Entry(NamedTuple):
    """A text that the person types, and ends by Return."""

    title: str
    request: Callable[[str], str]  # text → what it asks for; empty: nothing
    text: str = ""


class TerminalView(Output):
    """Shows the status in a terminal; where `file` is none, a line for each change of a state.

    Parameters
    ----------
    file : where to write; None: standard output
    keys : take keys from standard input, if that is a terminal: "r" to reset the headings, "q" to end
    """

    def __init__(self, file: TextIO | None = None, keys: bool = True) -> None:
        from rich.console import Console

        self._console = Console(file=file)
        self._live: Any = None
        self._newest: Status | None = None
        self._reported: dict[str, str] = {}
        self._entry: Entry | None = None
        self._keyboard = Keyboard() if keys else None
        self._opened = False

    def open(self) -> None:
        """Begin to draw and to take keys; otherwise the first status does it."""
        self._opened = True
        if self._keyboard is not None:
            self._keyboard.open()
        if self._console.is_terminal and self._live is None:
            from rich.live import Live

            # Live draws in a thread of its own: the loop does not wait for the terminal.
            self._live = Live(console=self._console, get_renderable=self._render, refresh_per_second=REFRESH_HZ)
            self._live.start()

    def status(self, status: Status) -> None:
        self._newest = status
        if not self._opened:
            self.open()
        if not self._console.is_terminal:
            for line in self._list_changes(status):
                self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def take_keys(self) -> list[str]:
        """What the keys since the last call ask for; those of the guide's actions go before the others."""
        if self._keyboard is None:
            return []
        requests = [self._take_key(key) for key in self._keyboard.take()]
        return [request for request in requests if request]

    def _take_key(self, key: str) -> str:
        """What a key asks for; empty: nothing, or it is a letter of an entry."""
        entry, status = self._entry, self._newest
        if entry is not None:
            if key in RETURN or key == ESCAPE:
                self._entry = None
                return entry.request(entry.text.strip()) if key in RETURN else ""
            text = entry.text[:-1] if key in ERASE else entry.text + key * key.isprintable()
            self._entry = entry._replace(text=text)
            return ""
        key, guide = key.lower(), None if status is None else status.guide
        if guide is not None:
            self._entry = _find_guide_entry(key, guide)
            done = [step.name for step in guide.steps if step.state == "done"]
            if key.isdigit() and 0 < int(key) <= len(done):
                return f"go {done[int(key) - 1]}"
            return ({"q": "q"} | {action.key: action.name for action in guide.actions}).get(key, "")
        if status is not None and status.state == "ready":
            phases = list_phases(status)
            if key == "p" and phases:
                return f"end {phases[-1]}"
            self._entry = ENTRIES.get(key)
        return KEYS.get(key, "")

    def close(self) -> None:
        """Restore the terminal; the last table stays. May be called twice."""
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

    def _list_changes(self, status: Status) -> list[str]:
        """A line for each state that differs from the last one reported; a countdown is no change."""
        state = status.state if status.guide is None else f"{status.message} {status.guide.note}".strip()
        now = {"": state} | {
            f"{s.segment}: ": "frozen" if s.frozen else "lost" if s.lost else "there" for s in status.sensors
        }
        now |= {f"{problem}: ": "since now" for problem, count in status.problems.items() if count}
        changed = [key for key, state in now.items() if self._reported.get(key, "there") != state]
        self._reported |= now
        clock = f"{status.time:.1f} s  "
        said = state if status.guide is not None else f"{status.state.replace('_', ' ')}: {status.message}"
        return [clock + (key + now[key] if key else said) for key in changed]

    def _render(self) -> Any:
        from rich.console import Group
        from rich.text import Text

        if self._newest is None:
            return Text("Connecting …")
        view = build_table(self._newest, keys=self._keyboard is not None, width=self._console.width)
        if self._entry is None:
            return view
        return Group(Text(f"{self._entry.title}: {self._entry.text}▏  (Return, or Escape)", style="bold yellow"), view)


MEASURE_KEY = "l"
ENTRIES = {
    "n": Entry("text of the mark", lambda text: f"mark {text or 'mark'}"),
    "p": Entry("name of the phase, clasp without one", lambda text: f"begin {text or 'clasp'}"),
}


def build_table(status: Status, *, keys: bool = False, width: int = 80) -> Any:
    """A status for a terminal of `width` letters; columns without room are left out, the bias first."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    if status.guide is not None:
        return build_guide(status, status.guide, keys=keys)
    tracking = status.state in ("ready", "ended")  # before, nothing is estimated
    rows = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    shown = [k for k, (_, least) in enumerate(COLUMNS) if width >= least]
    for k in shown:
        rows.add_column(Text(COLUMNS[k][0]), justify="left" if k < 2 else "right", no_wrap=True)
    for sensor in status.sensors:
        cells = _sensor_cells(sensor, tracking)
        rows.add_row(*(Text(cells[k]) for k in shown), style="bold red" if sensor.lost else "")
    head = Text.assemble(
        (f"{STATES.get(status.state, '')} {status.state.replace('_', ' ')}  ", "bold"),
        (status.message, "" if tracking else "bold"),
    )
    parts: list[Any] = [head]
    if status.state in ("start_pose", "moved"):
        done = round(30 * min(max(status.progress, 0.0), 1.0))
        parts.append(Text("█" * done + "░" * (30 - done)))
    p50, p99 = status.latency_ms
    facts = f"latency {p50:.1f} ms (p50), {p99:.1f} ms (p99)   " if tracking else ""
    facts += f"time {status.time:.1f} s"
    if status.recorded_s:
        facts += f"   ● recording {status.recorded_s:.1f} s"
    parts += [rows, Text(facts)]
    problems = ", ".join(f"{problem}: {count}" for problem, count in status.problems.items() if count)
    if problems:
        parts.append(Text(problems, style="red"))
    if keys:
        marks = ""
        if status.state == "ready":
            phases = list_phases(status)
            marks = f"   t begin or end a take   p {f'end phase {phases[-1]}' if phases else 'begin a phase'}"
            marks += "   m mark   n mark with a text" * bool(status.recorded_s)
        parts.append(Text(f"r reset headings (stand in the start pose){marks}   q end", style="dim"))
    return Group(*parts)


def build_guide(status: Status, guide: GuideView, *, keys: bool = False) -> Any:
    """A view of the guide for a terminal: steps, what to do, progress, sensors, what the motion determined."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    marks = {"done": ("✓ ", "green"), "now": ("▶ ", "bold reverse"), "ahead": ("", "dim")}
    steps = Text("  ").join(Text(f" {marks[s.state][0]}{s.title} ", style=marks[s.state][1]) for s in guide.steps)
    parts: list[Any] = [steps, Text("")]
    if guide.countdown is not None:
        parts.append(Text(f"{math.ceil(guide.countdown)}", style="bold yellow"))
    parts.append(Text(guide.sentence, style="bold"))
    if guide.note:
        parts.append(Text(guide.note, style="bold red"))
    done = round(30 * min(max(guide.progress, 0.0), 1.0))
    remaining = "" if guide.remaining is None else f"  {guide.remaining:.0f} s"
    parts.append(Text("█" * done + "░" * (30 - done) + remaining))
    if keys:
        offered = [f"{action.key} {action.label}" for action in guide.actions]
        offered += [f"{MEASURE_KEY} enter the {name_length(guide.measurable)}"] if guide.measurable else []
        back = [f"{k + 1} {step.title}" for k, step in enumerate(guide.steps) if step.state == "done"]
        parts.append(Text("   ".join([*offered, "q end"]), style="dim"))
        if back:
            parts.append(Text("   ".join(["again:", *back]), style="dim"))
    parts.append(Text("   ".join(map(_describe_sensor, status.sensors)), style="dim"))
    if guide.lengths:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
        for length in guide.lengths:
            name, mm = length.name.replace("_", " "), f"{1e3 * length.metres:.0f} mm"
            table.add_row(name, mm, f"± {1e3 * length.std:.0f}", "▪" * min(30, round(1e3 * length.std)))
        parts.append(table)
    if guide.sample_size is not None:
        parts.append(Text(f"effective sample size {guide.sample_size[0]:.1f}; {guide.sample_size[1]:.0f} are enough"))
    parts += [Text(reason) for reason in ([guide.quality] if guide.quality else []) + list(guide.reasons)]
    return Group(*parts)


def _describe_sensor(sensor: SensorStatus) -> str:
    """A sensor of the guide in a few words: its rate, battery and lost samples."""
    parts = [sensor.segment.replace("_", " "), "✕ silent" if sensor.lost else f"{sensor.rate_hz:.0f} Hz"]
    if math.isfinite(sensor.battery):
        parts.append(f"{100.0 * sensor.battery:.0f} %")
    if sensor.missing:
        parts.append(f"{sensor.missing} lost")
    return " ".join(parts)


def _find_guide_entry(key: str, guide: GuideView) -> Entry | None:
    """The entry that a key opens in the guide."""
    if key != MEASURE_KEY or not guide.measurable:
        return None

    def request(text: str) -> str:
        with contextlib.suppress(ValueError):
            return f"measure {guide.measurable}={0.01 * float(text.replace(',', '.')):.4f}"
        return ""

    return Entry(f"{name_length(guide.measurable)} [cm]", request)


def list_phases(status: Status) -> list[str]:
    """The open phases that are no takes."""
    return [phase for phase in status.open_phases if not phase.startswith("take_")]


def _sensor_cells(sensor: SensorStatus, tracking: bool) -> tuple[str, ...]:
    state = "● there" if not tracking else "■ static" if sensor.static else "▶ moving"
    if sensor.lost:
        state = "✕ frozen" if sensor.frozen else "✕ lost"
    if math.isfinite(sensor.battery):
        state += f" {100.0 * sensor.battery:.0f} %"
    bias = " ".join(f"{_format(math.degrees(axis) if tracking else math.nan, 2):>6}" for axis in sensor.gyro_bias)
    heading = format_heading_std(sensor.heading_std)
    age = _format(sensor.heading_age if tracking else math.nan, 0)
    missing = str(sensor.missing + sensor.late + sensor.duplicate)
    return sensor.segment.replace("_", " "), state, _format(sensor.rate_hz, 0), bias, heading, age, missing


def _format(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "–"


class Keyboard:
    """Keys at standard input as they are pressed, without a return; none where it is no terminal."""

    def __init__(self) -> None:
        self._fd: int | None = None
        self._before: list[Any] = []

    def open(self) -> None:
        try:
            import termios
            import tty

            fd = sys.stdin.fileno()
            # The system stops a background job that changes the terminal.
            if self._fd is None and os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp():
                self._before = termios.tcgetattr(fd)
                tty.setcbreak(fd)  # Ctrl-C stays an interrupt
                self._fd = fd
                atexit.register(self.close)
        except (ImportError, OSError, ValueError, AttributeError):
            return  # no standard input, or none that is a terminal

    def take(self) -> list[str]:
        """Keys since the last call; never waits."""
        if self._fd is None or not select.select([self._fd], [], [], 0.0)[0]:
            return []
        try:
            pressed = os.read(self._fd, 64)
        except OSError:
            pressed = b""
        if not pressed:
            self.close()  # the terminal is gone
        return list(pressed.decode("utf-8", "ignore"))

    def close(self) -> None:
        """Restore the terminal."""
        fd, self._fd = self._fd, None
        if fd is not None:
            import termios

            with contextlib.suppress(termios.error):
                termios.tcsetattr(fd, termios.TCSADRAIN, self._before)
            atexit.unregister(self.close)
