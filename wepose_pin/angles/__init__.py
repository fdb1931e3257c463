"""Joint angles after the recommendations of the International Society of Biomechanics (ISB).

Thorax and arms: Wu et al. 2005, "ISB recommendation on definitions of joint coordinate systems of various joints for
the reporting of human joint motion, Part II", Journal of Biomechanics 38:981–992, doi 10.1016/j.jbiomech.2004.05.042.
Pelvis, hip and ankle: Wu et al. 2002, Part I of the same, Journal of Biomechanics 35:543–548, doi
10.1016/S0021-9290(01)00222-6. Knee: Grood and Suntay 1983, "A joint coordinate system for the clinical description of
three-dimensional motions: application to the knee", Journal of Biomechanical Engineering 105:136–144, doi
10.1115/1.3138397.
"""

from .joints import AUTO, JOINTS, NEAR_LOCK, Angles, JointAngles, diagnose_lock, group_sides, joint_angles
from .movement import angle_table, summary
