"""The live pose for other programs, as JSON over UDP or a stream of the Lab Streaming Layer, and for a robot.

See docs/live-outputs.md. A robot gets commands at a constant rate, JSON over UDP.
"""

import json
import math
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..body import BodyTable, load_table
from ..body.subject import Subject, population_subject
from ..diagnostics import WARNING, Diagnostic
from ..documents import Finite, TomlTable, read_toml
from ..errors import BadOption, WrongOption
from ..retargeting import Robot, load_robot
from ..retargeting.maps import list_sides
from ..retargeting.stream import ArmObserver, Command, CommandStream
from ..retargeting.targets import check_person_arms
from ..writers.result import as_json
from .loop import MAX_LATENCIES
from .sources.lsl import configure_pylsl
from .sources.udp import parse_address
from .state import LivePose, Output, Status, StreamInfo

FORMAT = 1  # of poses and of commands
PORT = 9001  # in examples
RATE_HZ = 100.0
DIGITS = 6  # after the point: micrometres, and less than an arc second
BUFFER_S = 1  # [s] of an LSL stream that liblsl keeps for a slow receiver
# Commands for a robot.
ROBOT_PORT = 9002
COMMAND_DIGITS = 9  # after the point: third differences of rounded positions still keep the limits
LAST_COMMANDS = 3  # commands that report the end: a datagram may be lost
CLOCK_S = 0.5  # [s] over which the offset of the poses' clock is averaged
CLOCK_JUMP_S = 0.25  # [s] of that offset, from which on the clock is a new one
PATIENCE_S = 10.0  # [s] for which the end waits until the robot is at rest


def find_next_time(due: float, time: float) -> float:
    """Time [s] of the next pose to send, after that at `time` which was `due`: `RATE_HZ` on average, by their time."""
    return max(due, time - 1.0 / RATE_HZ) + 1.0 / RATE_HZ - 1e-6


class UdpSender:
    """Sends datagrams to one receiver, ``PORT`` of this machine or ``HOST:PORT``, without ever waiting.

    Raises `BadOption` where there is no such host or port, which names the `option` and an `example_port`.
    """

    def __init__(self, to: str, option: str, example_port: int) -> None:
        host, port = parse_address(to, option, example_port)
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            raise BadOption(f"{option} {to}: no host '{host}' ({error}); a name or an address, as 127.0.0.1") from None
        self._address: Any = address
        self._socket = socket.socket(family, kind)
        self._socket.setblocking(False)
        self.dropped = 0  # datagrams that the system did not take at once; they are not sent again

    def send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self._address)
        except OSError:  # BlockingIOError: no room; else no receiver, no network for now, or it is closed
            self.dropped += 1

    def close(self) -> None:
        self._socket.close()


class UdpOutput(Output):
    """Sends each pose as JSON in a datagram of its own, `RATE_HZ` a second at most; parameter as of `UdpSender`."""

    def __init__(self, to: str) -> None:
        self._sender, self._due = UdpSender(to, "--output udp:", PORT), -np.inf
        self._info: StreamInfo | None = None

    def start(self, info: StreamInfo) -> None:
        self._info = info

    def show(self, pose: LivePose) -> None:
        if self._info is not None and pose.time >= self._due:
            self._due = find_next_time(self._due, pose.time)
            self._sender.send(pose_json(self._info, pose))

    def close(self) -> None:
        self._sender.close()


def pose_json(info: StreamInfo, pose: LivePose) -> bytes:
    """One pose as a line of JSON; null for what is not known."""
    quat, points, std = (_rounded_rows(values) for values in (pose.quat_WL, pose.points, pose.std))
    message = {
        "format": FORMAT,
        "t": round(float(pose.time), DIGITS),
        "segments": dict(zip(info.segments, quat, strict=True)),
        "points": dict(zip(info.points, points, strict=True)),
        "std": dict(zip(info.segments, std, strict=True)),
        "lost": [name for name, lost in zip(info.segments, pose.lost, strict=True) if lost],
    }
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode("ascii") + b"\n"


def _rounded_rows(values: np.ndarray) -> list[Any]:
    """Rows as lists of numbers; None for one that is not finite."""
    rows = np.round(values, DIGITS)
    unknown = set(np.argwhere(~np.isfinite(rows))[:, 0].tolist())
    return [None if k in unknown else row for k, row in enumerate(rows.tolist())]


