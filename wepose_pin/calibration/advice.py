"""What a calibration lacked and what to do better, in words for joined hands, a bar, a palm on a fixed point."""

from __future__ import annotations

from typing import NamedTuple


class Advice(NamedTuple):
    """Words for one kind of closure."""

    moved: dict[str, tuple[str, str]]  # part of the motion → what it lacked, with its size [deg]; what to do
    longer: str  # what to do for more independent looks
    gap: str  # the residual, with its size [mm]
    closer: str  # what to do about it
    apart: str  # looks that were left out, with their share [%]
    together: str  # what to do about them
    width: str = ""  # what to do about the shoulder width, where no motion tells it


_LEAN, _TWIST = "the torso hardly leaned (by {:.0f} deg)", "the torso hardly twisted (by {:.0f} deg)"
_RAISED, _BENT = "the upper arms were hardly raised (by {:.0f} deg)", "the elbows hardly bent (by {:.0f} deg)"
JOINED = Advice(
    moved={
        "elevation": (_RAISED, "move the joined hands up and down, from the belly to above the head"),
        "sideways": (
            "the joined hands hardly went sideways (by {:.0f} deg)",
            "move the joined hands far to the left and right",
        ),
        "elbow": (_BENT, "bring the joined hands to the chest and stretch them far out"),
        "lean": (_LEAN, "lean and twist the torso while the joined hands move"),
        "twist": (_TWIST, "lean and twist the torso while the joined hands move"),
    },
    longer="move for a minute, through all of the reach, the palms together all the time",
    gap="the palms are {:.0f} mm apart (rms) by the solution",
    closer="press the palms together, wrists straight; tighten the straps",
    apart="the palms were apart for {:.0f} % of the phase; that was left out",
    together="keep the palms together, or name only the seconds in which they are",
)
BAR = Advice(
    moved={
        "elevation": (_RAISED, "move the bar up and down, from the belly to above the head"),
        "sideways": ("the bar hardly went sideways (by {:.0f} deg)", "move the bar far to the left and right"),
        "elbow": (_BENT, "bring the bar to the chest and stretch it far out"),
        "lean": (_LEAN, "lean and twist the torso while the bar moves"),
        "twist": (_TWIST, "lean and twist the torso while the bar moves"),
    },
    longer="move the bar for a minute, through all of the reach, tilt and turn it, the palms at its marks all the time",
    gap="the palms are {:.0f} mm (rms) off the bar's length by the solution",
    closer="keep the palms at the bar's marks, wrists straight; tighten the straps",
    apart="the palms were off the bar's length for {:.0f} % of the phase; that was left out",
    together="keep both palms at the bar's marks, or name only the seconds in which they are",
)
POINT = Advice(
    moved={
        "elevation": ("the upper arm was hardly raised (by {:.0f} deg)", "swing the elbow up and down"),
        "sideways": (
            "the trunk hardly turned about the palm (by {:.0f} deg)",
            "turn the trunk far to both sides, the palm on its point",
        ),
        "elbow": (
            "the elbow hardly bent (by {:.0f} deg)",
            "lean far forwards and backwards, so that the elbow bends and stretches",
        ),
        "lean": (_LEAN, "lean to all sides and twist the torso, the palm on its point"),
        "twist": (_TWIST, "lean to all sides and twist the torso, the palm on its point"),
    },
    longer="move the trunk and swing the elbow for a minute, the palm on its point and the hips in place all the time",
    gap="the palm is {:.0f} mm (rms) off its point by the solution",
    closer="keep the middle of the palm on its point and the hips in place, wrist straight; tighten the straps",
    apart="the palm was off its point for {:.0f} % of the phase; that was left out",
    together="keep the palm on its point, or name only the seconds in which it is there",
    width="one arm hardly tells it: tape it and give it, as in --measured shoulder_width=0.385",
)
ADVICE = {"coincide": JOINED, "distance": BAR, "fixed_point": POINT}
POSED = "hold each pose more exactly, and for longer; or hold the hands together"  # where nothing was closed
