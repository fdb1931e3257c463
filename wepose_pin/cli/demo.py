"""``wepose demo``."""

from __future__ import annotations

from ..jobs.demo import DemoJob, run_demo
from .output import print_diagnostics, print_table, progress_bar, say, say_pages
from .parser import Command
from .tables import mean_std, print_lengths


def run(job: DemoJob) -> int:
    """Run the whole chain; print the lengths and each method's errors beside the truth."""
    with progress_bar() as progress:
        outcome = run_demo(job, progress)
    from ..simulation import CIRCLING_POINT

    person = outcome.person
    print_lengths("Lengths from the joined hands", outcome.best.subject, person.prior, person.measured, person.lengths)
    print_table(
        "Right hand while drawing six circles: distance to the truth [mm], mean ± std",
        ("filter", "from the shoulders", "from the root"),
        [
            (
                method,
                mean_std(error.position_on_limb[CIRCLING_POINT]),
                mean_std(error.position[CIRCLING_POINT]),
            )
            for method, error in outcome.errors.items()
        ],
    )
    say("One person, one motion: the order of the filters changes with both, see --seed. Each filter tracks with the")
    say("lengths that it calibrated. Errors from the root include the trunk's length, which joined hands do not")
    say("determine.")
    print_diagnostics(outcome.page_failures)
    out = job.out
    say_pages(out / "result", {"Motion": "view.html"})
    say(f"Session, subject, result, numbers:  {out}/session  {out}/subject  {out}/result  {out}/demo.json")
    return 0


COMMAND = Command(DemoJob, run, example="demo -o demo")
