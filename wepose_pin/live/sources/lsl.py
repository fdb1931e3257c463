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
from .base import Source, SourceKind, SourceOptions, Waiting
from .packets import NUMBERS

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


def find_channels(
    stream: str,
    name: str,
    labels: Sequence[str],
    units: Sequence[str],
    count: int,
    segments: Sequence[str] = NUMBERS,
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
        wanted = {
            segment: [f"{segment}_{signal}" for signal in SIGNALS]
            for segment in segments
            if any(label.startswith(f"{segment}_") for label in labels)
        }
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
        labels, wanted = labels if known_labels else SIGNALS, {segment: list(SIGNALS)}
    parts = []
    for segment, names in wanted.items():
        missing = [label for label in names if label not in labels]
        if missing:
            raise BadSource(f"{where}: no channel labelled '{missing[0]}'; {one_of(known_labels, missing[0])}")
        channels = [list(labels).index(label) for label in names]
        scale = []
        for k, channel in enumerate(channels):
            known, unit = (GYRO_UNITS if k < 3 else ACCEL_UNITS), units[channel] if channel < len(units) else ""
            if unit not in known:
                raise BadSource(f"{where}: channel '{names[k]}': unit '{unit}'; {one_of(filter(None, known), unit)}")
            scale.append(known[unit])
        parts.append(SensorChannels(segment, channels, np.array(scale)))
    return parts


def open_spec(rest: str, options: SourceOptions) -> LslSource:
    """The source of ``lsl:NAME[@SCOPE]``."""
    name, separator, scope = rest.rpartition("@")
    if separator and scope not in SCOPES:
        raise BadOption(f"source '{options.spec}': '{scope}' is no reach of a search; {one_of(SCOPES, scope)}")
    chosen = (name, scope) if separator else (rest, None)
    return LslSource(chosen[0], options.sensors, chosen[1], options.wait_s, options.segments)


class LslSource(Source):
    """Streams called `name`, `name`-segment or `name`_segment; lost ones are reconnected.

    Parameters
    ----------
    sensors : to wait for; None: all that are found
    scope : "machine", "link" or "site"; None: this machine, or as the user's own ``LSLAPICFG`` says where it is set
    wait_s : [s] for which `open` searches the streams
    segments : names that sensors may have

    Notes
    -----
    Times are liblsl's `local_clock`, monotonic; in a wider scope than the machine it corrects them for the sender's
    clock. The search opens UDP sockets for the replies, which liblsl cannot bind to loopback.
    """

    def __init__(
        self,
        name: str,
        sensors: Sequence[str] | None = None,
        scope: str | None = None,
        wait_s: float = 10.0,
        segments: Sequence[str] = NUMBERS,
    ) -> None:
        if not name or "'" in name:
            raise BadOption(f"lsl:{name}: a stream's name has at least one letter and no quote, as lsl:wepose")
        super().__init__(sensors or ())
        self._segments, self._name, self._scope, self._wait_s = tuple(segments), name, scope, wait_s
        self._streams: dict[str, _Stream] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._reconnector: threading.Thread | None = None
        self._reach = ""  # of the search, once it began

    def explain_unit(self, key: str, unit: str) -> str:
        channels = SIGNALS[:3] if key == "gyro_unit" else SIGNALS[3:]
        return f'State the unit "{unit}" of the channels {", ".join(channels)} in the stream\'s description'

    def open(self, waiting: Waiting | None = None) -> None:
        """Find the streams and subscribe, with `waiting` until it returns False.

        Raises
        ------
        BadSource
            liblsl is missing, no such stream is found, or one has other channels than it should.
        """
        self._lsl, scope = configure_pylsl(self._scope)
        self._reach = f"on this {scope}" if scope in SCOPES else "where LSLAPICFG looks"
        self._flags = 0 if scope == "machine" else int(self._lsl.proc_clocksync)
        self._stop.clear()
        if not self.wait_for(self._search, self._describe_missing, waiting, self._wait_s, self._refuse):
            return
        present = self._present
        twice = {segment for segment in present if present.count(segment) > 1}
        if twice:
            self.close()
            raise BadSource(f"lsl:{self._name}: {min(twice)} is in two streams; stop one of them")
        self.sensors = self.sensors or tuple(segment for segment in self._segments if segment in present)
        rates = {stream.rate_hz for stream in self._streams.values()}
        self.rate_hz = rates.pop() if len(rates) == 1 and min(rates) > 0.0 else None
        self._reconnector = threading.Thread(target=self._reconnect, name=f"lsl {self._name}", daemon=True)
        self._reconnector.start()

    @property
    def _present(self) -> list[str]:
        """The sensors of the streams that were found."""
        return [part.sensor for stream in self._streams.values() for part in stream.parts]

    @property
    def _missing(self) -> list[str]:
        return [segment for segment in self.sensors if segment not in self._present]

    def _search(self, _timeout_s: float) -> bool:
        """Search streams; return whether all are there."""
        for stream, info in self._resolve(min(COLLECT_S, self._wait_s)).items():
            if stream not in self._streams:
                self._streams[stream] = self._subscribe(stream, info)
        return bool(self._present) and not self._missing

    def _describe_missing(self) -> str:
        return self.describe_awaited(self._missing)

    def _refuse(self) -> str:
        problem = f"{', '.join(self._missing)} is in none of the streams" if self._present else "no such stream"
        return (
            f"lsl:{self._name}: {problem} {self._reach}, within {self._wait_s:g} s; name streams "
            f"{self._name}-<segment>, or look further with lsl:{self._name}@site"
        )

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, one `Samples` a sensor."""
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while True:
            with self._lock:
                streams = list(self._streams.values())
            for stream in streams:
                samples += self._pull(stream)
            left = deadline - time.monotonic()
            if samples or left <= 0.0:
                return samples
            time.sleep(min(POLL_S, left))

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        names = f": {join_names(list(sensors))}" if sensors else ""
        return f"the LSL stream {self._name} {self._reach}{names}"

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

    def _pull(self, stream: _Stream) -> list[Samples]:
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

    def _subscribe(self, stream: str, info: Any) -> _Stream:
        lsl = self._lsl
        inlet = lsl.StreamInlet(info, max_buflen=BUFFER_S, recover=False, processing_flags=self._flags)
        try:
            full = inlet.info(timeout=ANSWER_S)
            inlet.open_stream(timeout=ANSWER_S)
        except RuntimeError as error:
            raise BadSource(f"lsl:{self._name}: stream '{stream}' does not answer: {error}") from None
        if full.channel_format() == lsl.cf_string:
            raise BadSource(f"lsl:{self._name}: stream '{stream}' holds text; six channels of numbers a sensor")
        labels, units = (
            [text or "" for text in texts or ()] for texts in (full.get_channel_labels(), full.get_channel_units())
        )
        parts = find_channels(stream, self._name, labels, units, full.channel_count(), self._segments)
        return _Stream(stream, inlet, parts, float(full.nominal_srate()))

    def _reconnect(self) -> None:
        """Reconnect streams that are lost or silent."""
        while not self._stop.wait(RETRY_S):
            now = time.monotonic()
            gone = [
                name for name, stream in self._streams.items() if stream.lost or now - stream.last_sample > SILENT_S
            ]
            if not gone:
                continue
            infos = self._resolve(0.5 * RETRY_S)
            for name in gone:
                if name in infos and not self._stop.is_set():
                    try:
                        fresh = self._subscribe(name, infos[name])
                    except BadSource:
                        continue
                    with self._lock:
                        self._streams[name] = fresh


@dataclass
class _Stream:
    """An inlet and its sensors."""

    name: str
    inlet: Any
    parts: Sequence[SensorChannels]
    rate_hz: float
    last_sample: float = field(default_factory=time.monotonic)
    lost: bool = False


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
