"""Track a recording: session.toml in, pose of the upper body out.

    python examples/track_recording.py session.toml [subject.toml]

Without arguments it makes a recording of its own. The motion is written to view.html, which opens
in a browser, offline.
"""

import sys

import numpy as np

import wepose_pin as wp

if len(sys.argv) > 1:
    recording = wp.load_session(sys.argv[1])
    subject = wp.load_subject(sys.argv[2]) if len(sys.argv) > 2 else None
else:
    simulation = wp.simulate(wp.population_subject(1.75, "f").lengths, seed=1, clasp_s=10.0, circles=2)
    recording, subject = simulation.recording(), wp.population_subject(1.75, "f")

result = wp.track(recording, subject)
print(result)

reach = np.linalg.norm(result.points["right_palm"] - result.points["right_shoulder"], axis=1)
print(f"segments: {', '.join(result.quat_WL)}")
print(f"right hand from its shoulder: {reach.min():.3f} to {reach.max():.3f} m")
flexion = np.degrees(wp.joint_angles(result)["right_elbow"]["flexion"])
print(f"right elbow's flexion: {flexion.min():.0f} to {flexion.max():.0f} deg")
print(f"configuration of the Pinocchio model: {result.q.shape}, quaternions xyzw at the spherical joints")
result.show(open=False).save("view.html", force=True)
