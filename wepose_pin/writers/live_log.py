"""The recording of a live session, written as it comes (format: `readers.live_log`)."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import threading
import time
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import ExistingOutput
from ..readers.live_log import BLOCK, EVENT, FORMAT, HEAD, MAGIC, POSES, SAMPLES
from ..recording.arrivals import Arrivals

FLUSH_S = 0.25  # [s] what a kill may cost at most
FLUSH_SAMPLES = 4096  # or as many, of a replay that goes faster
SYNC_S = 1.0  # [s] what a power cut may cost at most


class LiveLog:
    """A file that holds all that was received, up to a quarter of a second before any end.

    A full disk ends the recording and not the session: `problem` holds the reason.

    Parameters
    ----------
    header : what is known before the first sample; `sensors` gives the order of columns

    Raises
    ------
    ExistingOutput
        The file is there and `force` is not given; it cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], force: bool = False) -> None:
        if path.exists() and not force:
            raise ExistingOutput(f"{path}: exists; --force replaces it, --record names another file")
        try:
            self._file: BinaryIO | None = path.open("wb")
        except OSError as error:
            raise ExistingOutput(f"{path}: cannot be written: {error.strerror}") from error
        self.path, self.problem = path, ""
        self._samples: list[Arrivals] = []
        self._poses: list[np.ndarray] = []
        self._first = self._waiting = 0
        self._flushed = time.monotonic()
        self._closing = threading.Event()
        self._write(MAGIC)
        self._block(HEAD, json.dumps({"format": FORMAT, **header}).encode())
        self.flush()
        self._syncer = threading.Thread(target=self._sync, name="sync of the recording", daemon=True)
        self._syncer.start()

    def samples(self, came: Arrivals) -> None:
        """What arrived, in the order of arrival."""
        self._samples.append(came)
        self._waiting += len(came.time)

    def pose(self, tick: int, quat_WL: np.ndarray) -> None:
        """The pose (k, 4) xyzw of a tick; ticks follow each other."""
        if not self._poses:
            self._first = tick
        self._poses.append(quat_WL.copy())

    def event(self, kind: str, **values: Any) -> None:
        """Something that decides the poses from here on."""
        self._put_samples()
        self._block(EVENT, json.dumps({"kind": kind, **values}).encode())

    def flush_if_due(self) -> None:
        """Write what waits, if it is much or has waited for long."""
        if (
            self._waiting >= FLUSH_SAMPLES
            or len(self._poses) >= FLUSH_SAMPLES
            or time.monotonic() - self._flushed > FLUSH_S
        ):
            self.flush()

    def flush(self) -> None:
        """Hand all to the system: a kill costs nothing of it."""
        self._flushed = time.monotonic()
        self._put_samples()
        if self._poses:
            quat = np.ascontiguousarray(self._poses, dtype="<f8")
            self._poses = []
            self._block(POSES, struct.pack("<QI", self._first, len(quat)) + quat.tobytes())
        if self._file is not None:
            try:
                self._file.flush()
            except OSError as error:
                self._give_up(error)

    def discard(self) -> None:
        """Close and remove the file: nothing in it can be tracked."""
        self.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def close(self) -> None:
        """Write the rest; may be called twice."""
        self.flush()
        self._closing.set()
        self._syncer.join()
        if self._file is not None:
            self._file.close()
            self._file = None

    def _put_samples(self) -> None:
        if not self._samples:
            return
        samples, self._samples, self._waiting = self._samples, [], 0
        which, *numbers = (np.concatenate(column) for column in zip(*samples, strict=True))
        parts = [which.astype("u1").tobytes(), *(part.astype("<f8").tobytes() for part in numbers)]
        payload = struct.pack("<I", len(which)) + b"".join(parts)
        self._block(SAMPLES, payload)

    def _block(self, tag: bytes, payload: bytes) -> None:
        self._write(BLOCK.pack(tag, len(payload), zlib.crc32(payload, zlib.crc32(tag))) + payload)

    def _write(self, data: bytes) -> None:
        if self._file is not None:
            try:
                self._file.write(data)
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.problem = f"{self.path}: the recording ended: {error.strerror}"
        file, self._file = self._file, None
        if file is not None:
            # What the buffer still holds cannot be written either.
            with contextlib.suppress(OSError):
                file.close()

    def _sync(self) -> None:
        """On a thread of its own: waiting for the disk would hold up the poses."""
        while not self._closing.wait(SYNC_S):
            file = self._file
            if file is None:
                return
            try:
                os.fsync(file.fileno())
            except (OSError, ValueError):
                return
