"""``wepose batch``: a plan over many recordings."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .options import Count
from .output import Outcome, progress_bar, say


def batch(
    plan: Path,
    /,
    *,
    out: Annotated[str, Parameter(alias="-o", metavar="DIR|URL")],
    scheduler: Annotated[str | None, Parameter(metavar="ADDRESS")] = None,
    workers: Count | None = None,
    force: bool = False,
) -> Outcome:  # of a Study
    """Run the same steps on many recordings, on all processors of this machine or on a Dask cluster.

    An item is one session of the plan with its steps. If it fails, the table has its error, and the others continue.
    The same command continues a run that was stopped and repeats nothing that is done. Sessions and DIR may
    lie on s3:// (docs/batch.md).

    Exit code: 0 all items are done, 3 some are not; 2 invalid plan or folder, nothing is run.

    Example: wepose batch plan.toml -o study

    Parameters
    ----------
    plan
        The plan, a TOML: sessions, their subjects, and the steps calibrate, track, retarget, export, evaluate.
    out
        Write items/, one folder per item, and results.parquet to this folder or below this URL.
    scheduler
        Use the workers of a running Dask scheduler, tcp://HOST:8786. Without it workers are started here.
    workers
        Start this number of workers here. Without it one per processor.
    force
        Run those items again whose inputs, options or package have changed. Without it they are kept as "changed".
    """
    import polars as pl

    from ..batch.study import run_batch

    try:
        with progress_bar() as progress:
            study = run_batch(plan, out, scheduler=scheduler, workers=workers, force=force, progress=progress)
    except KeyboardInterrupt:
        print("wepose: stopped; what is done stays, and the same command goes on from there", file=sys.stderr)
        raise SystemExit(130) from None
    failed = study.table.filter(study.table["status"] != "done")
    if failed.height:
        causes = failed.group_by("error", maintain_order=True).agg(pl.len(), pl.first("item"), pl.first("message"))
        for cause, count, item, message in causes.sort("len", descending=True).iter_rows():
            say(f"Not done: {count} ({cause}), for example {item}: {message}")
    reused = f", {study.reused} of them before" if study.reused else ""
    say(f"{study.table.height - failed.height} of {study.table.height} items done{reused}")
    say(f"Table: {out.rstrip('/')}/results.parquet")
    return Outcome(study, 3 if failed.height else 0)
