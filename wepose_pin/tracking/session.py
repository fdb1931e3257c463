"""Sessions too long for memory: read, filtered and posed a chunk at a time.

The chunks of a causal filter together are bit-identical with the result of `track`. The smoother looks one chunk ahead.
The heading correction needs a pass over the recording beforehand, which stores a few numbers every two seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import BadOption
from ..filters import OFFLINE, chunk_multiple
from ..filters.noise import BEGINNING_S
from ..model import BodyModel
from ..readers.session import SessionReader
from ..recording import Recording
from ..subject import Subject
from .options import TrackOptions
from .tracked import TrackedRecording
from .tracker import track_chunks

CHUNK_S = 120.0
SMOOTHER_CHUNK_S = 600.0  # how far the smoother looks ahead
LARGE = 500_000_000  # bytes of a recording's files, above which it is better tracked in chunks
SHORTEST_S = 2.0  # of a chunk: a filter's first window has to fit


def track_session(
    session: str | Path | SessionReader,
    subject: Subject | None = None,
    *,
    seconds: float | None = None,
    gaps: bool = False,
    model: BodyModel | str | Path | None = None,
    options: TrackOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[TrackedRecording]:
    """Track a session file in chunks of `seconds`, None for `CHUNK_S`, of the smoother `SMOOTHER_CHUNK_S`.

    The first chunk includes the start pose and the static phase. Of a session in CSV or Parquet only the times are in
    memory as a whole. `progress` gets the name of the task and its share that is done, chunk by chunk. Other parameters
    as `Tracker` and `load_session`.

    Raises
    ------
    WeposeError
        As `load_session` and `Tracker`, at the chunk that it comes from.
    """
    options = options or TrackOptions()
    if seconds is None:
        seconds = SMOOTHER_CHUNK_S if options.method in OFFLINE else CHUNK_S
    if not seconds >= SHORTEST_S:
        raise BadOption(f"chunks of {seconds:g} s: they have at least {SHORTEST_S:g} s")
    reader = session if isinstance(session, SessionReader) else SessionReader(session, gaps=gaps, in_memory=False)
    multiple = chunk_multiple(options.method, reader.rate_hz)

    def share(task: str, chunk: Recording) -> None:
        if progress is not None:
            progress(task, float(np.searchsorted(reader.time, chunk.time[-1], side="right")) / len(reader.time))

    yield from track_chunks(
        lambda: _chunks(reader, seconds, multiple), subject, model=model, options=options, progress=share
    )


def _chunks(reader: SessionReader, seconds: float, multiple: int) -> Iterator[Recording]:
    """Chunks of a multiple of so many samples, with the phases of the whole; the last one is not too short."""
    time, rate_hz = reader.time, reader.rate_hz

    def samples(duration_s: float) -> int:
        return max(1, int(np.ceil(duration_s * rate_hz / multiple))) * multiple

    ends = [spans[0][1] for name, spans in reader.phases.items() if name in ("start", "static") and spans]
    first_s = max(seconds, max(ends or [time[0] + BEGINNING_S]) - time[0])
    first, size = 0, samples(first_s + 2.0 / rate_hz)
    while first < len(time):
        last = len(time) if len(time) - first < size + samples(SHORTEST_S) else first + size
        yield replace(reader.recording(first, last), phases=reader.phases)
        first, size = last, samples(seconds)
