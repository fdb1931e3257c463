"""Calibrate a subject: the lengths of the arms from a minute with the hands held together.

    python examples/calibrate_subject.py session.toml 0.41      # the breadth over the acromions [m]

Without arguments it makes a recording of its own, of a person whose lengths are known.
"""

import sys

import wepose_pin as wp

if len(sys.argv) == 2:
    sys.exit("the breadth over the acromions in metres is missing, as in: calibrate_subject.py session.toml 0.41")
if len(sys.argv) > 2:
    recording, measured, true = wp.load_session(sys.argv[1]), {"biacromial": float(sys.argv[2])}, None
else:
    true = wp.population_subject(1.68, "f").lengths
    recording = wp.simulate(true, seed=2, circles=0).recording()
    measured = {"shoulder_width": true["shoulder_width"]}

calibration = wp.calibrate(recording, measured=measured)
subject = calibration.subject

print(calibration)
for name, length in subject.lengths.items():
    known = f"   true {1e3 * true[name]:6.1f}" if true else ""
    print(f"{name:16s} {1e3 * length:6.1f} ± {1e3 * subject.std(name):4.1f} mm{known}")
