"""The live view in a terminal: a line for each change, and in a terminal a line of the state now below them."""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import re
import select
import shutil
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TextIO

from .state import GuideView, Output, Request, Status, name_length

QUIT = Request("quit")
KEYS = {"r": Request("reset"), "q": QUIT, "t": Request("take"), "m": Request("mark", "mark")}
RETURN, ESCAPE, ERASE = "\r\n", "\x1b", "\b\x7f"
CLEAR = "\r\x1b[K"  # to the begin of the line, and clear it
MEASURE_KEY = "l"


class Entry(NamedTuple):
    """A text that the person types, and ends by Return."""

    title: str
    finish: Callable[[str], Request | None]  # text → what it asks for
    text: str = ""


ENTRIES = {
    "n": Entry("text of the mark", lambda text: Request("mark", text or "mark")),
    "p": Entry("name of the phase, clasp without one", lambda text: Request("begin", text or "clasp")),
}


class TerminalView(Output):
    """Prints a line for each change of a state; a terminal has the state of now in a last line as well.

    Times are those since the view was made.

    Parameters
    ----------
    file : where to write; None: standard output
    keys : take keys from standard input, if that is a terminal
    clock : [s]
    """

    def __init__(
        self, file: TextIO | None = None, keys: bool = True, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file, self._clock, self._begin = file or sys.stdout, clock, clock()
        self._newest: Status | None = None
        self._reported: dict[str, str] = {}
        self._entry: Entry | None = None
        self._keyboard = Keyboard() if keys else None

    def status(self, status: Status) -> None:
        self._newest = status
        if self._keyboard is not None:
            self._keyboard.open()
        is_terminal = self._file.isatty()
        if is_terminal and not select.select([], [self._file], [], 0.0)[1]:
            return  # it is halted: the loop must not wait for it
        now = f"{self._clock() - self._begin:.1f} s  "
        text = "".join(f"{line}\n" for line in self._list_changes(status, now))
        if is_terminal:
            last = "" if status.state == "ended" else self._describe_now(status, now)
            text = CLEAR + text + last[: shutil.get_terminal_size().columns - 1]
        self._file.write(text)
        self._file.flush()

    def take_requests(self) -> list[Request]:
        """What the keys since the last call ask for; those of the guide's actions go before the others."""
        keys = [] if self._keyboard is None else self._keyboard.take()
        return [request for request in map(self._press, keys) if request is not None]

    def _press(self, key: str) -> Request | None:
        """What a key asks for; None: nothing, or it is a letter of an entry."""
        entry, status = self._entry, self._newest
        if entry is not None:
            if key in RETURN or key == ESCAPE:
                self._entry = None
                return entry.finish(entry.text.strip()) if key in RETURN else None
            text = entry.text[:-1] if key in ERASE else entry.text + key * key.isprintable()
            self._entry = entry._replace(text=text)
            return None
        key = key.lower()
        if status is not None and status.guide is not None:
            if key == MEASURE_KEY and status.guide.measurable:
                self._entry = _measure(status.guide.measurable)
            return _list_guide_keys(status.guide).get(key, (None, ""))[0]
        if status is not None and status.state == "ready":
            phases = [phase for phase in status.open_phases if not phase.startswith("take_")]
            if key == "p" and phases:
                return Request("end", phases[-1])
            self._entry = ENTRIES.get(key)
        return KEYS.get(key)

    def close(self) -> None:
        """Restore the terminal. May be called twice."""
        if self._keyboard is not None:
            self._keyboard.close()

    def __enter__(self) -> TerminalView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _list_changes(self, status: Status, time_s: str) -> list[str]:
        """A line for each state that differs from the last one reported; another number in a sentence is no change."""
        now = {"": re.sub(r"[0-9.]+", "", describe_state(status))}
        for sensor in status.sensors:
            now[f"{sensor.segment}: "] = "frozen" if sensor.frozen else "lost" if sensor.lost else "there"
        now |= {f"{problem}: ": "since now" for problem, count in status.problems.items() if count}
        changed = [key for key, state in now.items() if self._reported.get(key, "there") != state]
        self._reported |= now
        lines = [time_s + (key + now[key] if key else describe_state(status)) for key in changed]
        if status.guide is not None and "" in changed:
            lines += [f"    {reason}" for reason in status.guide.reasons]
            if self._keyboard is not None:
                keys = [f"{key} {label}" for key, (_, label) in _list_guide_keys(status.guide).items()]
                lines.append(f"    keys: {', '.join(keys)}")
        return lines

    def _describe_now(self, status: Status, time_s: str) -> str:
        """The last line: what is typed, else what changes all the time."""
        if self._entry is not None:
            return f"{self._entry.title} (Return, or Escape): {self._entry.text}"
        guide = status.guide
        if guide is not None:
            parts = [] if guide.countdown is None else [f"begins in {math.ceil(guide.countdown)} s"]
            parts += [] if guide.remaining is None else [f"{guide.remaining:.0f} s left"]
            parts += [f"{100.0 * guide.progress:.0f} %", guide.sentence]
        else:
            parts = [describe_state(status)]
        if status.state == "ready":
            parts.append(f"latency {status.latency_ms[0]:.1f} ms (p50), {status.latency_ms[1]:.1f} ms (p99)")
        if status.recorded_s:
            parts.append(f"recording {status.recorded_s:.0f} s")
        if guide is None and self._keyboard is not None:
            parts.append("r reset, t take, p phase, m mark, n text, q end" if status.state == "ready" else "q end")
        return time_s + "  ".join(parts)


def describe_state(status: Status) -> str:
    """The state in a sentence; of a guide what it says, with what went wrong."""
    if status.guide is not None:
        return f"{status.message} {status.guide.note}".strip()
    return f"{status.state.replace('_', ' ')}: {status.message}"


def _list_guide_keys(guide: GuideView) -> dict[str, tuple[Request | None, str]]:
    """What each key does in this step of the guide: what it asks for, and a label."""
    keys: dict[str, tuple[Request | None, str]] = {
        action.key: (Request(action.kind), action.label) for action in guide.actions
    }
    if guide.measurable:
        keys[MEASURE_KEY] = None, f"enter the {name_length(guide.measurable)}"
    done = [step for step in guide.steps if step.state in ("done", "skipped")]
    keys |= {str(k + 1): (Request("go", step.name), f"{step.title} again") for k, step in enumerate(done)}
    return keys | {"q": (QUIT, "end")}


def _measure(length: str) -> Entry:
    """An entry of a length in cm."""

    def finish(text: str) -> Request | None:
        with contextlib.suppress(ValueError):
            return Request("measure", length, 0.01 * float(text.replace(",", ".")))
        return None

    return Entry(f"{name_length(length)} [cm]", finish)


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
