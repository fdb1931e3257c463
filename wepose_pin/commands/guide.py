"""The guided session of ``wepose live --guide``: from sensors that send to a subject, a setup and a source to track."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..errors import ExistingOutput

if TYPE_CHECKING:
    from ..body import BodyModel
    from ..calibration import Calibration
    from ..live import Output, SensorSetup
    from ..live.assignment import AssignedSource
    from ..live.guide import Calibrated
    from ..live.sources.base import Source
    from ..recording import Recording

SUBJECT_FILES = ("subject.toml", "subject.urdf", "calibration.json", "report.html")


def make_guide_folder(out: Path | None, force: bool) -> Path:
    """Make the folder of a guided session; raises `ExistingOutput` where it holds a subject, or cannot be made."""
    folder = out or Path(time.strftime("wepose-%Y%m%d-%H%M%S"))
    if (folder / "subject.toml").exists() and not force:
        raise ExistingOutput(f"{folder}: holds a subject; --force replaces it, -o names another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExistingOutput(f"{folder}: cannot be made: {error.strerror}") from error
    return folder


def run_guide(
    source: Source,
    setup: SensorSetup,
    model: BodyModel,
    views: Sequence[Output],
    until: Callable[[], bool],
    *,
    folder: Path,
    protocol: str | None,
    measured: Mapping[str, float],
    stature: float | None,
    sex: Literal["f", "m"] | None,
    subject: Path | None,
    setup_folder: Path | None,
    method: str,
) -> tuple[AssignedSource, SensorSetup] | None:
    """Lead the person to an accepted calibration, and save its subject; None where it was ended before.

    Returns the source and the setup to track with; the source stays open then, and the views always.

    Parameters
    ----------
    source : not open
    folder, protocol, measured, stature, sex, subject, setup_folder, method : as the options of `wepose live`
    """
    from ..body.subject import load_subject, population_subject
    from ..calibration import calibrate, load_protocol
    from ..calibration.protocols import split_protocol
    from ..live.assignment import read_segments, write_segments
    from ..live.guide import Calibrated, Guide, GuideOptions
    from ..live.loop import open_and_wait, warm_up
    from ..live.steps import STATURE, make_steps
    from ..readers import load_session
    from ..readers.mvnx import read_subject
    from ..report.calibration import write_calibration_page
    from ..writers.calibration import write_calibration
    from ..writers.provenance import collect_provenance, result_folder

    joined = protocol or choose_protocol(source, setup, model)
    later = [load_protocol(part) for part in split_protocol(joined)[1:]]
    earlier = None if subject is None else read_subject(subject)
    prior = earlier or population_subject(stature, sex, model)

    def calibrate_file(path: Path, told: Mapping[str, float]) -> Calibrated:
        lengths = {**measured, **told}
        recording = load_session(path)
        steps = choose_parts(joined, recording.phases)
        calibration = calibrate(
            recording,
            measured={name: value for name, value in lengths.items() if name != STATURE},
            prior=earlier,
            stature=lengths.get(STATURE, stature),
            sex=sex,
            protocol=steps,
            method=method,
        )
        options = {"session": path, "protocol": steps, "measured": lengths, "prior": subject, "method": method}
        out = path.with_suffix("")
        with result_folder(out, force=True) as partial:
            write_calibration(partial, calibration, collect_provenance("calibrate", options))
        write_calibration_page(out, calibration, recording, method=method)
        return Calibrated(calibration, out)

    def estimate(recording: Recording) -> Calibration:
        steps = choose_parts(joined, recording.phases)
        return calibrate(recording, measured=measured, prior=prior, model=model, protocol=steps, method=method)

    options = GuideOptions(
        folder,
        load_protocol(joined),
        replace(setup, remounted=True),
        model,
        calibrate_file,
        estimate,
        method,
        {} if setup_folder is None else read_segments(setup_folder, tuple(model.table.segments)),
        frozenset(step.phase for part in later for step in part.steps if step.phase != "start"),
        frozenset({*measured, *([STATURE] if stature is not None or subject is not None else [])}),
    )
    threading.Thread(target=warm_up, args=(method,), daemon=True).start()  # tracking begins without a wait then
    if not open_and_wait(source, views, until):
        return None
    guide = Guide(source, options, make_steps(options.protocol), views)
    calibrated = guide.run(until)
    if calibrated is None:
        source.close()
        return None
    for name in SUBJECT_FILES:
        if (calibrated.folder / name).is_file():
            shutil.copyfile(calibrated.folder / name, folder / name)
    write_segments(folder, guide.segments)
    text = (folder / "subject.toml").read_text(encoding="utf-8")
    tracked = replace(setup, subject=load_subject(folder), subject_text=text, remounted=False, mounts={})
    return guide.assign_source(), tracked


def choose_protocol(source: Source, setup: SensorSetup, model: BodyModel) -> str:
    """Choose the protocol where none is named: a bow follows where else nothing shows the reference's heading."""
    from ..calibration.protocols import BOW, GUIDED

    known = model.table.is_mechanism or model.table.reference in setup.mounts
    return f"{GUIDED}+{BOW}" if source.measures_orientations and not known else GUIDED


def choose_parts(protocol: str, phases: Collection[str]) -> str:
    """Choose the parts of a joined protocol whose phases are there, all where none is: a part may be skipped."""
    from ..calibration import load_protocol
    from ..calibration.protocols import split_protocol

    parts = [part for part in split_protocol(protocol) if {s.phase for s in load_protocol(part).steps} <= {*phases}]
    return "+".join(parts) or protocol
