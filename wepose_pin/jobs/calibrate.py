"""``wepose calibrate``: a recording of a protocol → the subject's lengths and mounts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from ..diagnostics import Diagnostic
from ..errors import WrongOption, one_of
from . import Formulation, Method, Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..calibration import Calibration, CalibrationQuality, Protocol
    from ..model import BodyModel
    from ..subject import Subject


@dataclass(frozen=True)
class CalibrateJob:
    """Calibrate lengths and sensor mounts from a recording of a protocol, such as joined hands.

    Joined hands determine the proportions of the arms and not their scale. Measure one length, such as the breadth of
    the shoulders, and give it with --measured. Without one the scale is that of the population prior, and the output
    says how uncertain it is.

    Parameters
    ----------
    session : SESSION
        The recording: session.toml, or the folder that holds it. It names the phases of the protocol, such as clasp, in
        which the palms are held together.
    out : DIR
        Write subject.toml, subject.urdf, calibration.json (the quality and all numbers) and report.html to this folder.
    protocol : NAME|FILE.toml
        Calibrate by this protocol. Without it clasp, and t_pose and bow as well where the session has those phases (not
        with --formulation paper). Protocols:
        clasp (hands together), t_pose (arms held sideways), bow (the trunk bends forwards), table (both palms on a
        table), tip (of a robot's arm or another chain: its point "tip" on a fixed point), free (any motion, no
        protocol: headings and mounts alone), or a file of your own, made like those in calibration/.
        Several in one session are joined by +, as in clasp+t_pose.
    model : NAME|FILE
        Calibrate this body: a name (upper_body, whole_body), a table of a body (.toml), or a URDF beside its table
        (docs/models.md). Without it the body that the session names, else upper_body.
    measured : NAME=METRES
        Use this measured length; may be given several times. biacromial=0.41 is the breadth over the acromions, the
        bony edges on top of the shoulders, which a tape reaches: the distance of the shoulder joints is 0.83 ± 0.03 of
        it. The other names are those of [lengths] in subject.toml, such as left_forearm: from joint centre to joint
        centre.
    formulation
        Estimate by this formulation: full (lengths, mounts, headings, their drift and soft tissue together, with
        priors) or paper (Lisini Baldi et al. 2019: the lengths alone, by plain least squares of the gap between the
        palms, with the mounts as the session states them and a measured length that fixes the scale).
    prior : SUBJECT
        Use as the prior this subject.toml, or the one in this folder, of an earlier calibration of the same person:
        lengths and shoulders with their covariance, so that each session adds to what is known. Its mounts are used
        too, unless the sensors were taken off: a session with remounted = true uses none of them. Of an Xsens .mvnx
        only the lengths are used.
    stature : METRES
        Narrow the population prior to people of this body height.
    sex
        Narrow the population prior to women or men.
    method
        Estimate orientations by this filter: amekf (Kalman filter, corrected in motion too), smoother (the same forward
        and backward in time), smekf (Kalman filter of Lisini Baldi et al. 2019, corrected in static phases, with an
        exact covariance and two more conditions of the static test), smekf_published (the same as published), ncf
        (complementary filter, Mahony et al. 2008), gdc (gradient descent, Madgwick et al. 2011).
    gaps
        Accept gaps of more than 50 ms and bridge them. Without it such a gap is an error.
    report
        Write report.html, which shows the quality and what to do about it, lengths, mounts and the gap between the
        palms.
    force
        Replace the files of an earlier run in DIR.
    """

    session: Path
    out: Path
    protocol: str | None = None
    model: str | None = None
    measured: Mapping[str, float] = field(default_factory=dict)
    prior: Path | None = None
    stature: float | None = None
    sex: Literal["f", "m"] | None = None
    formulation: Formulation = "full"
    method: Method = "amekf"
    gaps: bool = False
    report: bool = True
    force: bool = False

    def check(self) -> None:
        """Raise `WeposeError` where an option is wrong whatever the session holds."""
        from ..calibration import load_protocol
        from ..calibration.protocols import DEFAULT
        from ..model import load_model
        from ..model.anthropometry import check_stature

        load_protocol(self.protocol or DEFAULT)
        check_stature(self.stature)
        if self.prior is not None and (self.stature is not None or self.sex is not None):
            raise WrongOption(
                "prior", self.prior, "has the lengths of a person; --stature and --sex narrow those of the population"
            )
        # A URDF without a table has the sensors' links as segments, and those are in the session.
        if self.model is not None and Path(self.model).suffix.lower() != ".urdf":
            _check_measured(self, load_model(self.model))


def _check_measured(job: CalibrateJob, model: BodyModel) -> None:
    """Raise `WrongOption` where a length is measured that the body does not have."""
    from ..model import list_breadths

    known = (*model.lengths, *list_breadths(model.table))
    for name, metres in job.measured.items():
        if name not in known:
            raise WrongOption("measured", f"{name}={metres:g}", f"'{name}' is not a length; {one_of(known, name)}")


class CalibrateOutcome(NamedTuple):
    """What came of a `CalibrateJob`."""

    calibration: Calibration
    quality: CalibrationQuality
    protocol: Protocol
    prior: Subject
    page_failures: list[Diagnostic]  # pages, and parts of pages, that could not be made


def run_calibrate(job: CalibrateJob, progress: Progress = no_progress) -> CalibrateOutcome:
    """Calibrate a subject and write its folder, whole or not at all; its page follows.

    Raises
    ------
    WeposeError
        What the session, the protocol or an option lacks.
    """
    from ..calibration import assess, calibrate, load_protocol
    from ..calibration.protocols import choose_protocol
    from ..model.body import load_sensed_model
    from ..readers import load_session
    from ..readers.subject import read_subject
    from ..report import write_calibration_page
    from ..writers.calibration import write_calibration
    from ..writers.folder import result_folder
    from ..writers.provenance import collect_provenance
    from ..writers.result import write_subject

    job.check()
    with result_folder(job.out, job.force) as folder:
        progress("reading", 0.0)
        recording = load_session(job.session, gaps=job.gaps)
        protocol = load_protocol(job.protocol or choose_protocol(recording.phases, job.formulation))
        model = load_sensed_model(job.model or recording.model or None, recording.sensors, recording.where())
        _check_measured(job, model)
        prior = read_subject(job.prior) if job.prior is not None else None
        progress("calibrating", 1 / 3)
        calibration = calibrate(
            recording,
            measured=dict(job.measured),
            prior=prior,
            stature=job.stature,
            sex=job.sex,
            model=model,
            protocol=job.protocol,
            method=job.method,
            formulation=job.formulation,
        )
        quality = assess(calibration)
        write_subject(folder, calibration.subject, calibration.subject.shape(calibration.problem.model))
        write_calibration(folder, calibration, quality, collect_provenance("calibrate", field_values(job)))
    failures: list[Diagnostic] = []
    if job.report:
        progress("writing the report", 2 / 3)
        failures = write_calibration_page(
            job.out, calibration, recording, method=job.method, protocol=protocol, quality=quality
        )
    return CalibrateOutcome(calibration, quality, protocol, prior or calibration.problem.prior, failures)
