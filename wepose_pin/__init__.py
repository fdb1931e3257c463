"""wepose-pin: the pose of a person's upper body from wearable IMUs without magnetometers.

Conventions, everywhere:

- SI inside; a value in another unit carries a suffix (`angle_deg`, `rate_hz`).
- Frames are letters. World W: z up, x forward (where the torso faces in the start pose), y left, origin at the root,
  midway between the hips. Segment L, sensor S, robot base B. The other letters are points or links of one formula,
  named there: torso T, upper arm U, forearm F, elbow E, hand H, joint J.
- `R_WS` maps coordinates in S to W, and inner letters cancel: `R_WS = R_WL @ R_LS`. The mount is R_LS.
- World V of one sensor: z up, heading that of its filter's start, unknown in W: `R_WV = Rz(ψ)`, ψ the heading offset.
  Filters, `estimate_orientation` and `OrientationSensor` know one sensor and no other world: they give `quat_VS`.
- `gyro_S` [rad/s] is the rate over the interval that ends at the sample; `accel_S` [m/s²] is specific force, +g up
  while static.
- Every segment frame equals W in the N-pose (upright, arms hanging, palms to the thighs).
- Arrays of quaternions are xyzw, unit norm, and named as rotations are (`quat_WL`); `q` is a Pinocchio configuration
  and nothing else.
- Attitude errors are rotation vectors [rad], true = estimated with the error on one side. On the right, in S:
  `R_VS exp(θ_S)`, covariances of filters (`attitude_cov`). On the left, in W: `exp(θ_W) R_WL`, covariances of segments
  (`Pose.segment_cov`) and heading errors δ, θ_W = δ e_z. On the left, in L: `exp(ε_L) R_LS`, mounts.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what editors and type checkers see
    from .angles import Angles as Angles
    from .angles import joint_angles as joint_angles
    from .body import BodyModel as BodyModel
    from .body import load_model as load_model
    from .body.kinematics import Pose as Pose
    from .body.subject import Subject as Subject
    from .body.subject import load_subject as load_subject
    from .body.subject import population_subject as population_subject
    from .calibration import Calibration as Calibration
    from .calibration import calibrate as calibrate
    from .diagnostics import Diagnostic as Diagnostic
    from .errors import BadData as BadData
    from .errors import BadModel as BadModel
    from .errors import BadOption as BadOption
    from .errors import BadPhase as BadPhase
    from .errors import BadSession as BadSession
    from .errors import BadSource as BadSource
    from .errors import BadSubject as BadSubject
    from .errors import ExistingOutput as ExistingOutput
    from .errors import MissingFile as MissingFile
    from .errors import NoSolution as NoSolution
    from .errors import WeposeError as WeposeError
    from .errors import WeposeWarning as WeposeWarning
    from .evaluation import evaluate as evaluate
    from .filters import estimate_orientation as estimate_orientation
    from .filters.static import StaticTest as StaticTest
    from .readers import load_session as load_session
    from .recording import ImuSensor as ImuSensor
    from .recording import OrientationSensor as OrientationSensor
    from .recording import Recording as Recording
    from .retargeting import retarget as retarget
    from .simulation import IDEAL_PRESET as IDEAL_PRESET
    from .simulation import MILD_PRESET as MILD_PRESET
    from .simulation import NOISE_FREE as NOISE_FREE
    from .simulation import PEOPLE_PRESET as PEOPLE_PRESET
    from .simulation import Imperfections as Imperfections
    from .simulation import ImuNoise as ImuNoise
    from .simulation import Person as Person
    from .simulation import Simulation as Simulation
    from .simulation import simulate as simulate
    from .simulation import simulate_activity as simulate_activity
    from .simulation import simulate_person as simulate_person
    from .tracking import TrackResult as TrackResult
    from .tracking import track as track
    from .writers.export import export as export
    from .writers.result import load_result as load_result

# Name → room, of the lines above: loaded on first use, so that the command line answers at once.
_WHERE = {
    name: room
    for room, name in re.findall(r"from \.([\w.]+) import (\w+) as", Path(__file__).read_text(encoding="utf-8"))
}
# What the methods of `TrackResult` call in rooms above its own.
_OF_RESULTS = {"draw_figures": "report.track", "show_result": "report.pages", "save_result": "report.pages"}
__all__ = ["__version__", *sorted(_WHERE)]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    room = _WHERE.get(name) or _OF_RESULTS.get(name)
    if room is None:
        raise AttributeError(f"module 'wepose_pin' has no attribute '{name}'")
    return getattr(import_module(f".{room}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
