"""``wepose simulate``."""

from __future__ import annotations

from collections.abc import Mapping

from ..jobs.simulate import SimulateJob, run_simulate
from .output import progress_bar, say
from .parser import Command


def run(job: SimulateJob) -> int:
    """Simulate; print the files, and what a user would measure."""
    with progress_bar() as progress:
        person = run_simulate(job, progress).person
    tape = _tape_breadths(person.measured) if job.preset == "people" else person.measured
    measured = " ".join(f"{name}={value:.4f}" for name, value in tape.items())
    about = f"measured: {measured}, stature {person.stature:.2f} m, sex {person.sex}"
    say(f"Session: {job.out / 'session.toml'}  ({about})")
    say(f"Truth: {job.out / 'truth.parquet'}  {job.out / 'subject.toml'}")
    return 0


def _tape_breadths(measured: Mapping[str, float]) -> dict[str, float]:
    """The breadths [m] that a tape reaches on a person, of measured lengths that no tape does."""
    from ..model import list_breadths, load_table

    breadths = list_breadths(load_table())
    return {name: measured[breadth.length] / breadth.ratio for name, breadth in breadths.items()}


COMMAND = Command(
    SimulateJob,
    run,
    example="simulate -o made --seed 7 --preset mild --imperfection palm_slip=0 --imperfection mount=any",
)
