"""``wepose validate``: the paper's experiments beside its own figures."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..diagnostics import Diagnostic
from ..errors import BadData, BadOption
from . import Progress, no_progress

if TYPE_CHECKING:
    from ..validation import Document


@dataclass(frozen=True)
class ValidateJob:
    """Repeat the experiments of Lisini Baldi et al. 2019 on simulated subjects and compare with the published errors.

    Prints a table of each experiment; without -o nothing is written. A quick run takes some minutes on two cores, a
    full one an hour or two. The paper: doi 10.1109/JSEN.2019.2940612.

    Parameters
    ----------
    out : DIR
        Write validation.json with every trial, and a page with tables and plots to this folder: validation.html, and
        validation.md with validation/*.svg.
    data : DIR
        Run on the real recordings in this folder too; its folders are broad/, wepose_hr/, ring/, ur5/
        (docs/validation.md).
    quick
        Run one trial of each experiment, and two of the BROAD data set, instead of all. The error budget and the tuning
        of the gains of ncf and gdc are left out.
    trials : NUMBER
        Run at most this many trials of each experiment of simulated people or sensors, instead of ten or twelve. The
        page says so.
    experiment : NAME
        Run only the experiments whose names begin with this, such as "upper body, mild" or BROAD.
    keep : FILE
        Take the experiments that are not run from the validation.json of an earlier run.
    from_ : FILE
        Make tables and pages from the validation.json of an earlier run, and run nothing.
    force
        Replace the files of an earlier run in DIR.
    """

    out: Path | None = None
    data: Path | None = None
    quick: bool = False
    trials: int | None = None
    experiment: str | None = None
    keep: Path | None = None
    from_: Path | None = None
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where options contradict each other."""
        others = (self.data, self.trials, self.experiment, self.keep)
        if self.from_ is not None and (self.quick or any(other is not None for other in others)):
            raise BadOption(
                f"--from {self.from_}: runs nothing, so that --quick, --trials, --experiment, --keep and --data mean "
                f"nothing beside it"
            )
        if self.trials is not None and not self.trials >= 1:
            raise BadOption(f"--trials {self.trials}: a whole number from 1 on")


class ValidateOutcome(NamedTuple):
    """What came of a `ValidateJob`."""

    document: Document
    page_failures: list[Diagnostic]


def run_validate(job: ValidateJob, progress: Progress = no_progress) -> ValidateOutcome:
    """Run the experiments, or read those of an earlier run, and write the folder, whole or not at all; pages follow.

    Raises
    ------
    WeposeError
        No data, a place that cannot be written, or nothing that could be scored.
    """
    import json

    from ..documents import whole_folder
    from ..errors import reason
    from ..report.page import page_incomplete
    from ..validation import Skipped, format_document, join_results, list_experiments, read_document, run_jobs
    from ..validation.document import check_same_settings, parse_document
    from ..validation.page import write_pages
    from ..writers.result import versions

    job.check()
    if job.from_ is not None:
        document, failures = read_document(job.from_), list[Diagnostic]()
        if job.out is not None:
            with whole_folder(job.out, job.force) as folder:
                progress("drawing the figures", 0.0)
                failures = [page_incomplete("validation.html", each) for each in write_pages(folder, document)]
        return ValidateOutcome(document, failures)
    experiments = list_experiments(job.quick, job.data, job.trials)
    chosen = [name for name in experiments if name.startswith(job.experiment or "")]
    if not chosen:
        raise BadOption(f"--experiment {job.experiment}: no experiment begins so; there are: {', '.join(experiments)}")
    kept = None if job.keep is None else read_document(job.keep)
    trials = [trial for name in chosen for trial in experiments[name]]
    steps = len(trials) + (job.out is not None)
    with contextlib.ExitStack() as place:
        folder_or_none = place.enter_context(whole_folder(job.out, job.force)) if job.out is not None else None
        results, skipped = [], []
        for k, (trial, outcome) in enumerate(zip(trials, run_jobs(trials), strict=True), 1):
            progress(trial.experiment, k / steps)
            if isinstance(outcome, Skipped):
                skipped.append(outcome)
            else:
                results += outcome
        if not results:
            raise BadData(f"nothing could be scored; {skipped[0].line()}")
        planned = {name: len(jobs) for name, jobs in list_experiments(False, job.data).items()}
        if kept is not None:
            results, skipped = join_results(kept, results, skipped, chosen, list(experiments))
            planned = kept.planned | planned
        text = format_document(results, job.quick, versions(), skipped, planned)
        if kept is not None:
            check_same_settings(kept, parse_document(json.loads(text), "this run"), str(job.keep))
        if folder_or_none is not None:
            (folder_or_none / "validation.json").write_text(text, encoding="utf-8")
    document, failures = parse_document(json.loads(text), "this run"), list[Diagnostic]()
    if job.out is not None:
        progress("drawing the figures", 1.0)
        try:
            with whole_folder(job.out, force=True) as folder:
                failures = [page_incomplete("validation.html", each) for each in write_pages(folder, document)]
        except Exception as error:
            name = "validation.html and validation.md"
            failures = [page_incomplete(name, f"cannot be made: {reason(error)}")]
    return ValidateOutcome(document, failures)
