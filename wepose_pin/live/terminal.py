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
from collections.abc import Callable
from typing import Any, NamedTuple, TextIO

from .state import GuideView, Output, Status, name_length

KEYS = {"r": "r", "q": "q", "t": "take", "m": "mark mark"}  # key → what it asks for
RETURN, ESCAPE, ERASE = "\r\n", "\x1b", "\b\x7f"
CLEAR = "\r\x1b[K"  # to the begin of the line, and clear it
MEASURE_KEY = "l"


class Entry(NamedTuple):
    """A text that the person types, and ends by Return."""

    title: str
    request: Callable[[str], str]  # text → what it asks for; empty: nothing
    text: str = ""


ENTRIES = {
    "n": Entry("text of the mark", lambda text: f"mark {text or 'mark'}"),
    "p": Entry("name of the phase, clasp without one", lambda text: f"begin {text or 'clasp'}"),
}


class TerminalView(Output):
    """Prints a line for each change of a state; a terminal has the state of now in a last line as well.

    Parameters
    ----------
    file : where to write; None: standard output
    keys : take keys from standard input, if that is a terminal: "r" to reset the headings, "q" to end
    """

    def __init__(self, file: TextIO | None = None, keys: bool = True) -> None:
        self._file = file or sys.stdout
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
        lines = self._list_changes(status)
        if is_terminal:
            width = shutil.get_terminal_size().columns - 1
            last = "" if status.state == "ended" else self._describe_now(status)[:width]
            lines = [CLEAR + "".join(f"{line}\n" for line in lines) + last]
        else:
            lines = [f"{line}\n" for line in lines]
        self._file.write("".join(lines))
        self._file.flush()

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
        """Restore the terminal. May be called twice."""
        if self._keyboard is not None:
            self._keyboard.close()

    def __enter__(self) -> TerminalView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _list_changes(self, status: Status) -> list[str]:
        """A line for each state that differs from the last one reported; another number in a sentence is no change."""
        now = {"": re.sub(r"[0-9.]+", "", describe_state(status))} | {
            f"{s.segment}: ": "frozen" if s.frozen else "lost" if s.lost else "there" for s in status.sensors
        }
        now |= {f"{problem}: ": "since now" for problem, count in status.problems.items() if count}
        changed = [key for key, state in now.items() if self._reported.get(key, "there") != state]
        self._reported |= now
        lines = [f"{status.time:.1f} s  {key + now[key] if key else describe_state(status)}" for key in changed]
        if status.guide is not None and "" in changed:
            lines += [f"    {reason}" for reason in status.guide.reasons]
            lines += [f"    keys: {describe_guide_keys(status.guide)}"] * (self._keyboard is not None)
        return lines

    def _describe_now(self, status: Status) -> str:
        """The last line: what is typed, else what changes all the time."""
        if self._entry is not None:
            return f"{self._entry.title} (Return, or Escape): {self._entry.text}"
        parts, guide = [f"{status.time:.1f} s"], status.guide
        if guide is not None:
            parts += [] if guide.countdown is None else [f"begins in {math.ceil(guide.countdown)} s"]
            parts += [] if guide.remaining is None else [f"{guide.remaining:.0f} s left"]
            parts += [f"{100.0 * guide.progress:.0f} %", guide.sentence]
        else:
            parts.append(describe_state(status))
        if status.state == "ready":
            parts.append(f"latency {status.latency_ms[0]:.1f} ms (p50), {status.latency_ms[1]:.1f} ms (p99)")
        if status.recorded_s:
            parts.append(f"recording {status.recorded_s:.0f} s")
        if guide is None and self._keyboard is not None:
            parts.append("r reset, t take, p phase, m mark, n text, q end" if status.state == "ready" else "q end")
        return "  ".join(parts)


def describe_state(status: Status) -> str:
    """The state in a sentence; of a guide what it says, with what went wrong."""
    if status.guide is not None:
        return f"{status.message} {status.guide.note}".strip()
    return f"{status.state.replace('_', ' ')}: {status.message}"


def describe_guide_keys(guide: GuideView) -> str:
    """What each key does in this step of the guide."""
    offered = [f"{action.key} {action.label}" for action in guide.actions]
    offered += [f"{MEASURE_KEY} enter the {name_length(guide.measurable)}"] if guide.measurable else []
    back = [f"{k + 1} {step.title} again" for k, step in enumerate(guide.steps) if step.state == "done"]
    return ", ".join([*offered, *back, "q end"])


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
