"""Samples from the Lab Streaming Layer, one stream a sensor.

liblsl's dejittering is not used: it assumes that no sample is missing, and after a loss its times are wrong for long
(liblsl 1.18, 1 s lost at 100 Hz: by −1.0 s at first, by +0.3 s 7 s later).
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ...errors import BadSource, one_of
from ...readers.device import ACCEL_UNITS, GYRO_UNITS
from ...recording.arrivals import Samples
from ..state import join_names
from . import Source, SourceKind, SourceOptions

THIS_MACHINE = (
    "[log]\nlevel = -3\n[ports]\nIPv6 = disable\n[multicast]\nResolveScope = machine\nListenAddress = 127.0.0.1\n"
)
SIGNALS = ("gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z")
SQUARED = {"m/s²": 1.0, "m/s2": 1.0}  # other ways to write a unit
BUFFER_S = 10  # [s] that the inlet keeps while nobody reads
MAX_SAMPLES = 4096
POLL_S = 0.002  # [s] between two polls: liblsl cannot wait for several inlets at once
COLLECT_S = 1.0  # [s] for which streams may answer
MAX_STREAMS = 99  # more than ever answer, so that the search takes all that time
ANSWER_S = 3.0


class Stream(NamedTuple):
    """The stream of a sensor."""

    name: str
    inlet: Any
    channels: list[int]  # the six of `SIGNALS`
    factors: np.ndarray  # (6,) from their units to SI
    rate_hz: float


def open_spec(rest: str, options: SourceOptions) -> LslSource:
    """The source of ``lsl:NAME``."""
    if "'" in rest:
        raise options.error("the name of a stream has no quote, as lsl:wepose")
    return LslSource(rest, options.segments, options.sensors)


class LslSource(Source):
    """Streams called `name`-segment or `name`_segment, which liblsl finds again where they have a source_id.

    Times are liblsl's `local_clock`, monotonic; of another machine it corrects them for the sender's clock. `segments`
    are names that sensors may have, `sensors` those to wait for; None: all that are found.
    """

    def __init__(self, name: str, segments: Sequence[str], sensors: Sequence[str] | None = None) -> None:
        super().__init__(sensors or ())
        self._name, self._segments = name, tuple(segments)
        self._streams: dict[str, Stream] = {}  # by segment

    def open(self) -> None:
        self._lsl = configure_pylsl()

    def connect(self, timeout_s: float) -> bool:
        """Search and subscribe; raises `BadSource` where a stream has other channels than it should."""
        query = " or ".join(f"starts-with(name,'{self._name}{end}')" for end in "-_")
        for info in self._lsl.resolve_bypred(query, minimum=MAX_STREAMS, timeout=max(COLLECT_S, timeout_s)):
            segment = info.name()[len(self._name) + 1 :]
            if segment not in self._streams:
                self._streams[segment] = self._subscribe(info, segment)
            elif self._streams[segment].name != info.name():
                raise BadSource(f"lsl:{self._name}: {segment} is in two streams; stop one of them")
        if not self._streams or not set(self.sensors) <= set(self._streams):
            return False
        self.sensors = self.sensors or tuple(segment for segment in self._segments if segment in self._streams)
        rates = {stream.rate_hz for stream in self._streams.values()}
        self.rate_hz = rates.pop() if len(rates) == 1 and min(rates) > 0.0 else None
        return True

    def _subscribe(self, info: Any, segment: str) -> Stream:
        where = f"lsl:{self._name}: stream '{info.name()}'"
        if segment not in self._segments:
            raise BadSource(f"{where}: '{segment}' is not a segment; {one_of(self._segments, segment)}")
        flags = self._lsl.proc_clocksync if os.environ.get("LSLAPICFG") else 0  # one machine has one clock
        inlet = self._lsl.StreamInlet(info, max_buflen=BUFFER_S, processing_flags=int(flags))
        try:
            full = inlet.info(timeout=ANSWER_S)
            inlet.open_stream(timeout=ANSWER_S)
        except RuntimeError as error:
            raise BadSource(f"{where} does not answer: {error}") from None
        unnamed = [None] * full.channel_count()
        labels = [label or "" for label in full.get_channel_labels() or unnamed]
        units = [unit or "" for unit in full.get_channel_units() or unnamed]
        if len(labels) == len(SIGNALS) and not any(labels):
            labels = list(SIGNALS)
        factors = []
        for label in SIGNALS:
            if label not in labels:
                raise BadSource(f"{where}: no channel labelled '{label}'; {one_of([*filter(None, labels)], label)}")
            known = GYRO_UNITS if label.startswith("gyr") else ACCEL_UNITS | SQUARED
            unit = units[labels.index(label)] or next(iter(known))
            if unit not in known:
                raise BadSource(f"{where}: channel '{label}': unit '{unit}'; {one_of(known, unit)}")
            factors.append(known[unit])
        channels = [labels.index(label) for label in SIGNALS]
        return Stream(info.name(), inlet, channels, np.array(factors), float(full.nominal_srate()))

    def describe_awaited(self) -> str:
        names = [segment for segment in self.sensors if self._streams and segment not in self._streams]
        where = "where LSLAPICFG looks" if os.environ.get("LSLAPICFG") else "on this machine"
        return f"the LSL streams {self._name}-SEGMENT {where}" + (f": {join_names(names)}" if names else "")

    def read(self, timeout_s: float) -> list[Samples]:
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while True:
            for segment in [segment for segment in self.sensors if segment in self._streams]:
                stream = self._streams[segment]
                try:
                    rows, times = stream.inlet.pull_chunk(timeout=0.0, max_samples=MAX_SAMPLES)
                except RuntimeError:  # pylsl's LostError is one
                    self.count(f"streams lost for good, without a source_id: {stream.name}")
                    del self._streams[segment]
                    continue
                if len(times):
                    values = np.array(rows, dtype=float)[:, stream.channels] * stream.factors
                    samples += self.keep_plausible(Samples(segment, np.array(times), values[:, :3], values[:, 3:]))
            left = deadline - time.monotonic()
            if samples or left <= 0.0:
                return samples
            time.sleep(min(POLL_S, left))

    def clock(self) -> float:
        return float(self._lsl.local_clock())

    def close(self) -> None:
        self._streams.clear()


@cache  # liblsl reads its configuration once in a process
def configure_pylsl() -> Any:
    """The module pylsl, which searches this machine only, or as far as the user's own ``LSLAPICFG`` says."""
    try:
        import pylsl
    except (ImportError, RuntimeError) as error:  # RuntimeError: pylsl is there and finds no liblsl
        raise BadSource(f"lsl: needs pylsl ({error}): pip install pylsl") from None
    if not os.environ.get("LSLAPICFG"):
        pylsl.set_config_content(THIS_MACHINE)
    return pylsl


KIND = SourceKind("lsl:NAME", open_spec)
