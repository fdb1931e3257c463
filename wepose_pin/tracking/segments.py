"""Recording → orientation of each segment, chunk by chunk: filter, then align by the start pose."""

from __future__ import annotations

from ..alignment import (
    N_POSE,
    SegmentOrientations,
    SensorAlignment,
    StartFrames,
    align_sensors,
    check_mounts,
    count_lost_samples,
    orient_segments,
)
from ..filters import BEST
from ..filters.sensors import SensorFilters, combine_chunk
from ..filters.static import StaticTest
from ..recording import OrientationSensor, Recording
from ..subject import Subject

Oriented = tuple[Recording, SegmentOrientations]


class SegmentEstimator:
    """Orientation of each segment of a recording that comes in chunks.

    The chunks together are bit-identical with one chunk; the smoother takes the whole recording as one. The phases
    `start` and `static` are in the first chunk.

    Parameters
    ----------
    subject : its calibrated mounts go before those that the session states; None for the stated ones
    start_frames : of the body; left out: the N-pose
    """

    def __init__(
        self,
        subject: Subject | None = None,
        *,
        start_frames: StartFrames = N_POSE,
        method: str = BEST,
        static_test: StaticTest | None = None,
    ) -> None:
        self._subject, self._start_frames, self._method, self._static_test = subject, start_frames, method, static_test
        self._filters: SensorFilters | None = None
        self._alignment: SensorAlignment | None = None
        self._lost: dict[str, int] = {}  # sensor with measured orientations → samples lost at the end of the last chunk

    def push(self, chunk: Recording) -> Oriented:
        """Return a chunk with its segments.

        Raises
        ------
        WeposeError
            No mount is known for a sensor, or gravity contradicts it; a start phase with too few samples.
        """
        if self._filters is None:
            check_mounts(chunk, self._subject, self._start_frames)
            self._filters = SensorFilters(
                chunk, method=self._method, static_test=self._static_test, sways=self._start_frames.sways
            )
        orientation = self._filters.push(chunk)
        if self._alignment is None:
            filtered = combine_chunk(self._filters, chunk, orientation)
            self._alignment = align_sensors(chunk, self._subject, filtered, self._start_frames)
        oriented = orient_segments(chunk, self._alignment, orientation, self._subject, self._start_frames, self._lost)
        self._lost = {
            name: int(count_lost_samples(sensor, self._lost.get(name, 0))[-1])
            for name, sensor in chunk.sensors.items()
            if isinstance(sensor, OrientationSensor)
        }
        return chunk, oriented
