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
        Run at most this many trials of each simulated experiment, instead of ten or twelve. The page says so.
    from_ : FILE
        Make tables and pages from the validation.json of an earlier run, and run nothing.
    force
        Replace the files of an earlier run in DIR.
    """

    out: Path | None = None
    data: Path | None = None
    quick: bool = False
    trials: int | None = None
    from_: Path | None = None
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where options contradict each other."""
        if self.from_ is not None and (self.quick or self.data is not None or self.trials is not None):
            raise BadOption(
                f"--from {self.from_}: runs nothing, so that --quick, --trials and --data mean nothing beside it"
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
    from ..validation import Skipped, format_document, list_experiments, read_document, run_jobs
    from ..validation.document import parse_document
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
    trials = [
        trial
        for trials_of_experiment in list_experiments(job.quick, job.data, job.trials).values()
        for trial in trials_of_experiment
    ]
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
        text = format_document(results, job.quick, versions(), skipped, job.trials)
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