class LslOutput(Output):
    """Sends the pose as one LSL stream `name` of type "Pose", `RATE_HZ` a second at most.

    It is announced on this machine only, or as far as the user's own ``LSLAPICFG`` says where that is set. liblsl has
    no setting for the address of its data ports: they listen on every interface for as long as the stream exists.
    Raises `WeposeError` where pylsl is missing, or the name is empty.
    """

    def __init__(self, name: str = "WeposePose") -> None:
        if not name:
            raise BadOption("LSL out: a stream needs a name, as WeposePose")
        self._name, self._due, self._lsl = name, -np.inf, configure_pylsl()
        self._outlet: Any = None

    def start(self, info: StreamInfo) -> None:
        channels = list_channels(info)
        rate = min(info.rate_hz, RATE_HZ)
        stream = self._lsl.StreamInfo(
            self._name, "Pose", len(channels), rate, self._lsl.cf_float32, f"wepose-pin {self._name}"
        )
        description = stream.desc().append_child("channels")
        for label, unit in channels:
            channel = description.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
        self._outlet = self._lsl.StreamOutlet(stream, max_buffered=BUFFER_S)

    def show(self, pose: LivePose) -> None:
        if self._outlet is None or pose.time < self._due:
            return
        self._due = find_next_time(self._due, pose.time)
        rows = np.column_stack([pose.quat_WL, pose.std, pose.lost]).ravel()
        stamp = self._lsl.local_clock() - (pose.latency if np.isfinite(pose.latency) else 0.0)
        self._outlet.push_sample([*rows.tolist(), *pose.points.ravel().tolist()], stamp)

    def close(self) -> None:
        self._outlet = None


def list_channels(info: StreamInfo) -> list[tuple[str, str]]:
    """Label and unit of each channel of the LSL stream."""
    parts = (("qx", ""), ("qy", ""), ("qz", ""), ("qw", ""), ("std", "rad"), ("lost", ""))
    channels = [(f"{segment}_{part}", unit) for segment in info.segments for part, unit in parts]
    return channels + [(f"{point}_{axis}", "m") for point in info.points for axis in "xyz"]


class RobotOutput(Output):
    """Sends the robot's commands, each as JSON in a datagram of its own.

    A thread of its own makes them at the stream's rate, by this machine's clock: the loop never waits for the solver,
    and the robot stops also when the loop hangs.

    Parameters
    ----------
    to : ``PORT`` of this machine, or ``HOST:PORT``
    sensors : of the person, if they are known; `WeposeError` is raised where an arm has none, else by `status`
    subject, table : whose arms move, None: the population prior's; the body, None: the upper body
    speed : of a replay

    Attributes
    ----------
    newest : the newest command; None before the first
    states : state → number of commands that had a pose
    skipped : commands that were due while one took too long
    errors : side → distances [m] of the hand from its target while it followed, of the newest commands
    """

    def __init__(
        self,
        stream: CommandStream,
        to: str = str(ROBOT_PORT),
        sensors: Sequence[str] = (),
        subject: Subject | None = None,
        table: BodyTable | None = None,
        speed: float = 1.0,
    ) -> None:
        if math.isinf(speed):
            raise BadOption("--speed max: a robot follows a replay at its own speed, or a multiple of it")
        if sensors:
            check_person_arms(stream.robot, sensors, table=table)
        self.stream, self.robot, self._table, self._speed = stream, stream.robot, table, speed
        person, lengths = subject or population_subject(body=table), (table or load_table()).lengths
        self._lengths_cov = person.lengths_covariance(lengths)
        self._sender = UdpSender(to, "to =", ROBOT_PORT)
        self._observer: ArmObserver | None = None
        self._newest: tuple[float, LivePose] | None = None  # with its time of arrival [s]
        self._taken: LivePose | None = None
        self._came = 0.0  # [s] when the newest sound pose came
        self._clock_offset = math.nan  # [s] from this machine's clock to the poses'
        self._resume = self._closing = False
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None
        self.newest: Command | None = None
        self.states: Counter[str] = Counter()
        self.skipped = 0
        self.errors: dict[str, deque[float]] = {arm.side: deque(maxlen=MAX_LATENCIES) for arm in self.robot.arms}

    def open(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="robot", daemon=True)
            self._thread.start()

    def start(self, info: StreamInfo) -> None:
        self._observer = ArmObserver(self.robot, info.segments, info.points, self._lengths_cov, table=self._table)
        self.open()

    def show(self, pose: LivePose) -> None:
        self._newest = time.monotonic(), pose

    def status(self, status: Status) -> None:
        self.open()  # it holds from before the start pose
        if status.sensors and self._observer is None and status.state != "ended":  # of a source that had to find them
            check_person_arms(self.robot, [each.segment for each in status.sensors], table=self._table)
        if self._failure is not None:
            raise self._failure

    def describe(self) -> str:
        command = self.newest
        if command is None:
            return ""
        state = f"{command.state} ({command.reason})" if command.reason else command.state
        hint = "; r, in the start pose, goes on" if self.stream.stopped else ""
        return f"{self.robot.map.name}: {state}{hint}."

    def resume(self) -> None:
        self._resume = True

    def close(self) -> None:
        """Brake within the limits, report that the robot is stopped, and end. May be called twice."""
        self._closing = True
        if self._thread is not None:
            self._thread.join(PATIENCE_S)
        self._sender.close()

    @property
    def diagnostics(self) -> list[Diagnostic]:
        """Commands that did not reach the robot, steps in which it braked to stay clear of itself."""
        name = self.robot.map.name
        diagnostics = [
            Diagnostic("robot-commands-lost", WARNING, name, self.skipped),
            Diagnostic("robot-stopped-for-clearance", WARNING, name, self.stream.stopping),
            Diagnostic("robot-commands-lost", WARNING, name, self._sender.dropped, facts={"variant": "unsent"}),
        ]
        return [diagnostic for diagnostic in diagnostics if diagnostic.value]

    # In the thread ---------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        due, dt, reported = time.monotonic(), self.stream.dt, 0
        try:
            while reported < LAST_COMMANDS:
                time.sleep(max(0.0, due - time.monotonic()))
                late = int((time.monotonic() - due) / dt)
                self.skipped += late if self._taken is not None else 0  # before, the sources warm up
                due += (late + 1) * dt
                if self._closing:
                    self.stream.end("the session has ended")
                if self._resume:
                    self._resume = False
                    self.stream.resume()
                command = self._send_command()
                reported += self._closing and command.state == "stopped"
        except BaseException as error:  # the loop raises it
            self._failure = error

    def _send_command(self) -> Command:
        newest, begin = self._newest, time.monotonic()
        if newest is not None and newest[1] is not self._taken and self._observer is not None:
            came, self._taken = newest
            pose = self._taken
            observed = self._observer.observe(pose.quat_WL, pose.points, pose.std, pose.lost)
            offset = pose.time / self._speed - came
            if self.stream.push(pose.time / self._speed, observed):
                self._came = came
                if abs(offset - self._clock_offset) < CLOCK_JUMP_S:
                    offset = self._clock_offset + (offset - self._clock_offset) * self.stream.dt / CLOCK_S
                self._clock_offset = offset
        command = self.stream.step(begin + self._clock_offset, begin - self._came)
        self.newest = command
        if not math.isnan(command.time):
            self.states[command.state] += 1
        if command.state in ("follow", "slow"):
            for arm, error in zip(self.robot.arms, command.error[:, 0].tolist(), strict=True):
                self.errors[arm.side].append(error)
        self._sender.send(command_json(self.robot, command, self._speed))  # whoever gets it finds all this described
        return command


