"""A case's samples, and the truth as the project can know it.

`Variant` is the same physics written or sampled otherwise, for what must not depend on it.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .activities import Scene, stand
from .cases import Case
from .people import joint_points
from .sensors import Signals, Worn, axes_rotation, measure, peak_share

MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Variant:
    """How a recording differs from the case's: nothing, by default."""

    axes: bool = False  # sensors sit otherwise in their cases
    other_units: bool = False
    mirrored: bool = False
    shift: float = 0.0  # [s] on the clock
    before: float = 0.0  # [s] of standing before
    after: float = 0.0  # and after
    written: tuple[float, float] = (-np.inf, np.inf)  # shares of the case's duration from and to which samples are
    finer: int = 1  # times the rate
    half: int = 1  # the noise is that of so many times the rate, averaged


@dataclass
class Table:
    """One file: its times as written (None: only the rate is stated), and signals by segment."""

    stamps: np.ndarray | None
    rate_hz: float
    signals: dict[str, Signals]
    offset: float = 0.0


@dataclass
class Recorded:
    """What is written, and the stated mounts (sensor axes up and forward) and spans on the file's clock [s]."""

    tables: list[Table]
    axes: dict[str, tuple[str, str] | None]
    start: tuple[float, float] | None
    clasp: tuple[float, float] | None
    origin: float  # [s] the file's clock at the motion's time zero
    share_of_range: dict[str, float] = field(default_factory=dict)  # 1: clipped


def record(case: Case, variant: Variant | None = None) -> Recorded:
    """The samples of a case."""
    v = variant or Variant()
    clock = case.clock
    begin, motion, duration = -v.before, case.motion, case.duration + v.after
    if v.after:
        standing = stand(Scene(case.stream("after"), case.person, case.duration, duration))
        activities, begins = [*motion.activities, standing], [*motion.begins, case.duration]
        motion = replace(motion, activities=activities, begins=begins, joins=[*motion.joins, 2.0])
    rng = case.stream("clock-noise")
    origin = clock.origin + v.shift
    groups = [[name] for name in case.worn] if clock.separate else [list(case.worn)]
    tables, axes, shares = [], {}, {}
    for group in groups:
        ahead, own_rate = (
            (rng.uniform(-0.3, 0.0), clock.rate_hz * (1.0 + rng.choice([0.0, 2e-3])))
            if clock.separate
            else (0.0, clock.rate_hz)
        )
        n = int((duration - begin - ahead) * own_rate)
        t = begin + ahead + np.arange(n) / own_rate
        if v.finer > 1:  # those whose noise `_averaged` takes for the coarser ones
            own_rate *= v.finer
            t = t[0] + np.arange(1 - v.finer, 1 - v.finer + v.finer * n) / own_rate
        if clock.stamps == "uneven":
            t = t + 0.3 / own_rate * rng.uniform(-1.0, 1.0, n)
        worn = {name: case.worn[name] for name in group}
        signals = _averaged(case, worn, t, v.half) if v.half > 1 else measure(motion, worn, t, case.noise)
        shares |= {name: peak_share(signals[name], case.worn[name].errors) for name in group}
        for begin_gap, lasts, segment in clock.lost:
            away = (t >= begin_gap) & (t < begin_gap + lasts)
            for name in group:
                if segment == name:
                    for values in (signals[name].gyro, signals[name].accel, signals[name].quat):
                        if values is not None and len(values):
                            values[away] = np.nan
            if not segment:
                keep = ~away
                t = t[keep]
                signals = {name: _rows(s, keep) for name, s in signals.items()}
        keep = (t >= v.written[0] * case.duration) & (t < v.written[1] * case.duration)
        t, signals = t[keep], {name: _rows(s, keep) for name, s in signals.items()}
        begin = float(t[0]) if clock.stamps == "none" else begin
        stamps = t + _stamp_errors(clock.stamps, t, own_rate, rng) + origin
        if clock.stamps == "rounded":
            stamps = np.round(stamps, 3)
        if clock.twice:
            double = np.sort(np.concatenate([np.arange(len(t)), rng.choice(len(t), clock.twice, replace=False)]))
            stamps, signals = stamps[double], {name: _rows(s, double) for name, s in signals.items()}
        offset = float(rng.uniform(-2.0, 2.0)) if clock.separate else 0.0
        stated = None if clock.stamps == "none" else stamps - offset
        tables.append(Table(stated, own_rate, signals, offset))
    for name, sensor in case.worn.items():
        axes[name] = sensor.axes
    shift = origin if clock.stamps != "none" else -begin
    made = Recorded(tables, axes, _moved(case.start, shift), _moved(case.clasp, shift), shift, shares)
    if case.shared_columns:
        whole = {name: table.signals[name] for table in made.tables for name in table.signals}
        for table in made.tables:
            table.signals = {name: whole[case.shared_columns.get(name, name)] for name in table.signals}
    if v.axes:
        _turn_axes(made, case.stream("axes"))
    if v.mirrored:
        _mirror(made)
    return made


