"""Samples from the Lab Streaming Layer: one stream a sensor, or one for all.

Streams are looked for on this machine only, unless a wider scope is asked for. A stream that is lost is looked for
again here and not by liblsl: it finds only streams that have a `source_id`, and holds sockets open for that. Its
dejittering is not used: it takes every sample for the next one of an even row, and after a loss its times are off for
long (seen with liblsl 1.18, 1 s lost at 100 Hz: by −1.0 s at first, by +0.3 s 7 s later).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...errors import BadOption, BadSource, one_of
from ...recording import SEGMENTS
from ...recording.arrivals import Samples
from ...recording.limits import STANDARD_GRAVITY
from .checks import UNSOUND, sound

# What liblsl calls the reach of its search → its configuration. On one machine there is one clock and one loopback.
_QUIET = "[log]\nlevel = -3\n"
SCOPES = {
    "machine": _QUIET + "[ports]\nIPv6 = disable\n[multicast]\nResolveScope = machine\nListenAddress = 127.0.0.1\n",
    "link": _QUIET + "[multicast]\nResolveScope = link\n",
    "site": _QUIET + "[multicast]\nResolveScope = site\n",
}
SIGNALS = ("gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z")
GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "": 1.0}
ACCEL_UNITS = {"m/s^2": 1.0, "m/s²": 1.0, "m/s2": 1.0, "g": STANDARD_GRAVITY, "": 1.0}
# The inlet keeps this much [s] while nobody reads.
BUFFER_S = 10
MOST_SAMPLES = 4096
# liblsl cannot wait for several inlets at once: they are asked this often [s].
POLL_S = 0.002
# How long streams have to answer [s]; more than so many never do, so that none answers too late.
COLLECT_S = 1.0
MOST_STREAMS = 99
# A stream that is silent for this long [s], or lost, is looked for this often [s].
SILENT_S = 3.0
RETRY_S = 1.0
ANSWER_S = 3.0

_scope: str | None = None  # liblsl reads its configuration once in a process


class Part(NamedTuple):
    """Where one sensor stands in a stream's channels."""

    sensor: str
    channels: list[int]  # six: gyro xyz, accel xyz
    scale: np.ndarray  # (6,) to rad/s and m/s²


def layout(stream: str, name: str, labels: Sequence[str], units: Sequence[str], count: int) -> list[Part]:
    """Which sensors a stream holds, where.

    `<name>-<segment>` or `<name>_<segment>` is one sensor: six channels gyro xyz, accel xyz, or any number with labels
    `gyr_x` … `acc_z`. `<name>` itself is one for all, with labels `<segment>_gyr_x` … `<segment>_acc_z`.

    Raises
    ------
    BadSource
        A segment, label or unit that is none, or channels that are missing.
    """
    where = f"lsl:{name}: stream '{stream}'"
    if stream != name:
        segment = stream[len(name) + 1 :]
        if segment not in SEGMENTS:
            raise BadSource(f"{where}: '{segment}' is not a segment; {one_of(SEGMENTS, segment)}")
        wanted = {segment: list(SIGNALS)}
        if not any(labels):
            if count != len(SIGNALS):
                raise BadSource(
                    f"{where}: {count} channels without labels; 6 are gyro xyz and accel xyz, more need labels "
                    f"{', '.join(SIGNALS)}"
                )
            labels = SIGNALS
    else:
        there = [segment for segment in SEGMENTS if any(label.startswith(f"{segment}_") for label in labels)]
        wanted = {segment: [f"{segment}_{signal}" for signal in SIGNALS] for segment in there}
        if not wanted:
            raise BadSource(
                f"{where}: no channel label names a segment, as torso_gyr_x; {one_of(filter(None, labels))} "
                f"(or send one stream a sensor, named {name}-torso)"
            )
    parts = []
    for segment, names in wanted.items():
        missing = [label for label in names if label not in labels]
        if missing:
            raise BadSource(f"{where}: no channel labelled '{missing[0]}'; {one_of(filter(None, labels), missing[0])}")
        channels = [list(labels).index(label) for label in names]
        scale = []
        for k, channel in enumerate(channels):
            known, unit = (GYRO_UNITS if k < 3 else ACCEL_UNITS), units[channel] if channel < len(units) else ""
            if unit not in known:
                raise BadSource(f"{where}: channel '{names[k]}': unit '{unit}'; {one_of(filter(None, known), unit)}")
            scale.append(known[unit])
        parts.append(Part(segment, channels, np.array(scale)))
    return parts


