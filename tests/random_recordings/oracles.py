"""What must hold of every command and every result, whatever the recording.

Each oracle gives failures: `Failure(oracle, command, message)`. None knows how the project works.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from . import adapter
from .adapter import Outcome, Result
from .cases import Case
from .people import SIDES
from .recordings import Recorded, Truth, truth_at

# An error counts by its size over the stated one of all three axes together: √3 times the column, which is that of one
# axis, the mean over the three. Where all of an error is heading, this is the heading's own standard deviation.
MOST_Z = 6.0
ALL_AXES = np.sqrt(3.0)
# What no filter states: quantisation, the last sample's own rotation, times to a microsecond [rad], [m].
FLOOR_RAD, FLOOR_M = np.deg2rad(0.15), 0.002
# Of orientations that a device fused by itself nothing is stated: its own error and that of the alignment [rad].
FUSED_RAD = np.deg2rad(4.0)
UNIT = 1e-9  # how far a quaternion's norm may be off 1
RIGID = 1e-6  # [m] how far two points' distance may be off the length that the result states
# Methods that state nothing are not held to a number here, but after minutes nobody is upside down in tilt.
UNSTATED_TILT_DEG = 60.0


@dataclass
class Failure:
    """What did not hold."""

    oracle: str
    command: str
    message: str


def of_outcome(outcome: Outcome, out: object = None) -> list[Failure]:
    """The exit code, and how a refusal is said."""
    shown = " ".join(outcome.argv)
    if outcome.traceback:
        last = outcome.traceback.strip().splitlines()
        return [Failure("no traceback", shown, f"{last[-1]} | {_innermost(last)}")]
    if outcome.code not in adapter.codes(outcome.argv[0]):
        return [Failure("documented exit code", shown, f"exit {outcome.code}: {outcome.err.strip()[-300:]}")]
    failures = []
    if outcome.code == 2:
        if not adapter.is_one_line(outcome):
            failures.append(Failure("one line", shown, outcome.err.strip()[:500]))
        elif not adapter.names_something(outcome):
            failures.append(Failure("names the offender", shown, adapter.refusal(outcome)))
        if out is not None and (left := adapter.left_behind(out)):  # type: ignore[arg-type]
            failures.append(Failure("nothing half-written", shown, ", ".join(left)))
    return failures


def _innermost(lines: list[str]) -> str:
    places = [line.strip() for line in lines if line.strip().startswith("File ")]
    return places[-1] if places else ""


def of_acceptance(outcome: Outcome, case: Case, extra: str = "") -> list[Failure]:
    """What is physically possible is accepted; what cannot be known is refused."""
    shown, refusal = " ".join(outcome.argv), extra or case.refusal
    if outcome.code == 2 and not refusal:
        return [Failure("accepts what is possible", shown, adapter.refusal(outcome))]
    # Refused for another reason, as a row that is written twice, it need not say so.
    if outcome.code == 2 and "guessed" in refusal and "mount" in outcome.err and "[phases]" not in outcome.err:
        return [Failure("says that the start pose may be another", shown, adapter.refusal(outcome))]
    if outcome.code != 2 and refusal.startswith("must"):
        return [Failure("refuses what cannot be", shown, f"exit {outcome.code}, though {refusal}")]
    return []


def of_result(result: Result, shown: str) -> list[Failure]:
    """Numbers everywhere, unit quaternions, points as far apart as the lengths say."""
    failures = []
    lost = {name for name, gap in result.gap.items() if gap.any()}
    for name in result.table.columns:
        values = result.table[name].to_numpy()
        if values.dtype == bool or np.isfinite(values).all():
            continue
        of = next((segment for segment in lost if name.startswith(segment)), None)
        bad = ~np.isfinite(values)
        if of is not None and not (bad & ~result.gap[of]).any():
            continue
        failures.append(Failure("no undeclared NaN", shown, f"{name}: {np.count_nonzero(bad)} of {len(bad)}"))
    if failures:
        return failures[:3]
    for name, quat in result.quat.items():
        off = float(np.max(np.abs(np.linalg.norm(quat, axis=1) - 1.0)))
        if off > UNIT:
            failures.append(Failure("unit quaternions", shown, f"{name}: norm is off 1 by {off:.3g}"))
    joints = ("shoulder", "elbow", "upper_arm"), ("elbow", "wrist", "forearm"), ("wrist", "palm", "hand")
    for one, other, segment in [[f"{side}_{name}" for name in names] for side in SIDES for names in joints]:
        if one in result.points and other in result.points:  # shoulders move on the torso: `_shoulders`
            apart, length = np.linalg.norm(result.points[one] - result.points[other], axis=1), result.lengths[segment]
            off = float(np.max(np.abs(apart - length)))
            if off > RIGID:
                message = f"{one} to {other}: {1e3 * off:.3g} mm off {length:.4f} m"
                failures.append(Failure("lengths hold", shown, message))
    for name, wanted in _shoulders(result).items():
        off = float(np.max(np.linalg.norm(result.points[name] - wanted, axis=1)))
        if off > RIGID:
            failures.append(Failure("shoulders follow the arms", shown, f"{name}: {1e3 * off:.3g} mm off"))
    for name, std in [*result.quat_std.items(), *result.points_std.items()]:
        if (std < 0.0).any():
            failures.append(Failure("± is a number", shown, f"{name}: {std.min():.3g}"))
    return failures


def _shoulders(result: Result) -> dict[str, np.ndarray]:
    """Shoulder → where it is (n, 3) [m] by the law of urdf/upper_body.toml, and what the subject differs by."""
    wanted = {}
    for side, sign in zip(("left", "right"), (1.0, -1.0), strict=True):
        point, arm = f"{side}_shoulder", f"{side}_upper_arm"
        if point not in result.points:
            continue
        share, *own = result.girdles.get(point, np.zeros(7))
        at = np.array([0.0, sign * result.lengths["shoulder_width"] / 2.0, result.lengths["trunk"]]) + own[:3]
        R_torso = Rotation.from_quat(result.quat["torso"])
        if arm in result.quat:
            along = (R_torso.inv() * Rotation.from_quat(result.quat[arm])).apply([0.0, 0.0, -1.0])
            sine = np.sqrt(along[:, 0] ** 2 + along[:, 1] ** 2 + 1e-9)
            e, out = np.minimum(np.arctan2(sine, -along[:, 2]), np.deg2rad(130.0)), sign * along[:, 1] / sine
            s = e / np.deg2rad(90.0)
            up, middle = (0.021 + 0.0125 * out) * s, (0.008 + 0.015 * out) * s
            back = 0.002 * s**2 + 0.020 * (1.0 - np.exp(-e / np.deg2rad(25.0))) * out
            law = np.column_stack((-back, -sign * middle, up)) * result.lengths["shoulder_width"] / 0.34
            at = at + (1.0 + share) * law + s[:, None] * own[3:]
        else:
            at = np.tile(at, (len(result.time), 1))
        wanted[point] = R_torso.apply(at)
    return wanted


def of_errors(result: Result, case: Case, recorded: Recorded, shown: str) -> tuple[list[Failure], float, Truth]:
    """Errors within six stated deviations, or a diagnostic that names the cause; the largest z that none names."""
    truth = truth_at(case, result.time, recorded.origin, result.start, result.calibrated)
    worst: list[tuple[float, str, int, str]] = []
    for name, quat in result.quat.items():
        error = (truth.R_WL[name].inv() * Rotation.from_quat(quat)).magnitude()
        over = np.maximum(error - truth.turned[name] - FLOOR_RAD, 0.0)
        fused = case.worn[name].orientation
        if result.quat_std.get(name) is None and fused is not None and name in result.calibrated:
            continue  # a calibrated mount's own error, of which the result says nothing
        z = _z(over, result.quat_std.get(name), fused, truth.R_WL[name], quat)
        k = int(np.argmax(z))
        std = result.quat_std.get(name)
        stated_ = f" at ± {np.degrees(std[k]):.2f}" if std is not None else ""
        worst.append((float(z[k]), name, k, f"{np.degrees(error[k]):.2f} deg{stated_}"))
    for name, place in result.points.items():
        std = result.points_std.get(name)
        if std is None:
            continue
        error = np.linalg.norm(place - truth.points[name], axis=1)
        z = np.maximum(error - truth.moved[name] - FLOOR_M, 0.0) / (ALL_AXES * np.maximum(std, 1e-9))
        k = int(np.argmax(z))
        worst.append((float(z[k]), name, k, f"{1e3 * error[k]:.0f} mm at ± {1e3 * std[k]:.0f}"))
    causes = {*case.suspects.values(), *(["gap"] if case.clock.lost else [])}
    for z_, name, k, error_ in sorted(worst, reverse=True):
        if z_ > MOST_Z and adapter.named_cause(result.diagnostics, _behind(name, case), causes):
            continue
        message = f"{name} is {error_} at {result.time[k] - recorded.origin:.1f} s: z = {z_:.1f}"
        failure = Failure(f"error within {MOST_Z:g} ± or a warning", shown, message)
        return [failure] * (z_ > MOST_Z), z_, truth
    return [], 0.0, truth


def _z(over: np.ndarray, std: np.ndarray | None, fused: float | None, R: Rotation, quat: np.ndarray) -> np.ndarray:
    """Error over what is stated, or over what may be expected where nothing is."""
    if std is not None:
        return over / (ALL_AXES * np.maximum(std, 1e-9))
    if fused is not None:
        return MOST_Z * over / (FUSED_RAD + fused)
    up = R.apply([0.0, 0.0, 1.0], inverse=True)
    seen = Rotation.from_quat(quat).apply([0.0, 0.0, 1.0], inverse=True)
    tilt = np.degrees(np.arccos(np.clip(np.sum(up * seen, axis=1), -1.0, 1.0)))
    return MOST_Z * tilt / UNSTATED_TILT_DEG


def _behind(name: str, case: Case) -> list[str]:
    """Segments on which a segment or point depends."""
    if name in case.worn:
        return [name]
    side, part = name.split("_")
    chain = ["torso", f"{side}_upper_arm", f"{side}_forearm", f"{side}_hand"]
    return chain[: 1 + ("shoulder", "elbow", "wrist", "palm").index(part)]


def of_same_table(one: pl.DataFrame, other: pl.DataFrame, oracle: str, shown: str) -> list[Failure]:
    """The same columns with the same bits."""
    if one.equals(other):
        return []
    if one.columns != other.columns or one.height != other.height:
        columns = set(one.columns) ^ set(other.columns)
        return [Failure(oracle, shown, f"{one.shape} and {other.shape}, columns {columns}")]
    differ = [name for name in one.columns if not one[name].equals(other[name])]
    size = max(np.nanmax(np.abs(np.subtract(one[n].to_numpy(), other[n].to_numpy(), dtype=float))) for n in differ)
    return [Failure(oracle, shown, f"{len(differ)} columns differ by up to {size:.3g}: {', '.join(differ[:4])}")]
