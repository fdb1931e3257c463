"""What comes over a network or a cable while a session is live: datagrams, serial bytes, LSL, requests to the page."""

from __future__ import annotations

import atexit
import contextlib
import functools
import logging
import socket
from collections import deque
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .target import NotOneLine

TORSO_HEAD = ("torso", "head")
APART = b"\n\n"  # between datagrams


def datagram(_folder: Path, data: bytes) -> object:
    """The input is one datagram, decoded."""
    from wepose_pin.live.sources.clocks import HostClock
    from wepose_pin.live.sources.udp import decode

    batches, problems = decode(data)
    if not all(problem.isprintable() for problem in problems):
        raise NotOneLine(repr(problems)[:400])
    for batch in batches:
        assert batch.values.shape == (len(batch.time), 6)
        if np.abs(batch.time).max() < 1e10:  # as UdpSource takes them
            HostClock().to_host(batch.time, 100.0)
    return batches


@functools.cache
def _udp() -> tuple[Any, socket.socket]:
    from wepose_pin.live.sources.udp import UdpSource

    source = UdpSource("127.0.0.1", 0, sensors=TORSO_HEAD)
    source.open()
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    atexit.register(lambda: (source.close(), sender.close()))
    return source, sender


def udp(_folder: Path, data: bytes) -> object:
    """Datagrams that really come through a socket, to the samples that the loop gets."""
    source, sender = _udp()
    for part in data.split(APART)[:64]:
        sender.sendto(part[:60_000], source.address)
    came = source.read(0.02)
    _sound(came)
    if not all(problem.isprintable() for problem in source.problems):
        raise NotOneLine(repr(source.problems)[:400])
    assert len(source.problems) <= 30, source.problems
    return came


def _sound(came: list[Any]) -> None:
    """What sources hand on: finite, of the sensors that were asked for, shapes that fit."""
    for samples in came:
        n = len(samples.time)
        assert samples.sensor in TORSO_HEAD
        assert samples.gyro_S.shape == samples.accel_S.shape == (n, 3)
        for values in (samples.time, samples.gyro_S, samples.accel_S):
            assert np.isfinite(values).all()


def serial(_folder: Path, data: bytes) -> object:
    """Bytes of an MTi, decoded."""
    from wepose_pin.live.sources import mti

    buffer, half = bytearray(data[: len(data) // 2]), data[len(data) // 2 :]
    frames = mti.take_frames(buffer)[0]
    buffer += half
    return [mti.parse_packet(content) for _, content in frames + mti.take_frames(buffer)[0]]


def lsl(_folder: Path, data: bytes) -> object:
    """Labels and units of a stream's channels, a line each."""
    from wepose_pin.live.sources.lsl import find_channels

    stream, *rest = data.decode("utf-8", errors="replace").split("\n")
    labels, units = rest[::2], rest[1::2]
    return find_channels(stream, "imu", labels, units + [""] * len(labels), TORSO_HEAD)


SAMPLE = np.dtype([("which", "u1"), ("time", "<f8"), ("gyro", "<f4", 3), ("accel", "<f4", 3)])
STEP = 0.01  # [s] from read to read


class _Wild:
    """A source of two sensors: still for a second and a half, then whatever the input says, as far as it is sound."""

    sensors = TORSO_HEAD
    rate_hz: float | None = 100.0
    orientations: ClassVar[dict[str, bool]] = {}
    batteries: ClassVar[dict[str, float]] = {}

    def describe_awaited(self, sensors: object = ()) -> str:  # noqa: ARG002
        return ""

    def __init__(self, data: bytes) -> None:
        self.problems: dict[str, int] = {}
        self._rows = np.frombuffer(data[: len(data) // SAMPLE.itemsize * SAMPLE.itemsize], SAMPLE)
        self._at = 0

    def open(self) -> None: ...

    def close(self) -> None: ...

    def clock(self) -> float:
        return STEP * self._at

    def read(self, _timeout_s: float) -> list[Any] | None:
        from wepose_pin.live.sources.base import MAX_VALUES
        from wepose_pin.recording.arrivals import Samples

        self._at += 1
        if self._at <= 150:
            still = np.array([[STEP * self._at]]), np.zeros((1, 3)), np.array([[0.1, 0.0, 9.8]])
            return [Samples(name, still[0][0], *still[1:]) for name in self.sensors]
        k = self._at - 151
        if k >= len(self._rows):
            return None
        row = self._rows[k]
        time, values = np.array([float(row["time"])]), np.hstack([row["gyro"], row["accel"]])[None].astype(float)
        if not (np.abs(time[0]) < 1e10 and (np.abs(values) <= MAX_VALUES).all()):
            return []
        return [Samples(self.sensors[int(row["which"]) % 2], time, values[:, :3], values[:, 3:])]


def loop(folder: Path, data: bytes) -> object:
    """A live session with its recording; the recording then reads as what was shown."""
    from wepose_pin.live.loop import LiveLoop
    from wepose_pin.live.setup import SensorSetup
    from wepose_pin.readers import read_live_log
    from wepose_pin.writers.live_log import LiveLog

    file = folder / "a.mcap"
    file.unlink(missing_ok=True)
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    setup = SensorSetup(mounts=dict.fromkeys(TORSO_HEAD, upright), phases={"start": ((0.1, 1.2),)})
    log = LiveLog(file, setup.header(TORSO_HEAD) | {"method": "ncf"})
    with np.errstate(all="ignore"):
        ended = LiveLoop(_Wild(data[:8192]), setup, method="ncf", log=log, begin=STEP).run()
        again = read_live_log(file)
    assert not ended.problem
    assert len(again.quat_WL) == ended.poses
    assert np.isfinite(again.quat_WL).all()
    return ended


# The page ----------------------------------------------------------------------------------------------------------


class _Heard(logging.Handler):
    """What the web server's library says of errors in handlers."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.records: deque[str] = deque(maxlen=8)

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(self.format(record))


@functools.cache
def _page() -> tuple[Any, _Heard]:
    from wepose_pin.body import load_model
    from wepose_pin.live.page import LivePage

    heard = _Heard()
    for name in ("tornado", "asyncio"):
        logging.getLogger(name).addHandler(heard)
    page = LivePage(load_model())
    page.open()
    atexit.register(page.close)
    return page, heard


def page(_folder: Path, data: bytes) -> object:
    """Bytes to the page's port: it answers or hangs up, no handler of ours fails, and it serves the next one."""
    from wepose_pin.live.page import MAX_REQUESTS

    live, heard = _page()
    with contextlib.suppress(ConnectionError), _connected(live) as line:
        line.settimeout(0.005)
        line.sendall(data)
        line.shutdown(socket.SHUT_WR)
        with contextlib.suppress(TimeoutError):
            while line.recv(1 << 16):
                pass
    with _connected(live) as line:
        line.settimeout(10.0)
        line.sendall(b"GET /nothing HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert line.recv(64).startswith(b"HTTP/1.1 404"), "the page serves no more"
    asked = live.take_requests()
    assert len(asked) <= MAX_REQUESTS
    assert "quit" not in [request.action for request in asked]
    if heard.records:
        raise AssertionError("; ".join(heard.records))
    return asked


def _connected(live: Any) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(live.url.rstrip("/").rpartition(":")[2])), timeout=10.0)