class LslSource:
    """Streams called `name`, `name`-segment or `name`_segment; a lost one is taken up again when it is back.

    Parameters
    ----------
    sensors : those that are waited for; None: those that are found
    scope : "machine", "link" or "site"; None: this machine, or as the user's own ``LSLAPICFG`` says where it is set
    wait_s : how long `open` looks for the streams [s]

    Notes
    -----
    Times are liblsl's `local_clock`, monotonic; in a wider scope than the machine it corrects them for the sender's
    clock. Looking for streams opens UDP sockets for the replies, and liblsl knows no way to bind these to loopback.
    """

    def __init__(
        self, name: str, sensors: Sequence[str] | None = None, scope: str | None = None, wait_s: float = 10.0
    ) -> None:
        if not name or "'" in name:
            raise BadOption(f"lsl:{name}: a stream's name has at least one letter and no quote, as lsl:wepose")
        self.sensors = tuple(sensors or ())
        self.rate_hz: float | None = None
        self.problems: dict[str, int] = {}
        self._name, self._scope, self._wait_s = name, scope, wait_s
        self._streams: dict[str, _Stream] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._keeper: threading.Thread | None = None

    def open(self) -> None:
        """Find the streams and subscribe.

        Raises
        ------
        BadSource
            liblsl is missing, no such stream is found, or one has other channels than it should.
        """
        self._lsl, scope = pylsl_within(self._scope)
        self._flags = 0 if scope == "machine" else int(self._lsl.proc_clocksync)
        self._stop.clear()
        there: list[str] = []
        deadline = time.monotonic() + self._wait_s
        while not there or any(segment not in there for segment in self.sensors):
            left = deadline - time.monotonic()
            if left <= 0.0:
                break
            for stream, info in self._resolve(min(COLLECT_S, left)).items():
                if stream not in self._streams:
                    self._streams[stream] = self._subscribe(stream, info)
            there = [part.sensor for stream in self._streams.values() for part in stream.parts]
        twice = {segment for segment in there if there.count(segment) > 1}
        missing = [segment for segment in self.sensors if segment not in there]
        if not there or twice or missing:
            self.close()
            reach = f"on this {scope}" if scope in SCOPES else "where LSLAPICFG looks"
            if twice:
                raise BadSource(f"lsl:{self._name}: {min(twice)} is in two streams; stop one of them")
            found = f"{', '.join(missing)} is in none of the streams {reach}" if there else f"no such stream {reach}"
            raise BadSource(
                f"lsl:{self._name}: {found}, within {self._wait_s:g} s; name streams {self._name}-<segment>, or look "
                f"further with lsl:{self._name}@site"
            )
        self.sensors = self.sensors or tuple(segment for segment in SEGMENTS if segment in there)
        rates = {stream.rate_hz for stream in self._streams.values()}
        self.rate_hz = rates.pop() if len(rates) == 1 and min(rates) > 0.0 else None
        self._keeper = threading.Thread(target=self._keep, name=f"lsl {self._name}", daemon=True)
        self._keeper.start()

    def read(self, timeout_s: float) -> list[Samples]:
        """What came, one `Samples` a sensor."""
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

    def clock(self) -> float:
        """Now [s], liblsl's local clock."""
        return float(self._lsl.local_clock())

    def close(self) -> None:
        """Unsubscribe."""
        self._stop.set()
        if self._keeper is not None:
            self._keeper.join()
            self._keeper = None
        self._streams.clear()

    def _pull(self, stream: _Stream) -> list[Samples]:
        if stream.lost:
            return []
        try:
            rows, times = stream.inlet.pull_chunk(timeout=0.0, max_samples=MOST_SAMPLES)
        except RuntimeError:  # pylsl's LostError is one
            stream.lost = True
            self._count(f"streams lost: {stream.name}")
            return []
        if not len(times):
            return []
        stream.heard = time.monotonic()
        stamps, table = np.array(times), np.array(rows, dtype=float)
        samples = []
        for part in stream.parts:
            if part.sensor not in self.sensors:
                continue
            own, values = stamps, table[:, part.channels] * part.scale
            good = sound(own, values)
            if not good.all():
                self._count(UNSOUND, int((~good).sum()))
                own, values = own[good], values[good]
            if len(own):
                samples.append(Samples(part.sensor, own, values[:, :3], values[:, 3:]))
        return samples

    def _count(self, problem: str, number: int = 1) -> None:
        self.problems[problem] = self.problems.get(problem, 0) + number

    def _resolve(self, timeout_s: float) -> dict[str, Any]:
        """Stream's name → description, of those that answer in this time; of two with one name the newer."""
        name = self._name
        query = f"name='{name}' or starts-with(name,'{name}-') or starts-with(name,'{name}_')"
        found = self._lsl.resolve_bypred(query, minimum=MOST_STREAMS, timeout=timeout_s)
        return {info.name(): info for info in sorted(found, key=lambda info: info.created_at())}

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
        labels, units = _described(full)
        parts = layout(stream, self._name, labels, units, full.channel_count())
        return _Stream(stream, inlet, parts, float(full.nominal_srate()))

    def _keep(self) -> None:
        """Take up streams again that were lost or are silent."""
        while not self._stop.wait(RETRY_S):
            now = time.monotonic()
            gone = [name for name, stream in self._streams.items() if stream.lost or now - stream.heard > SILENT_S]
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


class _Stream:
    """An inlet and what is in it."""

    def __init__(self, name: str, inlet: Any, parts: Sequence[Part], rate_hz: float) -> None:
        self.name, self.inlet, self.parts, self.rate_hz = name, inlet, parts, rate_hz
        self.heard = time.monotonic()
        self.lost = False


def _described(info: Any) -> tuple[list[str], list[str]]:
    """Labels and units of the channels, as far as the description goes."""
    labels: list[str] = []
    units: list[str] = []
    channel = info.desc().child("channels").child("channel")
    while not channel.empty() and len(labels) < info.channel_count():
        labels.append(channel.child_value("label"))
        units.append(channel.child_value("unit"))
        channel = channel.next_sibling("channel")
    return labels, units


def pylsl_within(scope: str | None) -> tuple[Any, str]:
    """The module, set to look as far as `scope`; and how far that is."""
    global _scope
    try:
        import pylsl
    except (ImportError, RuntimeError) as error:  # RuntimeError: pylsl is there and finds no liblsl
        raise BadSource(f"lsl: pylsl is not usable ({error}); pip install 'wepose-pin[live]'") from None
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
