"""The live view in a terminal: a line for each change, a status line below them, and keys."""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import shutil
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, TextIO

from .state import QUIT, Action, Output, Request, Status

RETURN, ESCAPE, ERASE = "\r\n", "\x1b", "\b\x7f"
CLEAR = "\r\x1b[K"  # to the begin of the line, and clear it


class TerminalView(Output):
    """Prints a line for each change of a state; a terminal has a status line below them.

    Times are those since the view was made, by `clock` [s]. `file` None is standard output; without `keyboard` no keys.
    """

    def __init__(
        self, file: TextIO | None = None, keyboard: Keyboard | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file, self._keyboard, self._clock, self._begin = file or sys.stdout, keyboard, clock, clock()
        self._actions: tuple[Action, ...] = ()  # that are offered
        self._reported: dict[str, str] = {}  # what → its state
        self._typing: Action | None = None
        self._typed = ""

    def status(self, status: Status) -> None:
        self._actions = status.actions
        if self._keyboard is not None:
            self._keyboard.open()
        now = f"{self._clock() - self._begin:.1f} s  "
        text = "".join(f"{line}\n" for line in self._list_changes(status, now))
        if self._file.isatty():
            last = "" if status.state == "ended" else now + self._describe_now(status)
            text = CLEAR + text + last[: shutil.get_terminal_size().columns - 1]
        self._file.write(text)
        self._file.flush()

    def take_requests(self) -> list[Request]:
        keys = [] if self._keyboard is None else self._keyboard.take()
        return [*filter(None, map(self._press, keys))]

    def _press(self, key: str) -> Request | None:
        action = self._typing
        if action is None:
            action = next((each for each in self._actions if each.key == key.lower()), None)
            if action is not None and not action.entry:
                return Request(action.name)
            self._typing, self._typed = action, ""
            return QUIT if action is None and key in "qQ" else None
        if key in RETURN or key == ESCAPE:
            self._typing = None
            return Request(action.name, self._typed.strip()) if key in RETURN else None
        self._typed = self._typed[:-1] if key in ERASE else self._typed + key * key.isprintable()
        return None

    def close(self) -> None:
        if self._keyboard is not None:
            self._keyboard.close()

    def _list_changes(self, status: Status, now: str) -> list[str]:
        """A line for each state that differs from the last one reported; another number in a sentence is no change."""
        guide, sentence = status.guide, f"{status.state.replace('_', ' ')}: {status.message}"
        reasons = () if guide is None else guide.reasons
        if guide is not None:
            sentence = f"{status.message} {guide.note}".strip()
        states = {"": (re.sub(r"[0-9.]+", "", sentence), "\n    ".join([now + sentence, *reasons]))}
        for each in status.sensors:
            state = "lost" if each.lost else "there"
            states[each.segment] = state, f"{now}{each.segment}: {state}"
        states |= {problem: ("now", f"{now}{problem}: since now") for problem, n in status.problems.items() if n}
        if self._keyboard is not None and status.state != "ended":
            keys = ", ".join([*(f"{each.key} {each.label}" for each in status.actions), "q end"])
            states["keys"] = keys, f"    keys: {keys}"
        lines = [line for what, (state, line) in states.items() if self._reported.get(what, "there") != state]
        self._reported |= {what: state for what, (state, _) in states.items()}
        return lines

    def _describe_now(self, status: Status) -> str:
        """The status line: what is typed, else what changes all the time."""
        if self._typing is not None:
            return f"{self._typing.entry} (Return, or Escape): {self._typed}"
        if (guide := status.guide) is not None:
            parts = [] if guide.countdown is None else [f"begins in {math.ceil(guide.countdown)} s"]
            parts += [] if guide.remaining is None else [f"{guide.remaining:.0f} s left"]
            return "  ".join([*parts, f"{100.0 * guide.progress:.0f} %", guide.sentence])
        latency = "latency {:.1f} ms (p50), {:.1f} ms (p99)".format(*status.latency_ms)
        parts = [f"{status.state.replace('_', ' ')}: {status.message}", latency if status.state == "ready" else ""]
        parts.append(f"recording {status.recorded_s:.0f} s" if status.recorded_s else "")
        return "  ".join(filter(None, parts))


class Keyboard:
    """Keys at standard input as they are pressed, without a return; none where it is no terminal."""

    def __init__(self) -> None:
        self._fd: int | None = None
        self._before: list[Any] = []

    def open(self) -> None:
        with contextlib.suppress(OSError, ValueError):  # no standard input, or none that is a terminal
            fd = sys.stdin.fileno()
            # The system stops a background job that changes the terminal.
            if self._fd is None and os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp():
                self._before = termios.tcgetattr(fd)
                tty.setcbreak(fd)  # Ctrl-C stays an interrupt
                self._fd = fd

    def take(self) -> list[str]:
        """Keys since the last call; never waits."""
        if self._fd is None or not select.select([self._fd], [], [], 0.0)[0]:
            return []
        pressed = os.read(self._fd, 64)
        if not pressed:
            self.close()  # the terminal is gone
        return list(pressed.decode("utf-8", "ignore"))

    def close(self) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(fd, termios.TCSADRAIN, self._before)
