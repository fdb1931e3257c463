"""A live session: source, sensor setup, recording and outputs together."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ..errors import BadSession, ExistingOutput
from ..filters import BEST
from ..model import BodyModel
from ..subject import Subject, load_subject
from ..writers.live_log import LiveLog
from ..writers.result import versions
from .loop import EMPTY_SESSION, LiveLoop, SessionSummary, warm_up
from .setup import SensorSetup, read_setup
from .sources.base import Source
from .sources.replay import ReplaySource
from .state import Output, Status


def find_setup(source: Source | None, subject: str | Path | None, session: str | Path | None) -> SensorSetup:
    """The sensor setup: of a replay that of its session, else as `session` states.

    Raises
    ------
    WeposeError
        What is wrong in either file.
    """
    loaded: Subject | None = None
    text = ""
    if subject is not None:
        loaded, path = load_subject(subject), Path(subject)
        text = (path / "subject.toml" if path.is_dir() else path).read_text(encoding="utf-8")
    if session is not None:
        return read_setup(Path(session), loaded, text)
    if isinstance(source, ReplaySource):
        return SensorSetup.from_recording(source.recording, loaded, text)
    return SensorSetup(subject=loaded, subject_text=text)


def run_session(
    source: Source,
    setup: SensorSetup,
    *,
    method: str = BEST,
    model: BodyModel | str | Path | None = None,
    record: str | Path | None = None,
    force: bool = False,
    outputs: Sequence[Output] = (),
    until: Callable[[], bool] = lambda: False,
) -> SessionSummary:
    """Open the source, track it to its end, close everything.

    Without `record` the first take begins a recording in the current folder, named by date and time.

    Raises
    ------
    WeposeError
        No such source; a sensor whose mount is not known; an existing file.
    """
    setup, record = setup.as_recorded().with_model(model), None if record is None else Path(record)
    if record is not None and record.exists() and not force:
        raise ExistingOutput(f"{record}: exists; --force replaces it, --record names another file")
    check_mounts(source, setup)
    warm_up(method)  # before samples come
    if not open_and_wait(source, outputs, until):
        for output in outputs:
            output.close()
        return EMPTY_SESSION
    log = None
    try:
        check_mounts(source, setup)
        header = setup.header(source.sensors, source.orientations) | {"method": method, "versions": versions()}
        if record is not None:
            log = LiveLog(record, header, force)
        begin = float(source.recording.time[0]) if isinstance(source, ReplaySource) else None
        loop = LiveLoop(
            source,
            setup,
            method=method,
            model=model,
            log=log,
            open_log=lambda: LiveLog(Path(time.strftime("wepose-%Y%m%d-%H%M%S.mcap")), header),
            outputs=outputs,
            begin=begin,
        )
    except BaseException:
        source.close()
        if log is not None:
            log.close()
        raise
    return loop.run(until)


def open_and_wait(source: Source, outputs: Sequence[Output], until: Callable[[], bool]) -> bool:
    """Open the source and show what it waits for; return False where the user ends that by a key.

    Raises
    ------
    KeyboardInterrupt
        `until` returns True meanwhile.
    """
    stopped = False

    def show(message: str) -> bool:
        nonlocal stopped
        for output in outputs:
            output.status(Status("waiting", message, 0.0, 0.0, (), (0.0, 0.0), 0.0, dict(source.problems)))
        if until():
            raise KeyboardInterrupt
        stopped = "q" in [key for output in outputs for key in output.take_keys()]
        return not stopped

    try:
        source.open(show)
    except KeyboardInterrupt:
        source.close()
        raise
    if stopped:
        source.close()
    return not stopped


def check_mounts(source: Source, setup: SensorSetup) -> None:
    """Raise `BadSession` where the mount of a sensor is not known, and its orientation is not the segment's own."""
    calibrated = setup.subject.mounts if setup.subject is not None and not setup.remounted else {}
    sensors = [name for name in source.sensors if not source.orientations.get(name)]
    unknown = [name for name in sensors if name not in calibrated and name not in setup.mounts]
    nothing_known = not (source.sensors or calibrated or setup.mounts)
    if unknown or nothing_known:
        segment = unknown[0] if unknown else "SEGMENT"
        sensor = f"the sensor of {segment} is" if unknown else "the sensors are"
        raise BadSession(
            f"{setup.name}: how {sensor} mounted is not known: find it out with --guide, or give --subject with "
            f'calibrated mounts, or --session with [sensors.{segment}] mount = {{ up = "+x", forward = "-z" }}'
        )
