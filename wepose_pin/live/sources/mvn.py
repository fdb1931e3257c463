"""Segments of the Xsens MVN network streamer: datagrams of type 02, quaternions.

MVN streams the orientation of 23 segments, to a world with z up, each the identity in the T-pose; ours are the identity
in the N-pose (`N_TO_T`). Its world's heading is its own: the start pose gives ours. A frame may be split into several
datagrams. Written after the vendor's specification, revision N (2018).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from ... import rotations
from ..figure import MEASURED, N_TO_T, SEGMENTS
from ..mvn_frames import BODY_SEGMENTS, HEADER, ITEM, TYPE
from .clocks import HostClock
from .datagrams import OrientationSample, OrientationSource

PORT = 9763
CHARACTER = 0  # the first person


class MvnSource(OrientationSource):
    """Orientations of the segments that MVN streams; parameters and errors as `DatagramSource`."""

    kind, sender, has_clock = "mvn", "frames of the MVN network streamer (type 02, quaternions)", True
    aligned = True

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._clock = HostClock()
        ours = ((k, MEASURED.get(name)) for k, name in enumerate(SEGMENTS))
        self._segment_of = {k: segment for k, segment in ours if segment in self._segments}

    def _decode(self, datagram: bytes, _sender: Any, now: float) -> Iterator[OrientationSample]:
        if len(datagram) < HEADER.size or datagram[:4] != TYPE[:4]:
            self._count("datagrams that are none of MVN")
            return
        kind, _, _, items, time_ms, character, _, _, _, _, _ = HEADER.unpack_from(datagram)
        if kind != TYPE:
            self._count(f"MVN datagrams of type {kind[4:].decode('ascii', 'replace')}, which is not read")
            return
        if character != CHARACTER:
            self._count(f"MVN frames of character {character}, not {CHARACTER}")
            return
        if items > BODY_SEGMENTS + 4 + 40 or len(datagram) < HEADER.size + items * ITEM.size:
            self._count("MVN datagrams of a wrong length")
            return
        time_s = float(self._clock.to_host(np.array([1e-3 * time_ms]), now)[0])
        for k in range(items):
            try:
                id_, *numbers = ITEM.unpack_from(datagram, HEADER.size + k * ITEM.size)
            except struct.error:  # pragma: no cover - the length has been checked
                return
            segment = self._segment_of.get(id_ - 1)
            if segment is None:
                continue
            quat_WB = rotations.xyzw_from_wxyz(np.array(numbers[3:]))
            yield OrientationSample(segment, time_s, rotations.multiply(quat_WB, N_TO_T[id_ - 1]))
