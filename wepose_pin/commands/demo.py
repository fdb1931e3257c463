"""``wepose demo``: the whole chain on a recording that it makes itself."""

from __future__ import annotations

from pathlib import Path

from .options import Force, Out, Seed
from .output import print_diagnostics, print_table, progress_bar, say, say_pages, say_paragraph
from .simulate import PROTOCOL


def demo(*, out: Out = Path("wepose-demo"), seed: Seed = 1, force: Force = False) -> None:
    """Run the whole chain on a simulated recording: simulate, calibrate, track, evaluate, view.

    A person of random size wears five Xsens MTi-3, stands in the N-pose, moves the joined hands and holds the T-pose, a
    minute in all, then draws six circles in the air with the right hand. All of it is simulated, so the truth is known.
    Prints lengths and errors beside the true ones.

    Example: wepose demo -o demo

    Parameters
    ----------
    out
        Write session/, subject/, result/ with its page, and demo.json with all numbers to this folder.
    seed
        Sample the person and the motion by this seed.
    """
    options = dict(locals())
    import json
    from dataclasses import asdict

    from .. import tracking
    from ..calibration import calibrate
    from ..documents import whole_folder
    from ..evaluation import evaluate
    from ..report.calibration import tabulate_lengths
    from ..report.pages import write_track_pages
    from ..simulation import CIRCLING_POINT, simulate, simulate_person
    from ..writers import write_session
    from ..writers.provenance import collect_provenance, write_provenance
    from ..writers.result import as_json, write_about, write_poses, write_subject

    with progress_bar() as progress, whole_folder(out, force) as folder:
        progress("simulating a person", 0.0)
        person = simulate_person(seed)
        simulation = simulate(person.lengths, seed=seed, protocol=PROTOCOL)
        recording, truth = simulation.recording(f"demo-{seed}"), simulation.truth()
        for name in ("session", "subject", "result"):
            (folder / name).mkdir()
        write_session(folder / "session", recording, truth)
        progress("calibrating", 0.2)
        calibration = calibrate(
            recording, measured=person.measured, prior=person.prior, measured_std=person.measured_std
        )
        progress("tracking", 0.6)
        tracked = tracking.track(recording, calibration.subject)
        errors = evaluate(tracked.pose, truth, simulation.phases["circles"][0])
        write_subject(folder / "subject", calibration.subject, tracked.model)
        summary = tracking.summarize(tracked)
        write_poses(folder / "result", [tracked])
        write_about(folder / "result", tracked, summary)
        progress("making the page", 0.8)
        failures = write_track_pages(folder / "result", summary, report=False)
        figures = {"seed": seed, "true_lengths": person.lengths, "errors": asdict(errors)}
        (folder / "demo.json").write_text(json.dumps(as_json(figures), indent=2) + "\n", encoding="utf-8")
        write_provenance(folder, collect_provenance("demo", options))
    title, header, rows = tabulate_lengths(calibration)
    true = [f"{1e3 * person.lengths[name]:.1f}" for name in calibration.subject.lengths]
    print_table(title, [*header, "true"], [[*row, value] for row, value in zip(rows, true, strict=True)])
    hand, from_root = errors.position_on_limb[CIRCLING_POINT], errors.position[CIRCLING_POINT]
    say_paragraph(
        f"Right hand while drawing six circles, distance to the truth: {hand.mean:.1f} ± {hand.std:.1f} mm from the "
        f"shoulders, {from_root.mean:.1f} ± {from_root.std:.1f} mm from the hips"
    )
    print_diagnostics(failures)
    say_pages(out / "result")
    say(f"Session, subject, result, numbers:  {out}/session  {out}/subject  {out}/result  {out}/demo.json")
