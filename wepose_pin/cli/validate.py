"""``wepose validate``."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

from ..jobs.validate import ValidateJob, run_validate
from .output import print_diagnostics, print_table, progress_bar, say
from .parser import Command

if TYPE_CHECKING:
    from ..validation import Document

LONGEST_HEADER = 12  # letters; a longer one goes in two lines, so that tables stay within 100 columns
LINE = 100  # letters


def run(job: ValidateJob) -> int:
    """Run the experiments; print a table each."""
    with progress_bar() as progress:
        document, failures = run_validate(job, progress)
    print_experiments(document)
    print_diagnostics([*(each.diagnostic() for each in document.skipped), *failures])
    if job.out is not None and (job.out / "validation.html").is_file():
        say(f"Page: {job.out / 'validation.html'}  {job.out / 'validation.md'}  {job.out / 'validation'}/*.svg")
    if job.out is not None and job.from_ is None:
        say(f"Every trial: {job.out / 'validation.json'}")
    return 0


def print_experiments(document: Document) -> None:
    """A table an experiment, and the targets."""
    from ..validation import summarize
    from ..validation.tables import (
        compare_with_paper,
        describe_known,
        find_shared_unit,
        make_experiment_table,
        make_targets_table,
    )

    rows = summarize(document.results)
    for experiment in dict.fromkeys(row.experiment for row in rows):
        own_rows = [row for row in rows if row.experiment == experiment]
        trials = len({result.trial for result in document.results if result.experiment == experiment})
        unit = find_shared_unit(own_rows)
        header, lines = make_experiment_table(own_rows, whole=False)
        header = [name if len(name) < LONGEST_HEADER else "\n".join(name.rsplit(" ", 1)) for name in header]
        title = f"{experiment}, {trials} trial{'s' * (trials != 1)}" + (f" [{unit}]" if unit else "")
        print_table(title + ", a quick run" * document.quick, header, [[str(cell) for cell in line] for line in lines])
        known = describe_known(experiment, document.presets)
        if known:
            say(fill(f"Known beforehand: {known}", LINE))
        say("")
    comparison = compare_with_paper(rows)
    if comparison.larger.rows:
        title = f"Larger than the paper's own: {len(comparison.larger.rows)} of {comparison.figures} figures"
        print_table(
            title, list(comparison.larger.header), [[str(cell) for cell in row] for row in comparison.larger.rows]
        )
    elif comparison.figures:
        say(f"None of the {comparison.figures} figures that have one of the paper's beside them is larger than that.")
    targets = make_targets_table(rows)
    if targets.rows:
        cells = [[str(cell).replace("**", "") for cell in row] for row in targets.rows]
        print_table("Targets for the mean errors", list(targets.header), cells)
    say(
        "± is one standard deviation over time, averaged over the trials. The heading is aligned once, where nothing is"
    )
    say("scored, and never fitted to the truth afterwards.")


COMMAND = Command(ValidateJob, run, example="validate --quick")
