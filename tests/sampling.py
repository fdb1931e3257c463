"""What tests of sources share: a source that is connected, and the samples that come from it."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from wepose_pin.live.sources import Source, open_source
from wepose_pin.recording.arrivals import Samples

S = TypeVar("S", bound=Source)


@contextmanager
def connected(source: S | str, seconds: float = 60.0, **options: object) -> Iterator[S]:
    """A source, or that of a spec and its options, once all that it waits for is there; closed at the end."""
    if isinstance(source, str):
        source = open_source(source, **options)  # type: ignore[arg-type, assignment]
    try:
        source.open()
        deadline = time.monotonic() + seconds
        while not source.connect(0.1):
            assert time.monotonic() < deadline, source.describe_awaited()
        yield source
    finally:
        source.close()
        source.close()  # twice is no error


def collect(source: Source, count: int, sensors: int = 1, seconds: float = 60.0) -> dict[str, Samples]:
    """The samples of each sensor, joined, as soon as so many sensors have sent `count`, or what came until then."""
    parts: dict[str, list[Samples]] = {}
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if sum(sum(len(each.time) for each in own) >= count for own in parts.values()) >= sensors:
            break
        for samples in source.read(0.05) or ():
            parts.setdefault(samples.sensor, []).append(samples)
    return {
        name: Samples(name, *(np.concatenate(column) for column in tuple(zip(*own, strict=True))[1:]))
        for name, own in parts.items()
    }


def wait_until(happens: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait until something has happened in another thread or process."""
    deadline = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def find_free_port() -> int:
    """A UDP port of this machine that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
