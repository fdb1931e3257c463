"""Joint angles of a recording: numbers for a table, figures for a paper.

    python examples/joint_angles.py session.toml [subject.toml]

Without arguments it makes a recording of its own. The figures are written to the folder `figures`, as SVG.
"""

import sys

import numpy as np

import wepose_pin as wp
from wepose_pin.angles import summary

if len(sys.argv) > 1:
    recording = wp.load_session(sys.argv[1])
    subject = wp.load_subject(sys.argv[2]) if len(sys.argv) > 2 else None
else:
    subject = wp.population_subject(1.75, "f")
    recording = wp.simulate(subject.lengths, seed=1, clasp_s=10.0, circles=2).recording()

result = wp.track(recording, subject)
angles = wp.joint_angles(result)
flexion = np.degrees(angles["right_elbow"]["flexion"])  # (n,)
print(f"right elbow's flexion: {flexion.min():.0f} to {flexion.max():.0f} deg")
for joint, ranges in summary(angles).items():
    extremes = zip(np.degrees(ranges.lowest), np.degrees(ranges.highest), strict=True)
    for name, (lowest, highest) in zip(angles[joint], extremes, strict=True):
        print(f"{joint} {name}: {lowest:.0f} to {highest:.0f} deg")
result.plot().save("figures", force=True)
