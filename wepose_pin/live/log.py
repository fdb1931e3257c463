"""The recording of a live session, written as it comes (format: `readers.live_log`)."""

import contextlib
import io
import json
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.writer import Writer

from ..errors import ExistingOutput
from ..readers.live_log import EVENTS, FORMAT, HEADER, POSES, PROFILE, SENSORS
from ..recording.arrivals import Arrivals

FLUSH_S = 0.25  # [s] what a kill may cost at most
CHUNK_BYTES = 1 << 16  # or as much, of a replay that goes faster
LATEST_S = 1e10  # [s] of the clock of messages
_encode = json.JSONEncoder(separators=(",", ":")).encode


def check_absent(path: Path, force: bool) -> None:
    """Raise `ExistingOutput` where a file is there that must not be replaced, or none can be written."""
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ExistingOutput(f"{path}: cannot be written; --record names another file")
    if path.exists() and not force:
        raise ExistingOutput(f"{path}: exists; --force replaces it, --record names another file")


class LiveLog:
    """A file that holds all that was received, up to a quarter of a second before any end.

    A full disk ends the recording and not the session: `problem` holds the reason. The header is what is known before
    the first sample; its `sensors` give the order of columns. Without a `path` nothing is written. `ExistingOutput` is
    raised where the file is there and `force` is not given, or it cannot be written.
    """

    def __init__(self, path: Path | None, header: Mapping[str, Any], force: bool = False) -> None:
        self._file: BinaryIO | None = None
        if path is not None:
            check_absent(path, force)
            self._file = path.open("wb")
        self.path, self.problem = path, ""
        self._sensors = list(header["sensors"])
        self._measured = [name in header["orientations"] for name in self._sensors]
        self._time_ns = 0  # of the newest sample
        self._flushed = time.monotonic()
        # Of a disk that is full before they are known.
        self._channels, self._poses, self._events = [0] * len(self._sensors), 0, 0
        self._writer: Any = Writer(self._file or io.BytesIO(), CHUNK_BYTES)
        self._write(lambda: self._begin(header))

    def samples(self, came: Arrivals) -> None:
        """What arrived, in the order of arrival."""
        rows = zip(came.which.tolist(), came.rows.tolist(), strict=True) if self._file is not None else ()
        for sensor, (time_s, *values) in rows:
            is_orientation, gyro, accel = self._measured[sensor], values[:3], values[3:]
            signals = {"orientation": values[:4]} if is_orientation else {"gyro": gyro, "accel": accel}
            if math.isfinite(time_s):
                self._time_ns = int(1e9 * min(max(time_s, 0.0), LATEST_S))
            self._put(self._channels[sensor], {"t": time_s, **signals})

    def pose(self, tick: int, quat_WL: np.ndarray) -> None:
        """The pose (k, 4) xyzw of a tick; ticks follow each other."""
        self._put(self._poses, {"tick": tick, "quat_WL": dict(zip(self._sensors, quat_WL.tolist(), strict=True))})

    def event(self, kind: str, **values: Any) -> None:
        """Something that decides the poses from here on."""
        self._put(self._events, {"kind": kind, **values})

    def flush_if_due(self) -> None:
        """Write what waits, if it has waited for long."""
        if time.monotonic() - self._flushed > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Hand all to the system: a kill costs nothing of it."""
        self._flushed = time.monotonic()
        self._write(self._writer.flush)

    def close(self) -> None:
        """Write the rest; may be called twice."""
        self._write(self._writer.finish)
        if self._file is not None:
            self._write(self._file.close)
            self._file = None

    def _begin(self, header: Mapping[str, Any]) -> None:
        self._writer.start(PROFILE, "wepose-pin")
        self._writer.add_metadata(HEADER, {"json": json.dumps({"format": FORMAT, **header})})
        schemas = {
            name: self._writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            for name, schema in json.loads(Path(__file__).with_suffix(".json").read_text()).items()
        }
        self._channels = [
            self._writer.register_channel(SENSORS + name, "json", schemas["orientation" if measured else "sample"])
            for name, measured in zip(self._sensors, self._measured, strict=True)
        ]
        self._poses = self._writer.register_channel(POSES, "json", schemas["pose"])
        self._events = self._writer.register_channel(EVENTS, "json", schemas["event"])
        self._writer.flush()

    def _put(self, channel: int, message: Mapping[str, Any]) -> None:
        if self._file is not None:
            data = _encode(message).encode()
            self._write(lambda: self._writer.add_message(channel, self._time_ns, data, self._time_ns))

    def _write(self, write: Callable[[], None]) -> None:
        """Write, unless the recording has ended; it ends where that fails."""
        if self._file is not None:
            try:
                write()
            except OSError as error:
                self.problem = f"{self.path}: the recording ended: {error.strerror}"
                with contextlib.suppress(OSError):  # what the buffer still holds cannot be written either
                    self._file.close()
                self._file = None
