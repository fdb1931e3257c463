"""The live pose for other programs: JSON over UDP, a stream of the Lab Streaming Layer (docs/live-outputs.md)."""

from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np

from ..errors import BadOption
from .sources.lsl import configure_pylsl
from .sources.udp import parse_address
from .state import LivePose, Output, StreamInfo

FORMAT = 1
PORT = 9001  # in examples
RATE_HZ = 100.0
DIGITS = 6  # after the point: micrometres, and less than an arc second
BUFFER_S = 1  # [s] of an LSL stream that liblsl keeps for a slow receiver


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
