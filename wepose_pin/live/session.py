"""A live session from the command line's point of view: source, wearer, file and outputs put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ..errors import BadSession, ExistingOutput
from ..filters import BEST
from ..model import BodyModel
from ..recording import Recording
from ..subject import Subject, load_subject
from ..writers.live_log import LiveLog
from ..writers.result import versions
from .loop import Ended, LiveLoop, Output, warm
from .setup import SensorSetup, read_setup
from .sources.base import Source
from .sources.replay import ReplaySource


def find_setup(source: Source | None, subject: str | Path | None, session: str | Path | None) -> SensorSetup:
    """Who wears the sensors: of a replay as its session has it, else as `session` states.

    Raises
    ------
    WeposeError
        What is wrong in either file.
    """
    who: Subject | None = None
    text = ""
    if subject is not None:
        who = load_subject(subject)
        path = Path(subject)
        text = (path / "subject.toml" if path.is_dir() else path).read_text(encoding="utf-8")
    if session is not None:
        return read_setup(Path(session), who, text)
    if isinstance(source, ReplaySource):
        return SensorSetup.from_recording(source.recording, who, text)
    return SensorSetup(subject=who, subject_text=text)


def run_session(
    source: Source,
    setup: SensorSetup,
    *,
    method: str = BEST,
    model: BodyModel | None = None,
    record: str | Path | None = None,
    force: bool = False,
    outputs: Sequence[Output] = (),
    until: Callable[[], bool] = lambda: False,
) -> Ended:
    """Open the source, follow it to its end, close everything.

    Raises
    ------
    WeposeError
        No such source; a sensor whose mount nobody knows; a file that is there.
    """
    setup, record = setup.as_recorded(), None if record is None else Path(record)
    if record is not None and record.exists() and not force:
        raise ExistingOutput(f"{record}: exists; --force replaces it, --record names another file")
    _check_mounts(source.sensors, setup)
    warm(method)  # while nothing is lost by it
    source.open()
    log = None
    try:
        _check_mounts(source.sensors, setup)
        if record is not None:
            header = setup.header(source.sensors) | {"method": method, "versions": versions()}
            log = LiveLog(record, header, force)
        begin = _begin(source.recording) if isinstance(source, ReplaySource) else None
        loop = LiveLoop(source, setup, method=method, model=model, log=log, outputs=outputs, begin=begin)
    except BaseException:
        source.close()
        if log is not None:
            log.close()
        raise
    return loop.run(until)


def _begin(recording: Recording) -> float:
    return float(recording.time[0])


def _check_mounts(sensors: Sequence[str], setup: SensorSetup) -> None:
    """Before anybody stands still: each sensor's mount is known."""
    calibrated = setup.subject.mounts if setup.subject is not None and not setup.remounted else {}
    unknown = [name for name in sensors if name not in calibrated and name not in setup.mounts]
    if unknown:
        raise BadSession(
            f"{setup.name}: how the sensor of {unknown[0]} is mounted is not known: give --subject with calibrated "
            f'mounts, or --session with [sensors.{unknown[0]}] mount = {{ up = "+x", forward = "-z" }}'
        )
