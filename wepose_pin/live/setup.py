"""What is known before the first sample: the subject, the body, the sensors' mounts and segments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..body import BodyModel
from ..body.body import load_sensed_model
from ..body.subject import Subject, load_subject, population_subject, subject_toml
from ..body.table import NEUTRAL_POSE
from ..documents import format_value, read_toml, toml_key
from ..errors import BadSession
from ..readers import SensorKeys, read_head, read_sensor_keys, read_session_file
from ..recording import Intervals, Recording
from ..recording.arrivals import Samples
from .sources import Source
from .sources.replay import ReplaySource

SETUP_FILE = "setup.toml"


@dataclass(frozen=True)
class SensorSetup:
    """A subject and the mounts of the sensors; `start_pose`, `joints` and `model` as in `Recording`."""

    name: str = "live"
    subject: Subject | None = None  # lengths and calibrated mounts; None: the population prior and stated mounts
    mounts: Mapping[str, np.ndarray] = field(default_factory=dict)  # segment → stated `quat_LS` (4,) xyzw
    phases: Mapping[str, Intervals] = field(default_factory=dict)  # [s]; without `start` the loop searches it
    start_pose: str = NEUTRAL_POSE
    remounted: bool = False
    joints: Mapping[str, float] = field(default_factory=dict)
    model: str = ""

    @classmethod
    def from_recording(cls, recording: Recording, subject: Subject | None = None) -> SensorSetup:
        mounts = {n: s.stated_quat_LS for n, s in recording.sensors.items() if s.stated_quat_LS is not None}
        keys = ("name", "phases", "start_pose", "remounted", "joints", "model")
        return cls(subject=subject, mounts=mounts, **{key: getattr(recording, key) for key in keys})

    def header(self, sensors: Sequence[str], orientations: Mapping[str, bool] | None = None) -> dict[str, Any]:
        """Header of the recording of a live session, without the method; `orientations` as of a `Source`."""
        return {key: getattr(self, key) for key in ("name", "start_pose", "remounted", "model")} | {
            "phases": dict(self.phases),
            "sensors": list(sensors),
            "orientations": dict(orientations or {}),
            "mounts": {name: np.asarray(quat).tolist() for name, quat in self.mounts.items() if name in sensors},
            "joints": dict(self.joints),
            "subject": None if self.subject is None else subject_toml(self.subject),
        }


def find_setup(
    source: Source | None, subject: str | Path | None, session: str | Path | None, model: str | Path | None = None
) -> SensorSetup:
    """The sensor setup: of a replay that of its session, else as `session` states; with this body, if one is named.

    Raises `WeposeError` where there is no such file, or it is damaged.
    """
    setup = SensorSetup()
    if session is not None:  # whose data and phases belong to another recording
        top = read_session_file(Path(session))
        head, sensors = read_head(top), top.table("sensors")
        stated = {segment: read_sensor_keys(sensors.table(segment), SensorKeys()).mount for segment in sensors.values}
        mounts = {segment: mount for segment, mount in stated.items() if mount is not None}
        setup = replace(SensorSetup.from_recording(head), mounts=mounts, phases={})
    elif isinstance(source, ReplaySource):
        setup = SensorSetup.from_recording(source.recording)
    if model is not None:
        setup = replace(setup, model=str(Path(model).absolute() if Path(model).is_file() else model))
    return replace(setup, subject=None if subject is None else load_subject(subject))


def check_mounts(source: Source, setup: SensorSetup) -> None:
    """Raise `BadSession` where the mount of a sensor is not known, and its orientation is not the segment's own."""
    calibrated = setup.subject.mounts if setup.subject is not None and not setup.remounted else {}
    known = {*calibrated, *setup.mounts}
    unknown = [name for name in source.sensors if name not in known and not source.orientations.get(name)]
    if unknown or not (source.sensors or known):
        segment = unknown[0] if unknown else "SEGMENT"
        sensor = f"the sensor of {segment} is" if unknown else "the sensors are"
        raise BadSession(
            f"{setup.name}: how {sensor} mounted is not known: find it out with --guide, or give --subject with "
            f'calibrated mounts, or --session with [sensors.{segment}] mount = {{ up = "+x", forward = "-z" }}'
        )


def build_subject_model(setup: SensorSetup, sensors: Sequence[str] = (), model: BodyModel | None = None) -> BodyModel:
    """Return `model`, else the body that the setup names, else the upper body, with the subject's lengths.

    Without a subject a chosen body has its own lengths, the upper body those of the population prior. `sensors` are
    those of the source where it knows them; without them those of the setup.
    """
    chosen = model or setup.model or None
    body = model or load_sensed_model(setup.model or None, tuple(sensors) or tuple(setup.mounts), setup.name)
    if setup.subject is None and chosen is not None:
        return body
    return (setup.subject or population_subject(body=body)).shape(body, remounted=setup.remounted)


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
        return None if samples is None else rename_sensors(samples, self.segments)

    def describe_awaited(self) -> str:
        return self.source.describe_awaited()

    def clock(self) -> float:
        return self.source.clock()

    def close(self) -> None:
        self.source.close()


def rename_sensors(samples: Iterable[Samples], segments: Mapping[str, str]) -> list[Samples]:
    """The samples of the sensors that are assigned to `segments`, named by these."""
    return [each._replace(sensor=segments[each.sensor]) for each in samples if each.sensor in segments]


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
    lines += [f"{toml_key(sensor)} = {format_value(segment)}" for sensor, segment in segments.items()]
    (folder / SETUP_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
