"""A robot that follows the live pose: commands at an even rate as UDP with JSON. See docs/live-robot.md."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadOption
from ..retargeting import Robot, find_map, load, read_map
from ..retargeting.stream import HOLD_AFTER_S, STOP_AFTER_S, Command, CommandStream, Person, needed
from ..subject import average_subject
from .loop import Latencies, Output
from .out import LOOPBACK
from .setup import SensorSetup
from .sources.base import Source
from .sources.replay import ReplaySource
from .state import LivePose, Stage, Status

FORMAT = 1
PORT = 9002
DIGITS = 9  # after the point: third differences of what is written still keep the limits
LAST = 3  # times that the end is told: a datagram may be lost
CLOCKS_S = 0.5  # [s] over which what the poses' clock is ahead of this machine's is averaged
NEW_CLOCK_S = 0.25  # [s] from which on it is another
PATIENCE_S = 10.0  # [s] for which the end waits for the robot to stand


class Driven(NamedTuple):
    """What came of a robot's session."""

    robot: str
    commands: int
    skipped: int  # commands that were due while one took too long
    dropped: int  # that the system would not send
    held: int  # steps without a solution
    share: Mapping[str, float]  # of the commands that had a pose, state → share
    step: Latencies  # [s] from the newest pose to its command
    error: Mapping[str, Latencies]  # side → [m] of the hand while it followed

    @property
    def diagnostics(self) -> list[Diagnostic]:
        """Commands that the robot did not get, and steps in which it could not move."""
        found = [
            Diagnostic("robot-commands-skipped", WARNING, self.robot, self.skipped),
            Diagnostic("robot-blocked", WARNING, self.robot, self.held),
            Diagnostic("robot-commands-dropped", WARNING, self.robot, self.dropped),
        ]
        return [diagnostic for diagnostic in found if diagnostic.value]


