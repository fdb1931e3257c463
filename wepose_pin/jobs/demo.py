"""``wepose demo``: the whole chain on a recording that it makes itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..diagnostics import Diagnostic
from . import Progress, no_progress
from .fields import field_values
from .simulate import PROTOCOL, check_seed

if TYPE_CHECKING:
    from ..calibration import Calibration
    from ..evaluation import Evaluation
    from ..simulation import Person


@dataclass(frozen=True)
class DemoJob:
    """Run the whole chain on a simulated recording: simulate, calibrate, track, evaluate, view.

    A person of random size wears five Xsens MTi-3, stands in the N-pose (upright, arms hanging, palms to the thighs),
    moves the joined hands and holds the T-pose, a minute in all, then draws six circles in the air with the right hand
    and rests it on a table in between. All of it is simulated, so the truth is known. Prints lengths and errors of each
    filter, with the true lengths.

    Parameters
    ----------
    out : DIR
        Write session/, subject/, result/ with its page, and demo.json with all numbers to this folder.
    seed : NUMBER
        Sample the person and the motion by this seed.
    force
        Replace the files of an earlier run in DIR.
    """

    out: Path = Path("wepose-demo")
    seed: int = 1
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where the seed is negative."""
        check_seed(self.seed)


class DemoOutcome(NamedTuple):
    """What came of a `DemoJob`."""

    person: Person
    best: Calibration  # by the default method
    errors: Mapping[str, Evaluation]  # by method, while the circles are drawn
    page_failures: list[Diagnostic]


def run_demo(job: DemoJob, progress: Progress = no_progress) -> DemoOutcome:
    """Simulate, calibrate and track by each method, evaluate, and write the folder, whole or not at all.

    Raises
    ------
    WeposeError
        A place that cannot be written.
    """
    import json
    from dataclasses import asdict

    from ..calibration import calibrate
    from ..documents import whole_folder
    from ..evaluation import evaluate
    from ..filters import BEST, METHODS
    from ..report import write_track_pages
    from ..simulation import simulate, simulate_person
    from ..tracking import summarize, track
    from ..writers import write_result, write_session
    from ..writers.provenance import collect_provenance, write_provenance
    from ..writers.result import as_json, write_subject

    job.check()
    steps = 2 + 2 * len(METHODS)
    with whole_folder(job.out, job.force) as folder:
        progress("simulating a person", 0.0)
        person = simulate_person(job.seed)
        simulation = simulate(person.lengths, seed=job.seed, protocol=PROTOCOL)
        recording, truth = simulation.recording(f"demo-{job.seed}"), simulation.truth()
        for name in ("session", "subject", "result"):
            (folder / name).mkdir()
        write_session(folder / "session", recording, truth)
        circles = simulation.phases["circles"][0]

        calibrations, errors = {}, {}
        for k, method in enumerate(METHODS):
            progress(f"calibrating by {method}", (1 + 2 * k) / steps)
            calibrations[method] = calibrate(
                recording, measured=person.measured, prior=person.prior, method=method, measured_std=person.measured_std
            )
            progress(f"tracking by {method}", (2 + 2 * k) / steps)
            tracked = track(recording, calibrations[method].subject, method=method)
            errors[method] = evaluate(tracked.pose, truth, circles)
            if method == BEST:
                playback = tracked
        best = calibrations[BEST]
        write_subject(folder / "subject", best.subject, playback.model)
        summary = summarize(playback)
        write_result(folder / "result", playback, summary, phases=recording.phases)
        progress("making the page", (steps - 1) / steps)
        failures = write_track_pages(folder / "result", summary, report=False)
        lengths = {
            name: {"true": value, "estimated": best.subject.lengths[name], "std": best.subject.std(name)}
            for name, value in person.lengths.items()
        }
        figures = {
            "seed": job.seed,
            "lengths": lengths,
            "errors": {method: asdict(error) for method, error in errors.items()},
        }
        (folder / "demo.json").write_text(json.dumps(as_json(figures), indent=2) + "\n", encoding="utf-8")
        write_provenance(folder, collect_provenance("demo", field_values(job)))
    return DemoOutcome(person, best, errors, failures)
