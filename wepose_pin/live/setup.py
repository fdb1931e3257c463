"""`SensorSetup`: the subject and the mounts of the sensors, as far as known before the first sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..model.table import NEUTRAL_POSE
from ..readers.session_file import find_model, read_joints, read_phases, read_sensor_keys, read_session_file
from ..recording import Intervals, Recording
from ..subject import Subject, parse_subject, subject_toml


@dataclass(frozen=True)
class SensorSetup:
    """A subject and the mounts of the sensors.

    Parameters
    ----------
    subject : lengths and calibrated mounts; None: the population prior and stated mounts
    subject_text : the ``subject.toml`` it was read from, if any
    mounts : segment → stated `quat_LS` (4,) xyzw
    phases : of a replay: `start` and `static` [s]; without `start` the loop searches the start pose
    start_pose, joints, model : as in `Recording`
    """

    name: str = "live"
    subject: Subject | None = None
    subject_text: str = ""
    mounts: Mapping[str, np.ndarray] = field(default_factory=dict)
    phases: Mapping[str, Intervals] = field(default_factory=dict)
    start_pose: str = NEUTRAL_POSE
    remounted: bool = False
    joints: Mapping[str, float] = field(default_factory=dict)
    model: str = ""

    @classmethod
    def from_recording(
        cls, recording: Recording, subject: Subject | None = None, subject_text: str = ""
    ) -> SensorSetup:
        """The setup of a recording that is replayed."""
        return cls(
            recording.name,
            subject,
            subject_text,
            {n: s.stated_quat_LS for n, s in recording.sensors.items() if s.stated_quat_LS is not None},
            recording.phases,
            recording.start_pose,
            recording.remounted,
            recording.joints,
            recording.model,
        )

    def with_model(self, model: object) -> SensorSetup:
        """With the file or the name of a body in place of its own; as it is where `model` is neither."""
        if not isinstance(model, str | Path):
            return self
        return replace(self, model=str(Path(model).absolute() if Path(model).is_file() else model))

    def as_recorded(self) -> SensorSetup:
        """With the subject as a reader of the recording gets it: rounded to the decimals of its text."""
        if self.subject is None or self.subject_text:
            return self
        text = subject_toml(self.subject)
        return replace(self, subject=parse_subject(text, Path("subject.toml")), subject_text=text)

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
            "subject": self.subject_text or None,
        }


def read_setup(path: Path, subject: Subject | None = None, subject_text: str = "") -> SensorSetup:
    """The setup that a session file states; its data and phases belong to another recording and are ignored.

    Raises
    ------
    MissingFile, BadSession
        Not there, or a key in it that no session has.
    """
    top = read_session_file(path)
    read_phases(top.table("phases", {}))
    sensors = top.table("sensors")
    stated = {segment: read_sensor_keys(sensors.table(segment)).mount for segment in sensors.values}
    start_pose = top.text("start_pose", NEUTRAL_POSE) or NEUTRAL_POSE
    return SensorSetup(
        top.text("name", None) or Path(top.file).absolute().parent.name,
        subject,
        subject_text,
        {segment: mount for segment, mount in stated.items() if mount is not None},
        start_pose=start_pose,
        remounted=top.flag("remounted"),
        joints=read_joints(top, start_pose),
        model=find_model(Path(top.file), top),
    )
