"""``wepose simulate``: a session whose truth is known; ``wepose demo``: the whole chain on one."""

import shutil
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal

from ..errors import BadOption, one_of
from . import options as opt
from .output import progress_bar, say
from .recordings import calibrate, track
from .results import evaluate

PROTOCOL, SHORT_PROTOCOL = "clasp+t_pose", "clasp"
LEAST_S = 30.0  # from which on there is time for the T-pose
PROTOCOL_S, ACTIVITY_S = 60.0, 40.0
CIRCLES = 6  # drawn by the right hand after the protocol


def simulate(
    *,
    out: opt.Out,
    seed: opt.Seed = 1,
    seconds: opt.Duration | None = None,
    protocol: opt.ProtocolName | None = None,
    activity: Literal["walk", "sit", "tasks", "run", "throw"] | None = None,
    preset: Literal["ideal", "mild", "people"] = "ideal",
    force: opt.Force = False,
    rate_hz: Annotated[opt.SampleHz, opt.MORE] = 100.0,
    imperfection: Annotated[opt.Imperfection | None, opt.RESEARCH] = None,
) -> Any:  # the Person, whose room loads late
    """Simulate the recording of a person with five sensors, or fifteen on the whole body, and its known truth.

    The person stands in the start pose, does the motion of the protocol, then draws circles with the right hand.
    The sensors have the noise and bias of an Xsens MTi-3. Continue with `wepose calibrate DIR --measured ...` and
    `wepose track DIR`; after an activity of the whole body with `wepose track DIR --model whole_body`.

    Example: wepose simulate -o made --seed 7 --preset mild --imperfection palm_slip=0 --imperfection mount=any

    Parameters
    ----------
    out
        Write session.toml, recording.parquet, truth.parquet (columns as in pose.parquet) and subject.toml (the true
        lengths and mounts) to this folder.
    seed
        Generate a random person and motion from this seed.
    seconds
        Simulate this many seconds of the activity (without it 40) or of the protocol's motion (without it 60).
    protocol
        Simulate the motion of this calibration protocol (see `wepose calibrate --help`): clasp, t_pose, bow, or
        several of them joined by +. Without it clasp+t_pose, or clasp alone for less than 30 s.
    activity
        Simulate an activity in place of a protocol: walk (on the spot), sit (down and up), run or throw, of the whole
        body, with sensors on pelvis, head, hands and legs too; tasks (reaches, rests and typing), of the upper body.
    preset
        Simulate only the sensors' noise and bias (ideal), or also a person as in the literature (people): soft
        tissue, shoulders that move with the arms, start poses as people hold them, errors of sensors and clocks; or a
        careful one at 0.3 of them (mild). docs/people.md has sizes and sources.
    rate_hz
        Sample the sensors at this rate, 20 to 2000 Hz.
    imperfection
        Simulate one imperfection at this size; may be given several times. mount=any: arbitrary sensor mounting, which
        the session does not state. All others are numbers; 0 is off, or inf for a range. Of the body, as a multiple of
        the size in the literature: tissue_gain, tissue_random, girdle, elbow, wrists, start_pose, sway, sensor_place;
        palm_slip [m], start_heading_deg. Of the sensors: gyro_scale, accel_scale (0.01 is 1 %), misalignment_deg,
        g_sensitivity_deg_s, clock_jitter [s], clock_offset [s], clock_drift_ppm, gyro_range_deg_s, accel_range_g, bits,
        dropped (share of the samples), gyro_warm_up_deg_s, accel_average (share of the time between samples).
    """
    options = dict(locals())
    from dataclasses import fields, replace

    import numpy as np

    from .. import simulation as room
    from ..body import DEFAULT_BODY, list_breadths, load_table
    from ..body.subject import mount_rows, subject_toml
    from ..documents import whole_folder
    from ..writers import write_session
    from ..writers.result import collect_provenance, write_provenance

    if activity is not None and protocol is not None:
        raise BadOption(f"--activity {activity} with --protocol {protocol}: one of them; leave one out")
    sizes, changes = room.PRESETS[preset], dict[str, Any](imperfection or {})
    names = [each.name for each in fields(sizes)]
    for name in changes:
        if name not in names:
            raise BadOption(f"--imperfection {name}: not an imperfection; {one_of(names, name, len(names))}")
    try:
        sizes = replace(sizes, **changes)
    except BadOption as error:
        raise BadOption(f"--imperfection: {error}") from None
    measured_std = room.PEOPLE_MEASURED_STD if preset == "people" else room.MEASURED_STD
    motion: dict[str, Any] = {"seed": seed, "rate_hz": rate_hz, "imperfections": sizes}
    with progress_bar() as progress, whole_folder(out, force) as folder:
        progress("simulating a person", 0.0)
        person = room.simulate_person(seed, measured_std, room.ACTIVITIES[activity].body if activity else DEFAULT_BODY)
        if activity:
            seconds = seconds or ACTIVITY_S
            simulation = room.simulate_activity(activity, seconds=seconds, lengths=person.lengths, **motion)
        else:
            seconds = seconds or PROTOCOL_S
            protocol = protocol or (PROTOCOL if seconds >= LEAST_S else SHORT_PROTOCOL)
            simulation = room.simulate(person.lengths, clasp_s=seconds, protocol=protocol, circles=CIRCLES, **motion)
        write_session(folder, simulation.recording(f"simulated-{seed}"), simulation.truth())
        order = (*simulation.lengths, *(row for segment in simulation.quat_LS for row in mount_rows(segment)))
        true = replace(
            person.prior,
            name="truth",
            lengths=person.lengths,
            girdles=simulation.girdles,
            mounts=simulation.quat_LS,
            order=order,
            covariance=np.zeros((len(order), len(order))),
            note="simulated: the true lengths and mounts",
        )
        (folder / "subject.toml").write_text(subject_toml(true), encoding="utf-8")
        write_provenance(folder, collect_provenance("simulate", options))
    measured = person.measured
    if preset == "people":  # a tape reaches a person's breadths over the bones, not the joint centres
        breadths = list_breadths(load_table())
        measured = {name: measured[length] / ratio for name, (length, ratio, _) in breadths.items()}
    lengths = " ".join(f"{name}={value:.4f}" for name, value in measured.items())
    about = f"measured: {lengths}, stature {person.stature:.2f} m, sex {person.sex}"
    say(f"Session: {out / 'session.toml'}  ({about})")
    say(f"Truth: {out / 'truth.parquet'}  {out / 'subject.toml'}")
    return person


