"""What this package makes of a body model: joints, segments, lengths, and how well each segment can be followed.

    python examples/models_table.py humanSubject01_48dof.urdf my_body/model.toml

Without arguments it looks at the model that comes with the package. `docs/models.md` says how to name a model's links.
"""

import sys

import numpy as np
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin.body.configuration import compute_orientation_residuals, solve_configuration

N = 200  # random poses: every segment up to 60 deg from the one above
for path in sys.argv[1:] or [None]:
    body = wp.load_model(path)
    rng = np.random.default_rng(0)
    quat_WL = {}
    for segment in body.chains:
        above = body.parents[segment]
        R = Rotation.from_rotvec(np.radians(60.0) * rng.uniform(-0.57, 0.57, (N, 3)))
        R_WA = Rotation.from_quat(quat_WL[above]) if above in quat_WL else Rotation.identity()
        quat_WL[segment] = (R_WA * R).as_quat()
    residuals = compute_orientation_residuals(body, solve_configuration(body, quat_WL), quat_WL)

    print(f"{path or 'the body that comes with the package'}")
    sizes = list(body.pin.nvs)
    print(f"  {body.pin.nv} degrees of freedom: {sizes.count(3)} spherical joints, {sizes.count(1)} of one axis")
    print(f"  mass {sum(inertia.mass for inertia in body.pin.inertias):.2f} kg")
    print("  lengths [m]  " + "  ".join(f"{name} {length:.3f}" for name, length in body.lengths.items()))
    for segment, chain in body.chains.items():
        joints = ", ".join(body.pin.names[joint] for joint in chain) or "none: rigid with what it hangs on"
        rms = np.degrees(np.sqrt(np.mean(residuals[segment] ** 2))) if segment in residuals else 0.0
        print(f"  {segment:16s} residual {rms:4.1f} deg (rms)   joints: {joints}")
