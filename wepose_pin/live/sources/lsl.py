"""Samples from the Lab Streaming Layer: one stream a sensor, or one for all.

Streams are searched on this machine only, unless a wider scope is asked for. A lost stream is searched again here and
not by liblsl, which finds only streams with a `source_id` and keeps sockets open for that. liblsl's dejittering is not
used: it assumes that no sample is missing, and after a loss its times are wrong for long (liblsl 1.18, 1 s lost at
100 Hz: by −1.0 s at first, by +0.3 s 7 s later).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...errors import BadOption, BadSource, how_to_install, one_of
from ...recording.arrivals import Samples
from ...recording.limits import STANDARD_GRAVITY
from ..state import join_names
from .base import Source, SourceKind, SourceOptions

# Scope of the search → configuration of liblsl. On one machine there is one clock and one loopback.
_QUIET = "[log]\nlevel = -3\n"
SCOPES = {
    "machine": _QUIET + "[ports]\nIPv6 = disable\n[multicast]\nResolveScope = machine\nListenAddress = 127.0.0.1\n",
    "link": _QUIET + "[multicast]\nResolveScope = link\n",
    "site": _QUIET + "[multicast]\nResolveScope = site\n",
}
SIGNALS = ("gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z")
GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "": 1.0}
ACCEL_UNITS = {"m/s^2": 1.0, "m/s²": 1.0, "m/s2": 1.0, "g": STANDARD_GRAVITY, "": 1.0}
BUFFER_S = 10  # [s] that the inlet keeps while nobody reads
MAX_SAMPLES = 4096
POLL_S = 0.002  # [s] between two polls: liblsl cannot wait for several inlets at once
COLLECT_S = 1.0  # [s] for which streams may answer
MAX_STREAMS = 99  # more than ever answer, so that the search takes all that time
SILENT_S = 3.0  # [s] without a sample, after which a stream is searched again
RETRY_S = 1.0  # [s] between two such searches
ANSWER_S = 3.0

_scope: str | None = None  # liblsl reads its configuration once in a process


class SensorChannels(NamedTuple):
    """Channels of one sensor in a stream."""

    sensor: str
    channels: list[int]  # six: gyro xyz, accel xyz
    scale: np.ndarray  # (6,) to rad/s and m/s²


@dataclass
class Stream:
    """An inlet and its sensors."""

    name: str
    inlet: Any
    parts: Sequence[SensorChannels]
    rate_hz: float
    last_sample: float = field(default_factory=time.monotonic)
    lost: bool = False


def find_channels(
    stream: str, name: str, labels: Sequence[str], units: Sequence[str], count: int, segments: Sequence[str]
) -> list[SensorChannels]:
    """The sensors of a stream and their channels.

    `<name>-<segment>` or `<name>_<segment>` is one sensor: six channels gyro xyz, accel xyz, or any number with labels
    `gyr_x` … `acc_z`. `<name>` itself is one for all, with labels `<segment>_gyr_x` … `<segment>_acc_z`. `segments`:
    names that sensors may have.

    Raises
    ------
    BadSource
        An unknown segment, label or unit, or missing channels.
    """
    where, known_labels = f"lsl:{name}: stream '{stream}'", list(filter(None, labels))
    if stream == name:
        sensors = {segment: f"{segment}_" for segment in segments}
        wanted = {s: prefix for s, prefix in sensors.items() if any(label.startswith(prefix) for label in labels)}
        if not wanted:
            raise BadSource(
                f"{where}: no channel label names a segment, as {segments[0]}_gyr_x; {one_of(known_labels)} "
                f"(or send one stream a sensor, named {name}-{segments[0]})"
            )
    else:
        segment = stream[len(name) + 1 :]
        if segment not in segments:
            raise BadSource(f"{where}: '{segment}' is not a segment; {one_of(segments, segment)}")
        if not known_labels and count != len(SIGNALS):
            raise BadSource(
                f"{where}: {count} channels without labels; 6 are gyro xyz and accel xyz, more need labels "
                f"{', '.join(SIGNALS)}"
            )
        labels, wanted = labels if known_labels else SIGNALS, {segment: ""}
    parts = []
    for segment, prefix in wanted.items():
        channels, scale = [], []
        for k, label in enumerate(prefix + signal for signal in SIGNALS):
            if label not in labels:
                raise BadSource(f"{where}: no channel labelled '{label}'; {one_of(known_labels, label)}")
            channels.append(list(labels).index(label))
            known, unit = GYRO_UNITS if k < 3 else ACCEL_UNITS, "".join(units[channels[-1] : channels[-1] + 1])
            if unit not in known:
                raise BadSource(f"{where}: channel '{label}': unit '{unit}'; {one_of(filter(None, known), unit)}")
            scale.append(known[unit])
        parts.append(SensorChannels(segment, channels, np.array(scale)))
    return parts


def open_spec(rest: str, options: SourceOptions) -> LslSource:
    """The source of ``lsl:NAME[@SCOPE]``."""
    name, separator, scope = rest.rpartition("@")
    if separator and scope not in SCOPES:
        raise options.error(f"'{scope}' is no reach of a search; {one_of(SCOPES, scope)}")
    if not separator:
        name = rest
    if not name or "'" in name:
        raise BadOption(f"lsl:{name}: a stream's name has at least one letter and no quote, as lsl:wepose")
    return LslSource(name, options.segments, options.sensors, scope if separator else None)


class LslSource(Source):
    """Streams called `name`, `name`-segment or `name`_segment; lost ones are reconnected.

    Parameters
    ----------
    segments : names that sensors may have
    sensors : to wait for; None: all that are found
    scope : "machine", "link" or "site"; None: this machine, or as the user's own ``LSLAPICFG`` says where it is set

    Notes
    -----
    Times are liblsl's `local_clock`, monotonic; in a wider scope than the machine it corrects them for the sender's
    clock. The search opens UDP sockets for the replies, which liblsl cannot bind to loopback.
    """

    def __init__(
        self, name: str, segments: Sequence[str], sensors: Sequence[str] | None = None, scope: str | None = None
    ) -> None:
        super().__init__(sensors or ())
        self._name, self._segments, self._scope, self._reach = name, tuple(segments), scope, ""
        self._streams: dict[str, Stream] = {}
        self._stop = threading.Event()
        self._reconnector: threading.Thread | None = None

    def explain_unit(self, key: str, unit: str) -> str:
        channels = SIGNALS[:3] if key == "gyro_unit" else SIGNALS[3:]
        return f'State the unit "{unit}" of the channels {", ".join(channels)} in the stream\'s description'

    def open(self) -> None:
        """Configure liblsl; raises `BadSource` where it is missing, `BadOption` where it has another scope already."""
        self._lsl, scope = configure_pylsl(self._scope)
        self._reach = f"on this {scope}" if scope in SCOPES else "where LSLAPICFG looks"
        self._flags = 0 if scope == "machine" else int(self._lsl.proc_clocksync)
        self._stop.clear()

    def connect(self, timeout_s: float) -> bool:
        """Search and subscribe; raises `BadSource` where a stream has other channels than it should."""
        for name, info in self._resolve(max(COLLECT_S, timeout_s)).items():
            if name not in self._streams:
                self._streams[name] = self._subscribe(name, info)
        present = self._present
        if not present or self._missing:
            return False
        twice = {segment for segment in present if present.count(segment) > 1}
        if twice:
            raise BadSource(f"lsl:{self._name}: {min(twice)} is in two streams; stop one of them")
        self.sensors = self.sensors or tuple(segment for segment in self._segments if segment in present)
        rates = {stream.rate_hz for stream in self._streams.values()}
        self.rate_hz = rates.pop() if len(rates) == 1 and min(rates) > 0.0 else None
        self._reconnector = threading.Thread(target=self._reconnect, name=f"lsl {self._name}", daemon=True)
        self._reconnector.start()
        return True

    @property
    def _present(self) -> list[str]:
        """The sensors of the streams that were found."""
        return [part.sensor for stream in self._streams.values() for part in stream.parts]

    @property
    def _missing(self) -> list[str]:
        return [segment for segment in self.sensors if segment not in self._present]

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        names = list(sensors) or (self._missing if self._present else [])
        return f"the LSL stream {self._name} {self._reach}" + (f": {join_names(names)}" if names else "")

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, one `Samples` a sensor."""
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while True:
            for stream in list(self._streams.values()):
                samples += self._pull(stream)
            left = deadline - time.monotonic()
            if samples or left <= 0.0:
                return samples
            time.sleep(min(POLL_S, left))

    def clock(self) -> float:
        """Now [s], liblsl's local clock."""
        return float(self._lsl.local_clock())

    def close(self) -> None:
        """Unsubscribe."""
        self._stop.set()
        if self._reconnector is not None:
            self._reconnector.join()
            self._reconnector = None
        self._streams.clear()

    def _pull(self, stream: Stream) -> list[Samples]:
        if stream.lost:
            return []
        try:
            rows, times = stream.inlet.pull_chunk(timeout=0.0, max_samples=MAX_SAMPLES)
        except RuntimeError:  # pylsl's LostError is one
            stream.lost = True
            self.count(f"streams lost: {stream.name}")
            return []
        if not len(times):
            return []
        stream.last_sample = time.monotonic()
        stamps, table = np.array(times), np.array(rows, dtype=float)
        samples = []
        for part in stream.parts:
            if part.sensor in self.sensors:
                samples += self.keep_plausible(part.sensor, stamps, table[:, part.channels] * part.scale)
        return samples

    def _resolve(self, timeout_s: float) -> dict[str, Any]:
        """Name → description of the streams that answer in this time; of two with one name the newer."""
        name = self._name
        query = f"name='{name}' or starts-with(name,'{name}-') or starts-with(name,'{name}_')"
        streams = self._lsl.resolve_bypred(query, minimum=MAX_STREAMS, timeout=timeout_s)
        return {info.name(): info for info in sorted(streams, key=lambda info: info.created_at())}

    def _subscribe(self, stream: str, info: Any) -> Stream:
        inlet = self._lsl.StreamInlet(info, max_buflen=BUFFER_S, recover=False, processing_flags=self._flags)
        try:
            full = inlet.info(timeout=ANSWER_S)
            inlet.open_stream(timeout=ANSWER_S)
        except RuntimeError as error:
            raise BadSource(f"lsl:{self._name}: stream '{stream}' does not answer: {error}") from None
        if full.channel_format() == self._lsl.cf_string:
            raise BadSource(f"lsl:{self._name}: stream '{stream}' holds text; six channels of numbers a sensor")
        labels, units = (
            [text or "" for text in texts or ()] for texts in (full.get_channel_labels(), full.get_channel_units())
        )
        parts = find_channels(stream, self._name, labels, units, full.channel_count(), self._segments)
        return Stream(stream, inlet, parts, float(full.nominal_srate()))

    def _reconnect(self) -> None:
        """Reconnect streams that are lost or silent."""
        while not self._stop.wait(RETRY_S):
            silent_since = time.monotonic() - SILENT_S
            gone = [name for name, each in self._streams.items() if each.lost or each.last_sample < silent_since]
            infos = self._resolve(0.5 * RETRY_S) if gone else {}
            for name in gone:
                if name in infos and not self._stop.is_set():
                    try:
                        self._streams[name] = self._subscribe(name, infos[name])
                    except BadSource:
                        continue


def configure_pylsl(scope: str | None) -> tuple[Any, str]:
    """The module, configured to search in `scope`; and the scope."""
    global _scope
    try:
        import pylsl
    except (ImportError, RuntimeError) as error:  # RuntimeError: pylsl is there and finds no liblsl
        raise BadSource(f"lsl: needs pylsl ({error}): {how_to_install('pylsl')}") from None
    wanted = scope or ("your LSLAPICFG" if os.environ.get("LSLAPICFG") else "machine")
    if _scope is None:
        if wanted in SCOPES:
            if not hasattr(pylsl, "set_config_content"):
                raise BadSource(f"lsl: pylsl {pylsl.__version__} cannot keep to this machine; pylsl 1.18 or later can")
            pylsl.set_config_content(SCOPES[wanted])
        _scope = wanted
    elif _scope != wanted:
        raise BadOption(f"lsl: scope {wanted} after {_scope}; liblsl keeps the first of a process: start a new one")
    return pylsl, wanted


KIND = SourceKind("lsl:NAME[@machine|link|site]", open_spec)