def demo(*, out: opt.Out = Path("wepose-demo"), seed: opt.Seed = 1, force: opt.Force = False) -> None:
    """Run the commands simulate, calibrate, track and evaluate, one after the other.

    A person of random size wears five Xsens MTi-3, stands in the N-pose, moves the joined hands and holds the T-pose, a
    minute in all, then draws six circles in the air with the right hand. All of it is simulated, so the truth is known.
    The errors that are printed are those of the circles.

    Example: wepose demo -o demo

    Parameters
    ----------
    out
        Write session/, subject/ and result/, each with its pages, to this folder.
    seed
        Generate a random person and motion from this seed.
    """
    session, subject, result = parts = [out / name for name in ("session", "subject", "result")]
    new = [folder for folder in (out, *parts) if not folder.exists()]
    replaced = [folder for folder in parts if force and folder.is_dir()]
    with tempfile.TemporaryDirectory(prefix=".earlier-", dir=out if replaced else None) as earlier:
        for folder in replaced:
            shutil.copytree(folder, Path(earlier) / folder.name)
        try:
            person = simulate(out=session, seed=seed, force=force)
            say("")
            lengths = {name: round(metres, 4) for name, metres in person.measured.items()}
            stature = round(person.stature, 2)
            calibrate(session, measured=lengths, stature=stature, sex=person.sex, out=subject, force=force)
            say("")
            track(session, subject=subject, out=result, force=force)
            say("")
            evaluate(result, session, phase="circles")
        except BaseException:
            for folder in (*new, *replaced):  # all parts or none
                shutil.rmtree(folder, ignore_errors=True)
            for folder in replaced:
                (Path(earlier) / folder.name).rename(folder)
            raise
    say(f"Open {result / 'view.html'} to see the motion.")
