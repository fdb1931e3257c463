"""Samples from the Lab Streaming Layer: one stream a sensor, or one for all.

liblsl's dejittering is not used: it assumes that no sample is missing, and after a loss its times are wrong for long
(liblsl 1.18, 1 s lost at 100 Hz: by −1.0 s at first, by +0.3 s 7 s later).
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ...errors import BadSource, how_to_install, one_of
from ...readers.device import ACCEL_UNITS, GYRO_UNITS
from ...recording.arrivals import Samples
from ..state import join_names
from .base import Source, SourceKind, SourceOptions

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
    """An inlet and its sensors."""

    inlet: Any
    sensors: Mapping[str, tuple[list[int], np.ndarray]]  # sensor → its six channels, and their factors (6,) to SI
    rate_hz: float


def open_spec(rest: str, options: SourceOptions) -> LslSource:
    """The source of ``lsl:NAME``."""
    if "'" in rest:
        raise options.error("the name of a stream has no quote, as lsl:wepose")
    return LslSource(rest, options.segments, options.sensors)


class LslSource(Source):
    """Streams called `name`, `name`-segment or `name`_segment, which liblsl finds again where they have a source_id.

    Times are liblsl's `local_clock`, monotonic; of another machine it corrects them for the sender's clock. `segments`
    are names that sensors may have, `sensors` those to wait for; None: all that are found.
    """

    def __init__(self, name: str, segments: Sequence[str], sensors: Sequence[str] | None = None) -> None:
        super().__init__(sensors or ())
        self._name, self._segments = name, tuple(segments)
        self._streams: dict[str, Stream] = {}

    def explain_unit(self, key: str, unit: str) -> str:
        channels = SIGNALS[:3] if key == "gyro_unit" else SIGNALS[3:]
        return f'State the unit "{unit}" of the channels {", ".join(channels)} in the stream\'s description'

    def open(self) -> None:
        self._lsl = configure_pylsl()

    def connect(self, timeout_s: float) -> bool:
        """Search and subscribe; raises `BadSource` where a stream has other channels than it should."""
        query = " or ".join(f"starts-with(name,'{self._name}{end}')" for end in "-_") + f" or name='{self._name}'"
        answers = self._lsl.resolve_bypred(query, minimum=MAX_STREAMS, timeout=max(COLLECT_S, timeout_s))
        for info in answers:
            if info.name() not in self._streams:
                self._streams[info.name()] = self._subscribe(info)
        present = [sensor for stream in self._streams.values() for sensor in stream.sensors]
        if not present or not set(self.sensors) <= set(present):
            return False
        twice = {segment for segment in present if present.count(segment) > 1}
        if twice:
            raise BadSource(f"lsl:{self._name}: {min(twice)} is in two streams; stop one of them")
        self.sensors = self.sensors or tuple(segment for segment in self._segments if segment in present)
        rates = {stream.rate_hz for stream in self._streams.values()}
        self.rate_hz = rates.pop() if len(rates) == 1 and min(rates) > 0.0 else None
        return True

    def _subscribe(self, info: Any) -> Stream:
        stream = info.name()
        where = f"lsl:{self._name}: stream '{stream}'"
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
        prefixes = {segment: f"{segment}_" for segment in self._segments}  # of the labels of each sensor
        if stream != self._name:  # of one sensor, whose first six channels need no label where there are no others
            segment = stream[len(self._name) + 1 :]
            if segment not in self._segments:
                raise BadSource(f"{where}: '{segment}' is not a segment; {one_of(self._segments, segment)}")
            prefixes = {segment: ""}
            labels = labels if any(labels) or len(labels) != len(SIGNALS) else list(SIGNALS)
        sensors = {}
        for segment, prefix in prefixes.items():
            if prefix and not any(label.startswith(prefix) for label in labels):
                continue
            factors = []
            for label in (prefix + signal for signal in SIGNALS):
                if label not in labels:
                    raise BadSource(f"{where}: no channel labelled '{label}'; {one_of([*filter(None, labels)], label)}")
                known = GYRO_UNITS if "gyr_" in label else ACCEL_UNITS | SQUARED
                unit = units[labels.index(label)] or next(iter(known))
                if unit not in known:
                    raise BadSource(f"{where}: channel '{label}': unit '{unit}'; {one_of(known, unit)}")
                factors.append(known[unit])
            sensors[segment] = [labels.index(prefix + signal) for signal in SIGNALS], np.array(factors)
        if not sensors:
            raise BadSource(f"{where}: no channel label names a segment, as {self._segments[0]}_gyr_x")
        return Stream(inlet, sensors, float(full.nominal_srate()))

    def describe_awaited(self) -> str:
        present = {sensor for stream in self._streams.values() for sensor in stream.sensors}
        names = [segment for segment in self.sensors if present and segment not in present]
        where = "where LSLAPICFG looks" if os.environ.get("LSLAPICFG") else "on this machine"
        return f"the LSL stream {self._name} {where}" + (f": {join_names(names)}" if names else "")

    def read(self, timeout_s: float) -> list[Samples]:
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while True:
            for name, stream in list(self._streams.items()):
                try:
                    rows, times = stream.inlet.pull_chunk(timeout=0.0, max_samples=MAX_SAMPLES)
                except RuntimeError:  # pylsl's LostError is one
                    self.count(f"streams lost for good, without a source_id: {name}")
                    del self._streams[name]
                    continue
                if len(times):
                    stamps, table = np.array(times), np.array(rows, dtype=float)
                    for sensor, (channels, factors) in stream.sensors.items():
                        if sensor in self.sensors:
                            samples += self.keep_plausible(sensor, stamps, table[:, channels] * factors)
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
        raise BadSource(f"lsl: needs pylsl ({error}): {how_to_install('pylsl')}") from None
    if not os.environ.get("LSLAPICFG"):
        pylsl.set_config_content(THIS_MACHINE)
    return pylsl


KIND = SourceKind("lsl:NAME", open_spec)
