"""What the segments of a body share: residuals that calibration and tracking both use.

Each is written once. `paths` has the vectors between points of the body, whose sum is zero where the points coincide,
and that gap with its Jacobian in headings; `hinges` the plane in which a joint of one axis bends, and its range;
`joint_accelerations` what two sensors measure of the joint between them. All but the last are expressions in CasADi, of
segment orientations and what is constant about the person, so that CasADi gives their Jacobians. The last is linear in
what is constant, and its Jacobian stands beside it. `symbols` has the quaternion algebra of the expressions, and
evaluates them for n samples.

Here L' is the frame of a segment that equals W in the start pose: of a person in the N-pose the segment's own frame L.
"""
