"""Where the joints of a standing person are that no sensor measures: for programs that want a whole figure."""

from __future__ import annotations

# Where joints of a standing person of 1.75 m are [m]; x forward, z from the floor; y of the left side.
HIP_Z = 0.95
LEG = {
    "upper_leg": (0.0, 0.09, HIP_Z),
    "lower_leg": (0.0, 0.09, 0.51),
    "foot": (0.0, 0.09, 0.09),
    "toe": (0.16, 0.09, 0.02),
}
TOE_TIP = (0.06, 0.0, -0.02)  # [m] from the joint of the toes to their tip on the sole
TRUNK_M, SHOULDER_Y, UPPER_ARM_M, FOREARM_M = 0.50, 0.19, 0.30, 0.26
COLLAR_SHARE = 0.2  # of the way from the middle of the shoulders to a shoulder
# Joints of the trunk as shares of the way from the hips to the line between the shoulders, and of the torso's turn.
SPINE = {"l5": (0.15, 0.25), "l3": (0.35, 0.5), "t12": (0.5, 0.75), "torso": (0.65, 1.0)}
NECK_M, HEAD_M = 0.06, 0.14  # above the line between the shoulders
