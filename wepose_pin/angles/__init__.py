"""Joint angles after the recommendations of the International Society of Biomechanics (ISB).

Thorax and arms: Wu et al. 2005, "ISB recommendation on definitions of joint coordinate systems of various joints for
the reporting of human joint motion, Part II", Journal of Biomechanics 38:981–992, doi 10.1016/j.jbiomech.2004.05.042.
Pelvis, hip and ankle: Wu et al. 2002, Part I of the same, Journal of Biomechanics 35:543–548, doi
10.1016/S0021-9290(01)00222-6. Knee: Grood and Suntay 1983, "A joint coordinate system for the clinical description of
three-dimensional motions: application to the knee", Journal of Biomechanical Engineering 105:136–144, doi
10.1115/1.3138397.

`euler` takes rotations apart and follows the angles over time; `joints` says which segments make a joint, in which
axes and sequence, and carries the uncertainty; `tables` gives ranges, rates and the columns of a file.
"""

from .joints import (
    AUTO,
    JOINTS,
    NEAR_LOCK,
    SHOULDER_SEQUENCES,
    Angles,
    JointAngles,
    diagnose_lock,
    group_sides,
    joint_angles,
)
from .tables import angle_table, summary, summary_table

__all__ = [
    "AUTO",
    "JOINTS",
    "NEAR_LOCK",
    "SHOULDER_SEQUENCES",
    "Angles",
    "JointAngles",
    "angle_table",
    "diagnose_lock",
    "group_sides",
    "joint_angles",
    "summary",
    "summary_table",
]
