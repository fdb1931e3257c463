"""``wepose demo``: the whole chain on a recording that it makes itself."""

from __future__ import annotations

import shutil
from pathlib import Path

from .calibrate import calibrate
from .evaluate import evaluate
from .options import Force, Out, Seed
from .output import say
from .simulate import simulate
from .track import track


def demo(*, out: Out = Path("wepose-demo"), seed: Seed = 1, force: Force = False) -> None:
    """Run the commands simulate, calibrate, track and evaluate, one after the other.

    A person of random size wears five Xsens MTi-3, stands in the N-pose, moves the joined hands and holds the T-pose, a
    minute in all, then draws six circles in the air with the right hand. All of it is simulated, so the truth is known.
    The errors are those while the hand draws.

    Example: wepose demo -o demo

    Parameters
    ----------
    out
        Write session/, subject/ and result/, each with its pages, to this folder.
    seed
        Sample the person and the motion by this seed.
    """
    session, subject, result = parts = [out / name for name in ("session", "subject", "result")]
    new = [folder for folder in (out, *parts) if not folder.exists()]
    try:
        person = simulate(out=session, seed=seed, force=force)
        say("")
        lengths = {name: round(metres, 4) for name, metres in person.measured.items()}
        calibrate(session, measured=lengths, stature=round(person.stature, 2), sex=person.sex, out=subject, force=force)
        say("")
        track(session, subject=subject, out=result, force=force)
        say("")
        evaluate(result, session, phase="circles")
    except BaseException:
        for folder in new:  # all parts or none
            shutil.rmtree(folder, ignore_errors=True)
        raise
    say(f"Open {result / 'view.html'} to see the motion.")
