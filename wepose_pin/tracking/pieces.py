"""Recordings too long for memory: read, filtered and posed a piece at a time.

Put together, the pieces of a causal filter are what `track` gives of the whole, to the bit: filters and kinematics go
on from where they stood. The smoother looks one piece ahead. Headings that are held together take a first pass over
the recording, of which little is kept: a few numbers every two seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..alignment import (
    Alignment,
    Segments,
    SensorFilters,
    align,
    filtered_piece,
    need_mounts,
    oriented_segments,
)
from ..errors import BadOption
from ..filters import BEST, OFFLINE, Orientation, check_method, piece_multiple
from ..model import BodyModel
from ..noise import BEGINNING_S
from ..pose import Poser
from ..readers.session import SessionReader
from ..recording import CONFIGURATION, Intervals, Recording
from ..static import StaticTest
from ..subject import Subject
from .headings import HeadingHold
from .tracked import TrackedPose, posed, who_and_body

PIECE_S = 120.0
AHEAD_S = 600.0  # a piece of the smoother, and how far it looks ahead
LARGE = 500_000_000  # bytes of a recording's files from which on it is better tracked in pieces
SHORTEST_S = 2.0  # of a piece: a filter's first window has to fit


def track_pieces(
    session: str | Path | SessionReader,
    subject: Subject | None = None,
    *,
    seconds: float | None = None,
    gaps: bool = False,
    method: str = BEST,
    model: BodyModel | None = None,
    static_test: StaticTest | None = None,
    hold_headings: bool = True,
    limits: bool = True,
    told: Callable[[str, float], None] | None = None,
) -> Iterator[TrackedPose]:
    """`track` of a session, in pieces of `seconds` (None: `PIECE_S`); each has the part of the recording that it is of.

    The first is as long as it takes to have the start pose, and still phase, in it. Of a session in CSV or Parquet
    only the times are held as a whole. `told` hears what is done and which share of it, piece by piece. Other
    parameters as `track`, and `load_session`.

    Raises
    ------
    WeposeError
        As `load_session` and `track`, at the piece that it comes from.
    """
    check_method(method)
    if seconds is None:
        seconds = AHEAD_S if method in OFFLINE else PIECE_S
    if not seconds >= SHORTEST_S:
        raise BadOption(f"pieces of {seconds:g} s: they have at least {SHORTEST_S:g} s")
    pieces = _Pieces(session, seconds, gaps)
    if pieces.reader.start_pose == CONFIGURATION:
        raise BadOption(f'{pieces.reader.path}: start_pose = "{CONFIGURATION}" is that of a chain, which has no pieces')

    def oriented(what: str) -> Iterator[tuple[Recording, Segments]]:
        done, samples = 0, len(pieces.reader.time)
        for piece, segments in _oriented(pieces, subject, method, static_test):
            yield piece, segments
            done += len(piece)
            if told is not None:
                told(what, done / samples)

    hold = None
    if hold_headings and subject is not None and subject.mounts and not pieces.new_mounts():
        hold = _looked(oriented("looking at headings"), pieces.reader.phases.get("clasp", ()), subject)
    who, body = who_and_body(subject, model)
    poser = None
    for piece, segments in oriented(f"tracking by {method}"):
        if hold is not None:
            segments = hold.apply(piece, segments)
        poser = poser or Poser(body, segments.quat_WL, limits=limits)
        yield posed(poser, piece, segments, who, body, method=method, reset=hold.reset() if hold is not None else None)


class _Pieces:
    """The pieces of a session, as often as they are wanted."""

    def __init__(self, session: str | Path | SessionReader, seconds: float, gaps: bool) -> None:
        if not isinstance(session, SessionReader):
            session = SessionReader(session, gaps=gaps, in_memory=False)
        self.reader = session
        time, phases = self.reader.time, self.reader.phases
        ends = [spans[0][1] for name, spans in phases.items() if name in ("start", "still") and spans]
        self._seconds = seconds
        self._first_s = max(seconds, max(ends or [time[0] + BEGINNING_S]) - time[0])

    def new_mounts(self) -> bool:
        """Whether sensors sit otherwise than a calibration found them."""
        return self.reader.remounted or self.reader.any_aligned

    def of(self, multiple: int) -> Iterator[Recording]:
        """Pieces of a multiple of so many samples; none at the end that is too short to be one."""
        n, rate_hz = len(self.reader.time), self.reader.rate_hz

        def samples(seconds: float) -> int:
            return max(1, int(np.ceil(seconds * rate_hz / multiple))) * multiple

        first, size = 0, samples(self._first_s + 2.0 / rate_hz)
        while first < n:
            last = n if n - first < size + samples(SHORTEST_S) else first + size
            yield self.reader.recording(first, last)
            first, size = last, samples(self._seconds)


def _oriented(
    pieces: _Pieces, subject: Subject | None, method: str, static_test: StaticTest | None
) -> Iterator[tuple[Recording, Segments]]:
    """Every piece with its segments."""
    filters: SensorFilters | None = None
    alignment: Alignment | None = None

    def segments_of(piece: Recording, orientation: Mapping[str, Orientation]) -> tuple[Recording, Segments]:
        nonlocal alignment
        assert filters is not None
        if alignment is None:
            alignment = align(piece, subject, filtered_piece(filters, piece, orientation))
        return piece, oriented_segments(piece, alignment, orientation, subject)

    for piece in pieces.of(piece_multiple(method, pieces.reader.rate_hz)):
        if filters is None:
            need_mounts(piece, subject)
            first = replace(piece, phases=pieces.reader.phases)
            filters = SensorFilters(first, method=method, static_test=static_test)
        if (done := filters.push(piece)) is not None:
            yield segments_of(*done)
    if filters is not None and filters.ahead:
        yield segments_of(*filters.finish())


def _looked(pieces: Iterator[tuple[Recording, Segments]], clasp: Intervals, subject: Subject) -> HeadingHold | None:
    """What holds the headings of a recording together, after a pass over it; None where nothing does."""
    hold = None
    for piece, segments in pieces:
        if hold is None:
            hold = HeadingHold(piece, segments.quat_WL, segments.start[1], subject, clasp)
            if not hold.has_chain or not hold.can_see:
                return None
        hold.look(piece, segments)
    return hold if hold is not None and hold.solve() else None
