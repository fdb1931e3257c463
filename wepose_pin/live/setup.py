"""What is known before the first sample: the subject, the mounts of the sensors, the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..body import BodyModel
from ..body.body import load_sensed_model
from ..body.subject import Subject, load_subject, population_subject, subject_toml
from ..body.table import NEUTRAL_POSE
from ..errors import BadSession
from ..readers.session_file import SensorKeys, read_head, read_sensor_keys, read_session_file
from ..recording import Intervals, Recording
from .sources.base import Source
from .sources.replay import ReplaySource


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
        named = {
            key: getattr(recording, key) for key in ("name", "phases", "start_pose", "remounted", "joints", "model")
        }
        return cls(subject=subject, mounts=mounts, **named)

    def header(self, sensors: Sequence[str], orientations: Mapping[str, bool] | None = None) -> dict[str, Any]:
        """Header of the recording of a live session, without the method; `orientations` as of a `Source`."""
        return {
            "name": self.name,
            "sensors": list(sensors),
            "orientations": dict(orientations or {}),
            "mounts": {name: np.asarray(quat).tolist() for name, quat in self.mounts.items() if name in sensors},
            "phases": {name: [list(span) for span in spans] for name, spans in self.phases.items()},
            "start_pose": self.start_pose,
            "remounted": self.remounted,
            "joints": dict(self.joints),
            "model": self.model,
            "subject": None if self.subject is None else subject_toml(self.subject),
        }


def find_setup(
    source: Source | None, subject: str | Path | None, session: str | Path | None, model: str | Path | None = None
) -> SensorSetup:
    """The sensor setup: of a replay that of its session, else as `session` states; with this body, if one is named.

    Raises `WeposeError` where there is no such file, or it is damaged.
    """
    setup = SensorSetup()
    if session is not None:
        setup = read_setup(Path(session))
    elif isinstance(source, ReplaySource):
        setup = SensorSetup.from_recording(source.recording)
    if model is not None:
        setup = replace(setup, model=str(Path(model).absolute() if Path(model).is_file() else model))
    return replace(setup, subject=None if subject is None else load_subject(subject))


def read_setup(path: Path) -> SensorSetup:
    """The setup that a session file states; its data and phases belong to another recording and are ignored."""
    top = read_session_file(path)
    sensors = top.table("sensors")
    stated = {segment: read_sensor_keys(sensors.table(segment), SensorKeys()).mount for segment in sensors.values}
    head = read_head(top)
    named = {key: getattr(head, key) for key in ("start_pose", "remounted", "joints", "model")}
    return SensorSetup(head.name, mounts={name: mount for name, mount in stated.items() if mount is not None}, **named)


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
