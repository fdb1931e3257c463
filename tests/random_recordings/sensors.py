"""What a worn inertial sensor gives of a motion: data-sheet errors, ranges, and faults."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .motion import GRAVITY, Motion

DEG = np.pi / 180.0
BLOCK = 1 << 13  # samples


@dataclass(frozen=True)
class Errors:
    """One device's errors, as data sheets state them. Noise densities are for one axis, white."""

    gyro_noise: float  # [rad/s/√Hz]
    accel_noise: float  # [m/s²/√Hz]
    gyro_bias: np.ndarray  # (3,) [rad/s]
    gyro_walk: float  # [rad/s/√s]
    accel_bias: np.ndarray  # (3,) [m/s²]
    gyro_scale: np.ndarray  # (3,) relative
    accel_scale: np.ndarray  # (3,) relative
    gyro_range: float = 2000.0 * DEG  # [rad/s]
    accel_range: float = 16.0 * GRAVITY  # [m/s²]
    bits: int = 16


def draw_errors(rng: np.random.Generator) -> Errors:
    """Between a good and a cheap MEMS device: densities of BMI088, ICM-20948, MTi-3; bias after a usual calibration."""

    def direction() -> np.ndarray:
        v = rng.standard_normal(3)
        return v / np.linalg.norm(v)

    return Errors(
        gyro_noise=rng.uniform(0.004, 0.02) * DEG,
        accel_noise=rng.uniform(60.0, 250.0) * 1e-6 * GRAVITY,
        gyro_bias=np.exp(rng.uniform(np.log(0.1), np.log(1.0))) * DEG * direction(),
        gyro_walk=np.exp(rng.uniform(np.log(1e-4), np.log(1e-3))) * DEG,
        accel_bias=rng.uniform(2e-3, 1.5e-2) * GRAVITY * direction(),
        gyro_scale=rng.uniform(-1.0, 1.0, 3) * rng.choice([0.003, 0.01]),
        accel_scale=rng.uniform(-1.0, 1.0, 3) * 0.004,
    )


@dataclass
class Worn:
    """A sensor on a segment.

    `place` (3,) [m] in the segment; `mount` takes sensor to segment; `axes` are its axes that point up and forward as
    the user states them, None where he does not. `orientation` [rad]: it gives orientations with an error of this size.
    `fault` with `fault_at` [s].
    """

    segment: str
    place: np.ndarray
    mount: Rotation
    axes: tuple[str, str] | None
    errors: Errors
    orientation: float | None = None
    fault: str = ""
    fault_at: float = 0.0
    fault_of: str = "gyro"  # what stops: gyro, accel or both


@dataclass
class Signals:
    """Of one sensor at n times: `gyro` [rad/s] over the interval that ends there, `accel` [m/s²], or `quat` xyzw."""

    gyro: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    accel: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    quat: np.ndarray | None = None


def axes_rotation(up: str, forward: str) -> Rotation:
    """Sensor to segment, where these sensor axes point up and forward in the upright stance."""
    axis = {sign + name: s * np.eye(3)[k] for sign, s in (("+", 1.0), ("-", -1.0)) for k, name in enumerate("xyz")}
    z, x = axis[up], axis[forward]
    return Rotation.from_matrix(np.array([x, np.cross(z, x), z]))


def measure(
    motion: Motion, worn: Mapping[str, Worn], t: np.ndarray, chance: Callable[[str], np.random.Generator]
) -> dict[str, Signals]:
    """What sensors give that sample at the times `t` (n,) [s]; a stretch before each is seen too.

    `chance` gives each sensor random numbers of its own, that do not depend on which others are worn.
    """
    before = np.concatenate([[2.0 * t[0] - t[1]], t])
    R, force = _in_blocks(motion, before, {name: sensor.place for name, sensor in worn.items()})
    dt = np.diff(before)
    measured = {}
    for name, sensor in worn.items():
        rng, R_WS = chance(name), R[name] * sensor.mount
        if sensor.orientation is not None:
            measured[name] = Signals(quat=_fused(R_WS[1:], sensor.orientation, t, rng))
            continue
        rate = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() / dt[:, None]
        accel = R_WS[1:].apply(force[name][1:], inverse=True)
        signals = with_errors(rate, accel, dt, sensor.errors, rng)
        measured[name] = with_fault(signals, sensor, t)
    return measured


def _in_blocks(
    motion: Motion, t: np.ndarray, places: dict[str, np.ndarray]
) -> tuple[dict[str, Rotation], dict[str, np.ndarray]]:
    """As `Motion.at_sensors`, some minutes at once: of a long recording each sees only the activities of its time."""
    parts = [motion.at_sensors(t[first : first + BLOCK], places) for first in range(0, len(t), BLOCK)]
    return (
        {name: Rotation.concatenate([R[name] for R, _ in parts]) for name in places},
        {name: np.concatenate([force[name] for _, force in parts]) for name in places},
    )


def _fused(R_WS: Rotation, size: float, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Orientations in a world of the device's own heading, with a slow small error."""
    wave = np.sin(2 * np.pi * rng.uniform(0.02, 0.2, 3) * t[:, None] + rng.uniform(0, 2 * np.pi, 3))
    own = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    return (own * R_WS * Rotation.from_rotvec(size * wave)).as_quat()


def with_errors(
    rate: np.ndarray, accel: np.ndarray, dt: np.ndarray, errors: Errors, rng: np.random.Generator
) -> Signals:
    """Noise, bias that walks, scale, range and quantum."""
    n = len(rate)
    per_sample = 1.0 / np.sqrt(np.median(dt))
    walk = np.cumsum(rng.standard_normal((n, 3)) * errors.gyro_walk * np.sqrt(dt)[:, None], axis=0)
    gyro = rate * (1.0 + errors.gyro_scale) + errors.gyro_bias + walk
    gyro = gyro + errors.gyro_noise * per_sample * rng.standard_normal((n, 3))
    force = accel * (1.0 + errors.accel_scale) + errors.accel_bias
    force = force + errors.accel_noise * per_sample * rng.standard_normal((n, 3))
    return Signals(_digital(gyro, errors.gyro_range, errors.bits), _digital(force, errors.accel_range, errors.bits))


def _digital(values: np.ndarray, limit: float, bits: int) -> np.ndarray:
    quantum = limit / 2 ** (bits - 1)
    return np.clip(np.round(values / quantum) * quantum, -limit, limit - quantum)


def with_fault(signals: Signals, sensor: Worn, t: np.ndarray) -> Signals:
    """What a broken sensor writes."""
    for name in ("gyro", "accel"):
        if sensor.fault_of not in (name, "both") or not sensor.fault:
            continue
        values = getattr(signals, name)
        k = min(int(np.searchsorted(t, sensor.fault_at)), len(t) - 1)
        if sensor.fault == "dead":
            values[:] = 0.0
        elif sensor.fault == "stuck":
            values[:] = values[0]
        elif sensor.fault == "frozen":
            values[k:] = values[k]
        elif sensor.fault == "lost":
            values[k:] = np.nan
    return signals


def peak_share(signals: Signals, errors: Errors) -> float:
    """The largest value as a share of the sensor's range: 1 is clipped."""
    if signals.quat is not None:
        return 0.0
    gyro, accel = (float(np.nanmax(np.abs(v))) for v in (signals.gyro, signals.accel))
    return max(gyro / errors.gyro_range, accel / errors.accel_range)
