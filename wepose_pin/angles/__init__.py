"""Joint angles after the recommendations of the International Society of Biomechanics (ISB).

Wu et al. 2005, "ISB recommendation on definitions of joint coordinate systems of various joints for the reporting of
human joint motion, Part II", Journal of Biomechanics 38:981–992, doi 10.1016/j.jbiomech.2004.05.042.

`euler` takes rotations apart and follows the angles over time; `joints` says which segments make a joint, in which
axes and sequence, and carries the uncertainty; `tables` gives ranges, rates and the columns of a file.
"""

from .euler import compose
from .joints import ISB_AXES, JOINTS, NEAR_LOCK, SHOULDER_SEQUENCES, Angles, JointAngles, joint_angles
from .tables import RATE_WINDOW_S, JointSummary, angle_table, summary, summary_table

__all__ = [
    "ISB_AXES",
    "JOINTS",
    "NEAR_LOCK",
    "RATE_WINDOW_S",
    "SHOULDER_SEQUENCES",
    "Angles",
    "JointAngles",
    "JointSummary",
    "angle_table",
    "compose",
    "joint_angles",
    "summary",
    "summary_table",
]
