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
from ..filters import BEST, Orientation
from ..filters.sensors import SensorFilters, combine_chunk
from ..filters.static import StaticTest
from ..recording import OrientationSensor, Recording
from ..subject import Subject

Oriented = tuple[Recording, SegmentOrientations]


class SegmentEstimator:
    """Orientation of each segment of a recording that comes in chunks.

    The chunks of a causal filter together are bit-identical with one chunk; the smoother looks one chunk
    ahead. The phases `start` and `static` are in the first chunk.

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

    def push(self, chunk: Recording) -> list[Oriented]:
        """Take a chunk; gives it and its segments, or with the smoother those of the chunk before.

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
        filtered = self._filters.push(chunk)
        return [] if filtered is None else [self._orient(self._filters, *filtered)]

    def finish(self) -> list[Oriented]:
        """What is left when the last chunk has been pushed: the smoother's last one."""
        if self._filters is None or not self._filters.ahead:
            return []
        return [self._orient(self._filters, *self._filters.finish())]

    def _orient(self, filters: SensorFilters, chunk: Recording, orientation: dict[str, Orientation]) -> Oriented:
        if self._alignment is None:
            filtered = combine_chunk(filters, chunk, orientation)
            self._alignment = align_sensors(chunk, self._subject, filtered, self._start_frames)
        oriented = orient_segments(chunk, self._alignment, orientation, self._subject, self._start_frames, self._lost)
        self._lost = {
            name: int(count_lost_samples(sensor, self._lost.get(name, 0))[-1])
            for name, sensor in chunk.sensors.items()
            if isinstance(sensor, OrientationSensor)
        }
        return chunk, oriented
