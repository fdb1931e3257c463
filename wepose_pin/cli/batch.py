"""``wepose batch``."""

from __future__ import annotations

import sys

from ..jobs.batch import BatchJob
from .output import print_table, progress_bar, say
from .parser import Command


def run(job: BatchJob) -> int:
    """Run the plan; print what is not done and why, and the place of the table."""
    from ..batch import run_batch

    try:
        with progress_bar() as progress:

            def show(done: int, failed: int, total: int) -> None:
                text = f"{done} of {total} items" + (f", {failed} failed" if failed else "")
                progress(text if done or not total else "starting workers", done / max(total, 1))

            study = run_batch(job, show)
    except KeyboardInterrupt:
        print("wepose: stopped; what is done stays, and the same command goes on from there", file=sys.stderr)
        return 130
    failed = study.table.filter(study.table["status"] != "done")
    if failed.height:
        causes = failed["error"].value_counts(sort=True).iter_rows()
        print_table("Not done", ("cause", "items"), [(cause, str(count)) for cause, count in causes])
        first = failed.unique("error", keep="first", maintain_order=True)
        for item, message in first.select("item", "message").iter_rows():
            say(f"  {item}: {message}")
    reused = f", {study.reused} of them before" if study.reused else ""
    say(f"{study.table.height - failed.height} of {study.table.height} items done{reused}")
    say(f"Table: {job.out.rstrip('/')}/results.parquet")
    return 3 if failed.height else 0


COMMAND = Command(
    BatchJob,
    run,
    example="batch plan.toml -o study",
    arguments=("plan",),
    exit_codes="0 all items are done, 3 some are not; 2 invalid plan or folder, nothing is run.",
)