MARGINS, TIMING = ("speed_scale", "limit_margin"), ("rate_hz", "hold_after", "stop_after")


def read_robot(name: str) -> tuple[CommandStream, str]:
    """Commands for the robot that ``--robot`` names, and their receiver, as of `RobotOutput`; raises `WeposeError`.

    `name` is as of `find_map`, or a TOML file whose key `robot` is such a name and whose other keys say the rest.
    """
    file = Path(name)
    values = read_toml(file, "a robot", BadOption) if file.suffix == ".toml" and file.is_file() else {}
    if "robot" not in values:
        return CommandStream(load_robot(name)), str(ROBOT_PORT)
    keys = TomlTable(values, name, error=BadOption)
    keys.allow("robot", "arm", "to", *MARGINS, *TIMING)
    robot = str(keys.text("robot", None))
    neighbour = file.parent / robot
    margins, timing = (
        {key: float(keys.get(key, None, Finite)) for key in names if key in keys} for names in (MARGINS, TIMING)
    )
    sides = list_sides(keys.choice("arm", ("left", "right", "both"))) if "arm" in keys else None
    try:
        chosen = load_robot(str(neighbour) if neighbour.is_file() else robot, sides, **margins)
        return CommandStream(chosen, **timing), str(values.get("to", ROBOT_PORT))
    except WrongOption as error:
        raise BadOption(f"{name}: {error.name} = {error.value}: {error.needed}") from None


def command_json(robot: Robot, command: Command, speed: float = 1.0) -> bytes:
    """One command as a line of JSON; null for what is not known."""
    arms = {
        arm.side: {
            "error_mm": as_json(1e3 * command.error[i, 0], 2),
            "error_deg": as_json(math.degrees(command.error[i, 1]), 2),
            "std_mm": as_json(1e3 * command.std[i], 2),
        }
        for i, arm in enumerate(robot.arms)
    }
    message = {
        "format": FORMAT,
        "n": command.number,
        "clock": round(command.clock, COMMAND_DIGITS),
        "t": as_json(command.time * speed, 6),
        "robot": robot.map.name,
        "state": command.state,
        "reason": command.reason,
        "joints": list(robot.names),
        "position": np.round(command.u, COMMAND_DIGITS).tolist(),
        "velocity": np.round(command.v, COMMAND_DIGITS).tolist(),
        "acceleration": np.round(command.a, COMMAND_DIGITS).tolist(),
        "arms": arms,
    }
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode("utf-8") + b"\n"