def _moved(span: tuple[float, float] | None, by: float) -> tuple[float, float] | None:
    return None if span is None else (span[0] + by, span[1] + by)


def _rows(signals: Signals, rows: np.ndarray) -> Signals:
    quat = None if signals.quat is None else signals.quat[rows]
    return Signals(
        signals.gyro[rows] if len(signals.gyro) else signals.gyro,
        signals.accel[rows] if len(signals.accel) else signals.accel,
        quat,
    )


def _stamp_errors(kind: str, t: np.ndarray, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    """What the stamps are late by [s]."""
    if kind == "jitter":
        return np.clip(rng.normal(0.0, 0.08, len(t)), -0.3, 0.3) / rate_hz
    if kind == "packets":  # of four, stamped when the last is there, a hundredth of a step apart
        place = np.arange(len(t)) % 4
        return (3.0 - 0.99 * place) / rate_hz
    return np.zeros(len(t))


def _averaged(case: Case, worn: dict[str, Worn], t: np.ndarray, times: int) -> dict[str, Signals]:
    """Samples whose noise is that of so many times the rate, averaged: what a finer recording would give, thinned."""
    step = (t[1] - t[0]) / times
    fine = t[0] - (t[1] - t[0]) + step * np.arange(1, times * len(t) + 1)
    errors = {name: replace(s, errors=replace(s.errors, bits=40)) for name, s in worn.items()}
    quiet = {
        name: replace(s, errors=replace(s.errors, gyro_noise=0.0, accel_noise=0.0, gyro_walk=0.0))
        for name, s in errors.items()
    }
    noisy, clean = (measure(case.motion, of, fine, case.noise) for of in (errors, quiet))
    coarse = measure(case.motion, quiet, t, case.noise)
    for name, signals in coarse.items():
        if signals.quat is None:
            for of in ("gyro", "accel"):
                noise = (getattr(noisy[name], of) - getattr(clean[name], of)).reshape(len(t), times, 3).mean(axis=1)
                setattr(signals, of, getattr(signals, of) + noise)
    return coarse


def _turn_axes(made: Recorded, rng: np.random.Generator) -> None:
    """Each sensor's axes exchanged: x of one becomes −y of the other, say. Signals and stated mounts alike."""
    names = {sign + axis: s * np.eye(3)[k] for sign, s in (("+", 1.0), ("-", -1.0)) for k, axis in enumerate("xyz")}
    cube = list(Rotation.create_group("O"))
    for table in made.tables:
        for name, signals in table.signals.items():
            A = np.round(cube[rng.integers(1, len(cube))].as_matrix())
            quat = (
                None
                if signals.quat is None
                else (Rotation.from_quat(signals.quat) * Rotation.from_matrix(A).inv()).as_quat()
            )
            table.signals[name] = Signals(signals.gyro @ A.T, signals.accel @ A.T, quat)
            axes = made.axes[name]
            if axes is not None:
                moved = [next(key for key, value in names.items() if np.allclose(value, A @ names[of])) for of in axes]
                made.axes[name] = (moved[0], moved[1])


def _mirror(made: Recorded) -> None:
    """Left becomes right; sensors are mirrored along their own y, so that they stay right-handed."""

    def flipped(axis: str) -> str:
        return axis if axis[1] != "y" else {"+": "-", "-": "+"}[axis[0]] + "y"

    for table in made.tables:
        mirrored = {}
        for name, s in table.signals.items():
            # Orientations: M R M, whose quaternion is (−x, y, −z, w).
            quat = None if s.quat is None else s.quat * [-1.0, 1.0, -1.0, 1.0]
            mirrored[other_side(name)] = Signals(-s.gyro @ MIRROR, s.accel @ MIRROR, quat)
        table.signals = mirrored
    made.axes = {
        other_side(name): None if axes is None else (flipped(axes[0]), flipped(axes[1]))
        for name, axes in made.axes.items()
    }


def other_side(name: str) -> str:
    """left_… for right_… and the other way."""
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


# Truth -------------------------------------------------------------------------------------------------------------


@dataclass
class Truth:
    """Orientations and points at the times asked, and what the stamps' errors [s] may turn or move them by."""

    R_WL: dict[str, Rotation]
    points: dict[str, np.ndarray]
    turned: dict[str, np.ndarray]  # segment → (n,) [rad]
    moved: dict[str, np.ndarray]  # point → (n,) [m]


def truth_at(
    case: Case, stamps: np.ndarray, origin: float, start: tuple[float, float], calibrated: Collection[str] = ()
) -> Truth:
    """The motion at a file's times (n,) [s].

    Where a mount is stated the project says: as a segment is in the start pose on the mean, so is the N-pose, and the
    mount is exact. Truth is then a segment's motion since that mean, in a world that is off by what the heading of the
    stated mount is off. Of the `calibrated` ones truth is anatomy, where the trunk faces x in the start pose.
    """
    t = stamps - origin
    late = case.clock.late
    held = np.linspace(start[0] - origin, start[1] - origin, 200)
    at_start = {name: R.mean() for name, R in case.motion.orientations(held).items()}
    R_WL = {
        name: _aligned(case, name, R, at_start, name in calibrated) for name, R in case.motion.orientations(t).items()
    }
    points = joint_points(case.person.lengths, _worn_only(case, R_WL))
    turned = {name: np.zeros(len(t)) for name in R_WL}
    moved = {name: np.zeros(len(t)) for name in points}
    if late > 0.0:
        before = case.motion.orientations(t - late)
        near = {name: _aligned(case, name, R, at_start, name in calibrated) for name, R in before.items()}
        turned = {name: (R.inv() * near[name]).magnitude() for name, R in R_WL.items()}
        near_points = joint_points(case.person.lengths, _worn_only(case, near))
        moved = {name: np.linalg.norm(p - near_points[name], axis=1) for name, p in points.items()}
    return Truth(R_WL, points, turned, moved)


def _worn_only(case: Case, R_WL: dict[str, Rotation]) -> dict[str, Rotation]:
    return {name: R for name, R in R_WL.items() if name in case.worn}


def _aligned(case: Case, name: str, R: Rotation, at_start: dict[str, Rotation], calibrated: bool) -> Rotation:
    facing = Rotation.from_rotvec([0.0, 0.0, -at_start["torso"].as_euler("ZYX")[0]])
    if calibrated or name not in case.worn:
        return facing * R
    sensor = case.worn[name]
    assert sensor.axes is not None
    # Heading of the stated mount: the turn about the vertical that brings the true one nearest to it.
    M = (facing * at_start[name] * sensor.mount * axes_rotation(*sensor.axes).inv()).as_matrix()
    heading = Rotation.from_rotvec([0.0, 0.0, np.arctan2(M[0, 1] - M[1, 0], M[0, 0] + M[1, 1])])
    world = heading * facing
    return world * R * at_start[name].inv() * world.inv()
