"""The guided session of ``wepose live --guide``: from sensors that send to a subject, a setup and a source to track."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import ExistingOutput
from .calibrate import CalibrateJob, run_calibrate

if TYPE_CHECKING:
    from ..calibration import Calibration, CalibrationQuality
    from ..live import Output, SensorSetup
    from ..live.assignment import AssignedSource
    from ..live.guide import Calibrated, GuideOptions
    from ..live.sources.base import Source
    from ..model import BodyModel
    from ..recording import Recording
    from .live import LiveJob

SUBJECT_FILES = ("subject.toml", "subject.urdf", "calibration.json", "report.html")


class GuidedOutcome(NamedTuple):
    """What a guided session hands over to tracking."""

    source: AssignedSource
    setup: SensorSetup
    folder: Path
    calibrated: Calibrated


def make_guide_folder(job: LiveJob) -> Path:
    """Make the folder of a guided session, or use that of `job.out`.

    Raises
    ------
    ExistingOutput
        It holds a subject and --force is not given, or it cannot be made.
    """
    folder = job.out or Path(time.strftime("wepose-%Y%m%d-%H%M%S"))
    if (folder / "subject.toml").exists() and not job.force:
        raise ExistingOutput(f"{folder}: holds a subject; --force replaces it, -o names another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExistingOutput(f"{folder}: cannot be made: {error.strerror}") from error
    return folder


def run_guide(
    job: LiveJob,
    source: Source,
    setup: SensorSetup,
    model: BodyModel,
    views: Sequence[Output],
    until: Callable[[], bool],
) -> GuidedOutcome | None:
    """Lead the person to an accepted calibration, and save its subject; None where it was ended before.

    Parameters
    ----------
    source : not open; it stays open where there is an outcome
    views : stay open
    """
    from ..live.assignment import write_segments
    from ..live.guided import GuidedSession
    from ..live.loop import warm_up
    from ..live.session import open_and_wait

    folder = make_guide_folder(job)
    protocol = job.protocol or choose_protocol(source, setup, model)
    options = _make_options(job, protocol, folder, setup, model)
    threading.Thread(target=warm_up, args=(job.method,), daemon=True).start()  # tracking begins without a wait then
    if not open_and_wait(source, views, until):
        return None
    session = GuidedSession(source, options, model, views)
    calibrated = session.run(until)
    if calibrated is None:
        source.close()
        return None
    for name in SUBJECT_FILES:
        if (calibrated.folder / name).is_file():
            shutil.copyfile(calibrated.folder / name, folder / name)
    write_segments(folder, session.guide.segments)
    subject_text = (folder / "subject.toml").read_text(encoding="utf-8")
    tracked = replace(setup, subject=None, subject_text=subject_text, remounted=False, mounts={})
    return GuidedOutcome(session.guide.assigned(), _with_subject(tracked, folder), folder, calibrated)


def _with_subject(setup: SensorSetup, folder: Path) -> SensorSetup:
    from ..subject import load_subject

    return replace(setup, subject=load_subject(folder))


def choose_protocol(source: Source, setup: SensorSetup, model: BodyModel) -> str:
    """Choose the protocol where none is named: a bow follows where else nothing shows the reference's heading."""
    from ..calibration.protocols import BOW, GUIDED

    known = model.table.is_mechanism or model.table.reference in setup.mounts
    return f"{GUIDED}+{BOW}" if source.measures_orientations and not known else GUIDED


def _make_options(job: LiveJob, joined: str, folder: Path, setup: SensorSetup, model: BodyModel) -> GuideOptions:
    """What the guide does, by the functions that `wepose calibrate` calls too."""
    from ..calibration import assess, calibrate, load_protocol
    from ..calibration.protocols import split_protocol
    from ..live.assignment import read_segments
    from ..live.guide import Calibrated, GuideOptions
    from ..live.guide_motion import STATURE
    from ..readers import load_session
    from ..readers.subject import read_subject
    from ..subject import population_subject

    protocol, parts = load_protocol(joined), split_protocol(joined)
    prior = read_subject(job.subject) if job.subject else population_subject(job.stature, None, model)
    order = tuple(model.table.segments)

    def calibrate_file(path: Path, measured: Mapping[str, float]) -> Calibrated:
        out, lengths = path.with_suffix(""), {**job.measured, **measured}
        stature = lengths.pop(STATURE, job.stature)
        calibration = CalibrateJob(
            path,
            out,
            protocol=choose_parts(joined, load_session(path).phases),
            measured=lengths,
            stature=stature,
            prior=job.subject,
            method=job.method,
            force=True,
        )
        outcome = run_calibrate(calibration)
        return Calibrated(outcome.calibration, outcome.quality, out)

    def estimate(recording: Recording) -> tuple[Calibration, CalibrationQuality]:
        calibration = calibrate(
            recording,
            measured=dict(job.measured),
            prior=prior,
            model=model,
            protocol=load_protocol(choose_parts(joined, recording.phases)),
            method=job.method,
        )
        return calibration, assess(calibration)

    return GuideOptions(
        folder,
        protocol,
        replace(setup, remounted=True),
        model.table,
        {name: _depth(model, name) for name in order},
        calibrate_file,
        estimate,
        job.method,
        {} if job.setup is None else read_segments(job.setup, order),
        frozenset(step.phase for part in parts[1:] for step in load_protocol(part).steps if step.phase != "start"),
        frozenset({*job.measured, *([STATURE] if job.stature is not None or job.subject is not None else [])}),
    )


def choose_parts(protocol: str, phases: Collection[str]) -> str:
    """Choose the parts of a joined protocol whose phases are there, all where none is: a part may be skipped."""
    from ..calibration import load_protocol
    from ..calibration.protocols import split_protocol

    there = [
        part for part in split_protocol(protocol) if all(step.phase in phases for step in load_protocol(part).steps)
    ]
    return "+".join(there) or protocol


def _depth(model: BodyModel, segment: str) -> int:
    """Number of segments between this one and the root."""
    above = model.parents.get(segment)
    return 0 if above is None else 1 + _depth(model, above)