class RobotOut:
    """An `Output`: the robot's commands, each as JSON in a datagram of its own.

    They come from a thread of their own at the stream's rate, by this machine's clock: the loop never waits for the
    solver, and the robot is stopped also when the loop stands. Of a replay as fast as it is read, time is the ticks'
    own instead: what is due is made in `show`, without a thread or a clock, and the same poses give the same bits.

    Parameters
    ----------
    to : ``PORT`` of this machine, or ``HOST:PORT``
    lengths_cov : (8, 8) [m²] of the person's lengths; None: exact
    speed : of a replay; infinite: time is the ticks' own

    Raises
    ------
    BadOption
        `to` is neither.
    """

    def __init__(
        self, stream: CommandStream, to: str = str(PORT), *, lengths_cov: np.ndarray | None = None, speed: float = 1.0
    ) -> None:
        self.stream, self.robot = stream, stream.robot
        self._wire = _Wire(to)
        self._lengths_cov, self._ticks = lengths_cov, math.isinf(speed)
        self._speed = 1.0 if self._ticks else speed
        self._person: Person | None = None
        self._newest: tuple[float, LivePose] | None = None
        self._taken: LivePose | None = None
        self._came = 0.0  # [s] when the newest sound pose came
        self._ahead = math.nan  # [s] what the poses' clock is ahead of this machine's
        self._due = math.nan  # [s] on the ticks' clock
        self._resume = self._closing = self._closed = False
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None
        self.newest: Command | None = None
        self._states: Counter[str] = Counter()
        self._skipped = 0
        self._step = Latencies()
        self._error = {arm.side: Latencies() for arm in self.robot.arms}

    def open(self) -> None:
        """Begin to send: the robot holds its rest posture until the start pose has been held."""
        if not self._ticks and self._thread is None:
            self._thread = threading.Thread(target=self._run, name="robot", daemon=True)
            self._thread.start()

    def start(self, stage: Stage) -> None:
        """Who moves is known; raises `BadData` where an arm has no sensors."""
        self._person = Person(self.robot, stage.segments, stage.points, self._lengths_cov)
        self.open()

    def show(self, pose: LivePose) -> None:
        """The newest pose: never waits, unless time is the ticks' own."""
        self._raise()
        if self._ticks:
            self._tick(pose)
        else:
            self._newest = (time.monotonic(), pose)

    def status(self, status: Status) -> None:  # noqa: ARG002
        """Only commands go out."""
        self._raise()

    def take_keys(self) -> list[str]:
        return []

    def resume(self) -> None:
        """After a stop: go on, by an approach."""
        self._resume = True

    def close(self) -> None:
        """Brake within the limits, say that the robot is stopped, and end. May be called twice."""
        if self._closed:
            return
        self._closing = self._closed = True
        if self._thread is not None:
            self._thread.join(PATIENCE_S)
        elif self._ticks and self._failure is None:
            self._finish()
        self._wire.close()

    def summary(self) -> Driven:
        posed = sum(self._states.values())
        return Driven(
            self.robot.map.name,
            0 if self.newest is None else self.newest.number + 1,
            self._skipped,
            self._wire.dropped,
            self.stream.held,
            {state: count / posed for state, count in self._states.most_common()},
            self._step,
            self._error,
        )

    # By this machine's clock -----------------------------------------------------------------------------------------

    def _run(self) -> None:
        due, dt, told = time.monotonic(), self.stream.dt, 0
        try:
            while told < LAST:
                time.sleep(max(0.0, due - time.monotonic()))
                late = int((time.monotonic() - due) / dt)
                self._skipped += late if self._taken is not None else 0  # before, the sources warm up
                due += (late + 1) * dt
                command = self._commanded(*self._now())
                told += self._closing and command.state == "stopped"
        except BaseException as error:  # a thread has nobody to tell: the loop raises it
            self._failure = error

    def _now(self) -> tuple[float, float]:
        """Take the newest pose; now [s] on the poses' clock, and since when there is none [s]."""
        self._asked()
        newest, wall = self._newest, time.monotonic()
        if newest is not None and newest[1] is not self._taken:
            came, self._taken = newest
            ahead = self._taken.time / self._speed - came
            if self._push(self._taken):
                self._came = came
                if abs(ahead - self._ahead) < NEW_CLOCK_S:
                    ahead = self._ahead + (ahead - self._ahead) * self.stream.dt / CLOCKS_S
                self._ahead = ahead
        return wall + self._ahead, wall - self._came

    # By the ticks' ---------------------------------------------------------------------------------------------------

    def _tick(self, pose: LivePose) -> None:
        """Commands that are due by the tick of `pose`."""
        self._asked()
        dt = self.stream.dt
        if not abs(pose.time - self._due) < PATIENCE_S:  # the first, or another clock
            self._due = self._came = pose.time
        while self._due < pose.time - 1e-3 * dt:
            self._commanded(self._due, self._due - self._came)
            self._due += dt
        if self._push(pose):
            self._came = pose.time
        if self._due < pose.time + 1e-3 * dt:
            self._commanded(self._due, max(0.0, self._due - self._came))
            self._due += dt

    def _finish(self) -> None:
        self._asked()
        told = 0
        for _ in range(int(PATIENCE_S / self.stream.dt)):
            told += self._commanded(self._due, 0.0).state == "stopped"
            if told == LAST:
                return

    # Either ----------------------------------------------------------------------------------------------------------

    def _asked(self) -> None:
        """Do what other threads want."""
        if self._closing:
            self.stream.end("the session has ended")
        if self._resume:
            self._resume = False
            self.stream.resume()

    def _push(self, pose: LivePose) -> bool:
        assert self._person is not None
        seen = self._person.look(pose.quat_WL, pose.points, pose.std, pose.lost)
        return self.stream.push(pose.time / self._speed, seen)

    def _commanded(self, now: float, age: float) -> Command:
        begin = time.perf_counter()
        command = self.stream.step(now, age)
        self._wire.send(command_json(self.robot, command, self._speed))
        self.newest = command
        if not math.isnan(command.time):
            self._step.add(time.perf_counter() - begin)
            self._states[command.state] += 1
        if command.state in ("follow", "slow"):
            for arm, error in zip(self.robot.arms, command.error[:, 0].tolist(), strict=True):
                self._error[arm.side].add(error)
        return command

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure


