"""``wepose demo``: the whole chain on a recording that it makes itself."""

from __future__ import annotations

from pathlib import Path

from .options import Force, Number, Out
from .output import print_diagnostics, print_table, progress_bar, say, say_pages
from .simulate import PROTOCOL, check_seed


def demo(
    *,
    out: Out = Path("wepose-demo"),
    seed: Number = 1,
    force: Force = False,
) -> None:
    """Run the whole chain on a simulated recording: simulate, calibrate, track, evaluate, view.

    A person of random size wears five Xsens MTi-3, stands in the N-pose (upright, arms hanging, palms to the thighs),
    moves the joined hands and holds the T-pose, a minute in all, then draws six circles in the air with the right hand
    and rests it on a table in between. All of it is simulated, so the truth is known. Prints lengths and errors of each
    filter, with the true lengths.

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
    from ..filters import BEST, METHODS
    from ..report.pages import write_track_pages
    from ..simulation import CIRCLING_POINT, simulate, simulate_person
    from ..writers import write_result, write_session
    from ..writers.provenance import collect_provenance, write_provenance
    from ..writers.result import as_json, write_subject

    check_seed(seed)
    steps = 2 + 2 * len(METHODS)
    with progress_bar() as progress, whole_folder(out, force) as folder:
        progress("simulating a person", 0.0)
        person = simulate_person(seed)
        simulation = simulate(person.lengths, seed=seed, protocol=PROTOCOL)
        recording, truth = simulation.recording(f"demo-{seed}"), simulation.truth()
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
            tracked = tracking.track(recording, calibrations[method].subject, method=method)
            errors[method] = evaluate(tracked.pose, truth, circles)
            if method == BEST:
                playback = tracked
        best = calibrations[BEST]
        write_subject(folder / "subject", best.subject, playback.model)
        summary = tracking.summarize(playback)
        write_result(folder / "result", playback, summary)
        progress("making the page", (steps - 1) / steps)
        failures = write_track_pages(folder / "result", summary, report=False)
        lengths = {
            name: {"true": value, "estimated": best.subject.lengths[name], "std": best.subject.std(name)}
            for name, value in person.lengths.items()
        }
        figures = {
            "seed": seed,
            "lengths": lengths,
            "errors": {method: asdict(error) for method, error in errors.items()},
        }
        (folder / "demo.json").write_text(json.dumps(as_json(figures), indent=2) + "\n", encoding="utf-8")
        write_provenance(folder, collect_provenance("demo", options))
    print_table(
        "Lengths from the joined hands [mm]",
        ("length", "true", "estimated"),
        [
            (name, f"{1e3 * each['true']:.1f}", f"{1e3 * each['estimated']:.1f} ± {1e3 * each['std']:.1f}")
            for name, each in lengths.items()
        ],
    )
    places = {method: (error.position_on_limb, error.position) for method, error in errors.items()}
    print_table(
        "Right hand while drawing six circles: distance to the truth [mm], mean ± std",
        ("filter", "from the shoulders", "from the root"),
        [
            (method, *(f"{each[CIRCLING_POINT].mean:.1f} ± {each[CIRCLING_POINT].std:.1f}" for each in both))
            for method, both in places.items()
        ],
    )
    say("One person, one motion: the order of the filters changes with both, see --seed. Each filter tracks with the")
    say("lengths that it calibrated. Errors from the root include the trunk's length, which joined hands do not")
    say("determine.")
    print_diagnostics(failures)
    say_pages(out / "result", {"Motion": "view.html"})
    say(f"Session, subject, result, numbers:  {out}/session  {out}/subject  {out}/result  {out}/demo.json")
