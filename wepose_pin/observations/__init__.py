"""What the segments of a body share: residuals that calibration and tracking both use.

Each is written once. `expressions` has the vectors between points of the body, whose sum is zero where the points
coincide, and the plane in which a joint of one axis bends, with its range, as expressions in CasADi of segment
orientations and what is constant about the person, so that CasADi gives their Jacobians. `joint_accelerations` has what
two sensors measure of the joint between them, which is linear in what is constant; its Jacobian stands beside it.

Here L' is the frame of a segment that equals W in the start pose: of a person in the N-pose the segment's own frame L.
"""
