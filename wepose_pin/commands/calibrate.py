"""``wepose calibrate``: a recording of a protocol → the subject's lengths and mounts."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from ..diagnostics import lines
from ..errors import WrongOption
from . import options as opt
from .options import described_by
from .output import Outcome, print_diagnostics, print_table, progress_bar, say, say_pages, say_paragraph

EXIT_CODES = {"pass": 0, "poor": 3, "fail": 4}


@described_by("tracking/__init__.py:track", "calibration/procedure.py:calibrate", "readers/__init__.py:load_session")
def calibrate(
    session: Path,
    /,
    *,
    out: opt.Out,
    measured: opt.Measured | None = None,
    stature: opt.Stature | None = None,
    sex: Literal["f", "m"] | None = None,
    protocol: opt.ProtocolName | None = None,
    model: opt.Model | None = None,
    prior: opt.Subject | None = None,
    gaps: bool = False,
    report: bool = True,
    force: opt.Force = False,
    method: Annotated[opt.Method, opt.RESEARCH] = "amekf",
    formulation: Annotated[opt.Formulation, opt.RESEARCH] = "full",
) -> Outcome:  # of a Calibration
    """Calibrate lengths and sensor mounts from a recording of a protocol, such as joined hands.

    Joined hands determine the proportions of the arms and not their scale. Measure one length, such as the breadth of
    the shoulders, and give it with --measured. Without one the scale is that of the population prior, and the output
    says how uncertain it is.

    Exit code: 0 quality pass, 3 poor, 4 fail, by the limits in docs/calibrate.md; the files are written in all three
    cases; 2 invalid input, nothing is written.

    Example: wepose calibrate session.toml --measured biacromial=0.41 --stature 1.78 --sex f -o anna

    Parameters
    ----------
    session
        The recording: session.toml, or the folder that holds it. It names the phases of the protocol, such as clasp, in
        which the palms are held together.
    out
        Write subject.toml, subject.urdf, calibration.json (the quality and all numbers) and report.html to this folder.
    measured
        May be given several times, as in --measured biacromial=0.41 --measured trunk=0.50.
    prior
        SUBJECT is a subject.toml or its folder.
    report
        Write report.html, which shows the quality and what to do about it, lengths, mounts and the gap between the
        palms.
    """
    options = dict(locals())
    from .. import calibration as room
    from ..body.body import load_sensed_model
    from ..body.subject import load_subject
    from ..readers import load_session
    from ..report import calibration as report_room
    from ..report.page import write_pages
    from ..writers.result import collect_provenance, result_folder, write_calibration

    if prior is not None and (stature is not None or sex is not None):
        needed = "has the lengths of a person; --stature and --sex narrow those of the population"
        raise WrongOption("prior", prior, needed)
    with progress_bar() as progress, result_folder(out, force, ("report.html",)) as folder:
        progress("reading", 0.0)
        recording = load_session(session, gaps=gaps)
        body = load_sensed_model(model or recording.model or None, recording.sensors, recording.where())
        earlier = None if prior is None else load_subject(prior)
        progress("calibrating", 1 / 3)
        names = ("measured", "stature", "sex", "protocol", "method", "formulation")
        chosen: dict[str, Any] = {name: options[name] for name in names}
        calibration = room.calibrate(recording, prior=earlier, model=body, **chosen)
        write_calibration(folder, calibration, collect_provenance("calibrate", options))
        progress("writing the report", 2 / 3)
        make = partial(report_room.render_calibration_report, calibration, recording) if report else None
        failures = write_pages(folder, {"report.html": make})
    quality = calibration.quality
    print_diagnostics([*quality.further, *failures])
    print_table(*report_room.tabulate_lengths(calibration))
    print_table(*report_room.tabulate_mounts(calibration))
    if not math.isnan(calibration.rms_gap):  # a protocol without a closure
        say_paragraph(report_room.describe_gap(calibration))
    say_pages(out)
    say(f"Subject: {out / 'subject.toml'}  {out / 'subject.urdf'}  {out / 'calibration.json'}")
    say(f"Quality: {quality.quality}")
    for _, line in lines(quality.reasons):
        say_paragraph(line, "  ")
    return Outcome(calibration, EXIT_CODES[quality.quality])
