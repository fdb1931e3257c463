"""The live pose for other programs: UDP with JSON, and a stream of the Lab Streaming Layer. See docs/live-page.md."""

from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np

from ..errors import BadOption
from .state import LivePose, Stage, Status

LOOPBACK = "127.0.0.1"
FORMAT = 1
RATE_HZ = 100.0
DIGITS = 6  # after the point: micrometres, and less than an arc second
BUFFER_S = 1  # what liblsl keeps of an LSL stream for who is slow [s]


class Pace:
    """Which poses go out, so that on average no more than `rate_hz` a second do; None: all.

    Counted on the poses' own time: a replay at ten times its speed sends ten times as many.
    """

    def __init__(self, rate_hz: float | None) -> None:
        if rate_hz is not None and not rate_hz > 0.0:
            raise BadOption(f"rate: {rate_hz:g} poses a second; a positive number, or none for every pose")
        self._step = 0.0 if rate_hz is None else 1.0 / rate_hz
        self._due = -np.inf

    def takes(self, time: float) -> bool:
        if self._step == 0.0:
            return True
        if self._due - 2.0 * self._step < time < self._due - 1e-6:
            return False
        on_time = 0.0 <= time - self._due + 1e-6 < self._step
        self._due = (self._due if on_time else time) + self._step
        return True


class UdpOut:
    """An `Output`: each pose as JSON in a datagram of its own.

    Parameters
    ----------
    host, port : whom to send to
    rate_hz : at most so many poses a second; None: every pose

    Attributes
    ----------
    dropped : poses that the system would not take at once; they are not sent again

    Raises
    ------
    BadOption
        No such host, or no such port.
    """

    def __init__(self, host: str, port: int, rate_hz: float | None = RATE_HZ) -> None:
        self._pace = Pace(rate_hz)
        if not 0 < port < 65536:
            raise BadOption(f"UDP out: port {port}; a number from 1 to 65535")
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            raise BadOption(f"UDP out: no host '{host}' ({error}); a name or an address, as 127.0.0.1") from None
        self._to: Any = address
        self._socket: socket.socket | None = socket.socket(family, kind)
        self._socket.setblocking(False)
        self._stage: Stage | None = None
        self.dropped = 0

    def start(self, stage: Stage) -> None:
        self._stage = stage

    def show(self, pose: LivePose) -> None:
        """Send it now or never; never waits."""
        if self._stage is None or self._socket is None or not self._pace.takes(pose.time):
            return
        try:
            self._socket.sendto(pose_json(self._stage, pose), self._to)
        except OSError:  # BlockingIOError: no room; else no network for now
            self.dropped += 1

    def status(self, status: Status) -> None:
        """Only poses go out."""

    def take_keys(self) -> list[str]:
        return []

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def udp_out(to: str, rate_hz: float | None = RATE_HZ) -> UdpOut:
    """To ``PORT`` of this machine, or ``HOST:PORT``.

    Raises
    ------
    BadOption
        It is neither.
    """
    host, _, port = to.rpartition(":")
    if not (port.isascii() and port.isdigit()):
        raise BadOption(f"UDP out: '{to}'; a port or HOST:PORT, as 9001 or 192.168.1.20:9001")
    return UdpOut(host.removeprefix("[").removesuffix("]") or LOOPBACK, int(port), rate_hz)


def pose_json(stage: Stage, pose: LivePose) -> bytes:
    """One pose as a line of JSON; null for what is not known."""
    quat, points, std = (_rounded(values) for values in (pose.quat_WL, pose.points, pose.std))
    message = {
        "format": FORMAT,
        "t": round(float(pose.time), DIGITS),
        "segments": dict(zip(stage.segments, quat, strict=True)),
        "points": dict(zip(stage.points, points, strict=True)),
        "std": dict(zip(stage.segments, std, strict=True)),
        "lost": [name for name, lost in zip(stage.segments, pose.lost, strict=True) if lost],
    }
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode("ascii") + b"\n"


def _rounded(values: np.ndarray) -> list[Any]:
    """Rows as lists of numbers; None for one that is not finite."""
    rows = np.round(values, DIGITS)
    unknown = set(np.argwhere(~np.isfinite(rows))[:, 0].tolist())
    return [None if k in unknown else row for k, row in enumerate(rows.tolist())]


class LslOut:
    """An `Output`: the pose as one LSL stream of type "Pose" that other programs find by its name.

    It is announced on this machine only, or as far as the user's own ``LSLAPICFG`` says where that is set. liblsl has
    no setting for the address of its data ports: they listen on every interface for as long as the stream is there.

    Parameters
    ----------
    name : of the stream
    rate_hz : at most so many poses a second; None: every pose

    Raises
    ------
    WeposeError
        pylsl is missing, or looks further already.
    """

    def __init__(self, name: str = "WeposePose", rate_hz: float | None = RATE_HZ) -> None:
        from .sources.lsl import pylsl_within

        if not name:
            raise BadOption("LSL out: a stream needs a name, as WeposePose")
        self._name, self._rate, self._pace = name, rate_hz, Pace(rate_hz)
        self._lsl, _ = pylsl_within(None)
        self._outlet: Any = None

    def start(self, stage: Stage) -> None:
        """Announce the stream, with a label for each channel."""
        channels = channels_of(stage)
        rate = stage.rate_hz if self._rate is None else min(stage.rate_hz, self._rate)
        info = self._lsl.StreamInfo(
            self._name, "Pose", len(channels), rate, self._lsl.cf_float32, f"wepose-pin {self._name}"
        )
        described = info.desc().append_child("channels")
        for label, unit in channels:
            channel = described.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
        self._outlet = self._lsl.StreamOutlet(info, max_buffered=BUFFER_S)

    def show(self, pose: LivePose) -> None:
        """Hand it to liblsl, which sends from a thread of its own; stamped with the time of its newest sample."""
        if self._outlet is None or not self._pace.takes(pose.time):
            return
        rows = np.column_stack([pose.quat_WL, pose.std, pose.lost]).ravel()
        stamp = self._lsl.local_clock() - (pose.latency if np.isfinite(pose.latency) else 0.0)
        self._outlet.push_sample([*rows.tolist(), *pose.points.ravel().tolist()], stamp)

    def status(self, status: Status) -> None:
        """Only poses go out."""

    def take_keys(self) -> list[str]:
        return []

    def close(self) -> None:
        """The stream is gone."""
        self._outlet = None


def channels_of(stage: Stage) -> list[tuple[str, str]]:
    """Label and unit of each channel of the LSL stream."""
    of_segment = (("qx", ""), ("qy", ""), ("qz", ""), ("qw", ""), ("std", "rad"), ("lost", ""))
    channels = [(f"{segment}_{part}", unit) for segment in stage.segments for part, unit in of_segment]
    return channels + [(f"{point}_{axis}", "m") for point in stage.points for axis in "xyz"]