class Watched:
    """An `Output` that is another, with the robot's state in its message; its key "r" is told to the robot too."""

    def __init__(self, view: Output, robot: RobotOut) -> None:
        self._view, self._robot = view, robot

    def start(self, stage: Stage) -> None:
        self._view.start(stage)

    def show(self, pose: LivePose) -> None:
        self._view.show(pose)

    def status(self, status: Status) -> None:
        command = self._robot.newest
        if command is not None and status.state == "ready":
            told = f"{command.state} ({command.reason})" if command.reason else command.state
            how = "; r, in the start pose, goes on" if self._robot.stream.stopped else ""
            status = status._replace(message=f"{status.message} {self._robot.robot.map.name}: {told}{how}.")
        self._view.status(status)

    def take_keys(self) -> list[str]:
        keys = self._view.take_keys()
        if "r" in keys:
            self._robot.resume()
        return keys

    def close(self) -> None:
        self._view.close()


class TickReplay(ReplaySource):
    """A replay as fast as it is read, of which each read gives one tick: whoever follows it sees every pose."""

    def _due(self) -> int:
        return min(self._next + 1, len(self.recording))


def follower_of(
    robot: str,
    source: Source,
    setup: SensorSetup,
    *,
    arms: tuple[str, ...] | None = None,
    map_file: Path | None = None,
    to: str | None = None,
    speed: float = 1.0,
    rate_hz: float = 100.0,
    hold_after: float = HOLD_AFTER_S,
    stop_after: float = STOP_AFTER_S,
) -> tuple[RobotOut, Source]:
    """A robot by name or file that follows who wears the sensors, and the source as it needs it, not opened yet.

    Parameters
    ----------
    arms : sides; None: all that the robot has
    map_file : of a URDF in `robot` that has none beside it
    speed : of a replay; infinite: as fast as it is read
    rate_hz, hold_after, stop_after : as `CommandStream`

    Raises
    ------
    WeposeError
        What is wrong with robot, map or options; an arm without sensors.
    """
    if map_file is not None and Path(robot).suffix.lower() not in (".urdf", ".xml"):
        raise BadOption(f"--map {map_file}: --robot {robot} has its own; a map goes with a URDF")
    loaded = load(find_map(robot) if map_file is None else read_map(map_file, urdf=Path(robot)), arms)
    if source.sensors:
        needed(loaded, source.sensors)
    if isinstance(source, ReplaySource) and math.isinf(speed):
        source = TickReplay(source.recording, speed)
    lengths_cov = (setup.subject or average_subject()).lengths_covariance()
    stream = CommandStream(loaded, rate_hz=rate_hz, hold_after=hold_after, stop_after=stop_after)
    return RobotOut(stream, to or str(PORT), lengths_cov=lengths_cov, speed=speed), source


def command_json(robot: Robot, command: Command, speed: float = 1.0) -> bytes:
    """One command as a line of JSON; null for what is not known."""
    arms = {
        arm.side: {
            "error_mm": _known(1e3 * command.error[i, 0]),
            "error_deg": _known(math.degrees(command.error[i, 1])),
            "std_mm": _known(1e3 * command.std[i]),
        }
        for i, arm in enumerate(robot.arms)
    }
    message = {
        "format": FORMAT,
        "n": command.number,
        "clock": round(command.clock, DIGITS),
        "t": _known(command.time * speed, 6),
        "robot": robot.map.name,
        "state": command.state,
        "reason": command.reason,
        "joints": list(robot.names),
        "position": np.round(command.u, DIGITS).tolist(),
        "velocity": np.round(command.v, DIGITS).tolist(),
        "acceleration": np.round(command.a, DIGITS).tolist(),
        "arms": arms,
    }
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode("utf-8") + b"\n"


def _known(value: float, digits: int = 2) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None


class _Wire:
    """Datagrams to one receiver, now or never."""

    def __init__(self, to: str) -> None:
        host, _, port = to.rpartition(":")
        if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
            raise BadOption(f"--to {to}: a port or HOST:PORT, as {PORT} or 192.168.1.20:{PORT}")
        host = host.removeprefix("[").removesuffix("]") or LOOPBACK
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            raise BadOption(f"--to {to}: no host '{host}' ({error}); a name or an address, as 127.0.0.1") from None
        self._to: Any = address
        self._socket = socket.socket(family, kind)
        self._socket.setblocking(False)
        self.dropped = 0

    def send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self._to)
        except OSError:  # no room, nobody there, or no network for now
            self.dropped += 1

    def close(self) -> None:
        self._socket.close()
