"""Which sensor sits on which segment: found by shaking, kept in a file, applied to a source."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..documents import read_toml, toml_key, toml_string, whole_file
from ..errors import BadSession
from ..recording.arrivals import Samples, unpack_orientations
from .sources.base import Source

SETUP_FILE = "setup.toml"
SHAKE_WINDOW_S = 0.8  # [s] newest samples by which a shake is detected
SHAKE_RATE = 2.5  # [rad/s] rms of a sensor that is shaken; a person who stands is below 0.1
CALM_RATE = 0.6  # [rad/s] below which all must be before the next shake counts
SHORTEST_STEP_S = 2e-3  # [s] between two orientations: of a tracker that does not tell its time they come in bursts
SHAKE_RATIO = 1.6  # of the shaken sensor's rms to that of every other candidate


class ShakeDetector:
    """Detects which sensor is shaken; after one was found, all must come to rest before the next."""

    def __init__(self) -> None:
        self.is_calm = False  # all have come to rest since the last shake: the next one counts
        self._recent: dict[str, deque[tuple[float, float]]] = {}  # sensor → time [s], squared rate [rad²/s²]
        self._last: dict[str, tuple[float, np.ndarray]] = {}  # sensor → time [s] and (4,) of its last orientation

    def push(self, samples: Iterable[Samples], measured: Collection[str] = ()) -> None:
        """Add samples of any sensors; those of `measured` are orientations."""
        for chunk in samples:
            squares = np.sum(chunk.gyro_S**2, axis=1)
            if chunk.sensor in measured:  # from each orientation to the next
                quat = unpack_orientations(chunk.gyro_S, chunk.accel_S)
                last_time, last_quat = self._last.get(chunk.sensor, (chunk.time[0], quat[0]))
                self._last[chunk.sensor] = float(chunk.time[-1]), quat[-1]
                cosine = np.abs(np.sum(np.concatenate([last_quat[None], quat[:-1]]) * quat, axis=1))
                step_s = np.maximum(np.diff(chunk.time, prepend=last_time), SHORTEST_STEP_S)
                squares = (2.0 * np.arccos(np.minimum(cosine, 1.0)) / step_s) ** 2
            recent = self._recent.setdefault(chunk.sensor, deque())
            recent.extend(zip(chunk.time.tolist(), squares.tolist(), strict=True))
            while recent[0][0] < recent[-1][0] - SHAKE_WINDOW_S:
                recent.popleft()

    def find(self, candidates: Sequence[str]) -> str | None:
        """The candidate that is shaken; None: none, several, or those of the last shake still move."""
        rates = self._find_rates()
        if not self.is_calm:
            self.is_calm = max(rates.values(), default=0.0) < CALM_RATE
            return None
        second, first = sorted([(0.0, ""), (0.0, ""), *((rates.get(sensor, 0.0), sensor) for sensor in candidates)])[
            -2:
        ]
        if first[0] < max(SHAKE_RATE, SHAKE_RATIO * second[0]):
            return None
        self.is_calm = False
        return first[1]

    def list_moving(self) -> list[str]:
        return [sensor for sensor, rate in self._find_rates().items() if rate > CALM_RATE]

    def _find_rates(self) -> dict[str, float]:
        """Sensor → rms rate [rad/s] of those that were seen for as long as a shake takes."""
        return {
            sensor: float(np.sqrt(np.mean([square for _, square in recent])))
            for sensor, recent in self._recent.items()
            if recent[-1][0] - recent[0][0] > 0.75 * SHAKE_WINDOW_S
        }


class AssignedSource(Source):
    """A source whose sensors are named by the segments that they are assigned to.

    `segments` are sensor of the source → segment, in this `order`; other sensors are left out. The source may be open.
    """

    def __init__(
        self, source: Source, segments: Mapping[str, str], order: Iterable[str], is_open: bool = False
    ) -> None:
        super().__init__((segment for segment in order if segment in segments.values()), source.rate_hz)
        self.source, self.segments, self._is_open = source, dict(segments), is_open
        self.problems, self.begin = source.problems, source.begin

    @property
    def orientations(self) -> dict[str, bool]:
        return {self.segments[name]: own for name, own in self.source.orientations.items() if name in self.segments}

    @property
    def batteries(self) -> dict[str, float]:
        return {self.segments[name]: charge for name, charge in self.source.batteries.items() if name in self.segments}

    def open(self) -> None:
        if self._is_open:
            while self.source.read(0.0):
                pass
        else:
            self.source.open()

    def connect(self, timeout_s: float) -> bool:
        return self._is_open or self.source.connect(timeout_s)

    def read(self, timeout_s: float) -> list[Samples] | None:
        samples = self.source.read(timeout_s)
        return None if samples is None else self.rename(samples)

    def rename(self, samples: Iterable[Samples]) -> list[Samples]:
        """The samples of the assigned sensors, named by their segments."""
        return [each._replace(sensor=self.segments[each.sensor]) for each in samples if each.sensor in self.segments]

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        return self.source.describe_awaited([name for name, own in self.segments.items() if own in sensors])

    def explain_unit(self, key: str, unit: str) -> str:
        return self.source.explain_unit(key, unit)

    def clock(self) -> float:
        return self.source.clock()

    def close(self) -> None:
        self.source.close()


def read_segments(path: Path, known: Iterable[str]) -> dict[str, str]:
    """Sensor → segment, of a setup file or its folder; raises `BadSession` where one is not `known`, or named twice."""
    path = path / SETUP_FILE if path.is_dir() else path
    segments, names = read_toml(path, "a sensor setup", BadSession).get("sensors"), tuple(known)
    if not isinstance(segments, dict) or not segments:
        raise BadSession(f"{path}: has no [sensors]; `wepose live --guide` writes a sensor setup")
    for sensor, segment in segments.items():
        if segment not in names:
            raise BadSession(f"{path}: sensors.{sensor} = {segment!r} is not a segment; {', '.join(names)} are")
    if len(set(segments.values())) < len(segments):
        raise BadSession(f"{path}: [sensors] names a segment twice")
    return dict(segments)


def write_segments(folder: Path, segments: Mapping[str, str]) -> None:
    """Write the setup file that `read_segments` reads."""
    lines = ["format = 1", "", "[sensors]   # name that the source gives it = segment"]
    lines += [f"{toml_key(sensor)} = {toml_string(segment)}" for sensor, segment in segments.items()]
    with whole_file(folder / SETUP_FILE, force=True) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
