"""From a recorded pose to a trajectory: approach, what the motion asks for, slower where the robot cannot, and the run.

The motion is solved twice. The first run has wide limits on velocity and acceleration and shows which joint would have
to be how fast where; from that follows how much longer each moment takes. The second run has the true limits, on the
stretched time, and leans on the path of the first.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ..arguments import check_arguments
from ..errors import BadOption, NoSolution
from ..pose import Pose
from .collision import Shapes
from .maps import find_map
from .person import SMOOTHING_HZ, ArmTarget, Wish, bend_of, replace_rates, resampled, wish
from .robot import Robot, load
from .solver import Counts, Held, State, Stepper, Tasks, aims_at

RATE_HZ = 100.0
LOOSE = 8.0  # how much wider the first run's limits are
MOST = 6.0  # times longer a moment takes at most; what is still too fast then lags behind
VELOCITY_SHARE, ACCELERATION_SHARE, JERK_SHARE = (
    0.85,
    0.6,
    0.6,
)  # of the limits that the motion may ask for: the rest is for catching up
SPREAD_S = 0.15  # [s] to each side over which a slow moment slows its surroundings
APPROACH_SPEED, APPROACH_RATE = 0.25, 0.6  # [m/s], [rad/s] of the hands on their way from rest
APPROACH_LEAST_S, SETTLE_S = 2.0, 1.0
FADE_S = 0.5  # [s] of the motion's end that take twice as long, fading to rest
HALT_S = 0.3  # [s] in which the very last of it fades
TIGHT = 0.25  # share of the clearance: shapes that come nearer are slowed where they do
TIGHT_BEFORE_S, TIGHT_AFTER_S = 0.6, 0.2  # [s] of the motion about such a moment that are slowed, each time twice
TIGHT_RUNS = 3  # so often the motion is slowed and run again
STRICT = 1.02  # slower than this, and --strict refuses


class Slowest(NamedTuple):
    """The joint that asks for most time, and where."""

    joint: str
    time: float  # [s] of the recording
    factor: float
    what: str  # "velocity", "acceleration" or "jerk"


@dataclass(frozen=True)
class Trajectory:
    """What the robot does.

    Parameters
    ----------
    time : (n,) [s] from 0, at an even rate
    recorded : (n,) [s] of the recording that each moment shows; the first moment's during the approach
    approach : samples that lead from rest to the recording's first moment
    u, v, a : (n, joints) positions, velocities, accelerations [rad or m, s]; over a step the jerk is even, so that a is
        a line, v a parabola and u a cubic: any denser rate has the same limits
    targets : what the hands were asked for at these times
    hand, turn, bend : side → position (n, 3) [m] in the root, rotation (n, 3, 3) and elbow's bend (n, 3) that came out
    closest : (n,) [m] between convex hulls; inf where nothing was near
    held : what held joints and arms in the step from each sample
    solve_s : (n,) [s] that each step took
    slowest : None where nothing had to be slowed for a limit
    tight : moments [s] of the recording that were slowed so that the robot does not touch itself
    """

    robot: Robot
    shapes: Shapes
    tasks: Tasks
    wish: Wish
    time: np.ndarray
    recorded: np.ndarray
    approach: int
    u: np.ndarray
    v: np.ndarray
    a: np.ndarray
    targets: tuple[ArmTarget, ...]
    hand: dict[str, np.ndarray]
    turn: dict[str, np.ndarray]
    bend: dict[str, np.ndarray]
    closest: np.ndarray
    held: Held
    solve_s: np.ndarray
    counts: Counts
    slowest: Slowest | None
    tight: tuple[float, ...] = ()


def retarget(
    pose: Pose,
    robot: Robot | str | Path,
    *,
    rate_hz: float = RATE_HZ,
    tasks: Tasks | None = None,
    scale: float | None = None,
    smoothing_hz: float = SMOOTHING_HZ,
    strict: bool = False,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> Trajectory:
    """The robot's trajectory for a person's motion, at rest before its first moment.

    Parameters
    ----------
    robot : as `load` gives it; or as `find_map` takes it, a name such as "panda" or a file: then with all its arms
    rate_hz : of the trajectory
    scale, smoothing_hz : as `wish`
    strict : refuse a motion that is too fast for the robot, in place of slowing it
    progress : told what is done and which share of it is

    Raises
    ------
    BadData, BadOption
        The pose lacks an arm; a rate that is none.
    NoSolution
        `strict`, and the motion is too fast.
    """
    check_arguments(retarget, locals())
    if not isinstance(robot, Robot):
        robot = load(find_map(str(robot)))
    if not 10.0 <= rate_hz <= 2000.0:
        raise BadOption(f"--rate-hz {rate_hz:g}: from 10 to 2000 samples a second")
    tasks, dt = tasks or Tasks(), 1.0 / rate_hz
    asked = wish(pose, robot, scale=scale, smoothing_hz=smoothing_hz)
    shapes = Shapes(robot)
    even = np.arange(0.0, asked.time[-1] - asked.time[0] + 0.5 * dt, dt)
    motion = resampled(asked, asked.time[0] + even, even)
    first, approach = _approach(Stepper(robot, shapes, dt, tasks), motion, dt)
    n = len(first.time)
    wide = Stepper(robot, shapes, dt, tasks, loose=LOOSE)
    path, _ = _run(wide, first, None, 0, lambda share: progress("looking at the motion", share))
    factor, slowest = _slower(path, robot, dt, first, approach)
    if strict and slowest is not None and slowest.factor > STRICT:
        raise NoSolution(
            f"{robot.map.name}: too fast at {slowest.time:.2f} s of the recording: {slowest.joint} would need "
            f"{slowest.factor:.1f} times its {slowest.what} limit; without --strict the motion is slowed there"
        )
    lean = CubicSpline(np.arange(n) * dt, gaussian_filter1d(path[0], 0.03 / dt, axis=0, mode="nearest"))
    tight: tuple[float, ...] = ()
    settle = SETTLE_S
    for runs in range(1 + TIGHT_RUNS):
        stretched = np.concatenate([[0.0], np.cumsum(0.5 * (factor[1:] + factor[:-1])) * dt])
        stretched = _fading(stretched)
        time = np.arange(0.0, stretched[-1] + settle + HALT_S, dt)
        index = np.interp(time, stretched, np.arange(n))
        targets = _on(first, index, time, dt)
        reference = lean(np.minimum(index, n - 1) * dt)
        exact = Stepper(robot, shapes, dt, replace(tasks, posture=50.0 * tasks.posture, posture_gain=8.0))
        found, seen = _run(exact, targets, reference, round(HALT_S / dt), lambda share: progress("solving", share))
        near = np.flatnonzero(seen.room < TIGHT)
        rests = float(np.abs([found[1][-1], found[2][-1]]).max()) < 1e-9  # a robot that lags far behind needs longer
        if (rests and not len(near)) or runs == TIGHT_RUNS:
            break
        settle += 0.0 if rests else SETTLE_S
        if not len(near):
            continue
        moment = index[near[np.diff(near, prepend=-2) > 1]]
        if strict:
            raise NoSolution(
                f"{robot.map.name}: too fast at {first.time[int(moment[0])]:.2f} s of the recording: it could not stop "
                f"before it touches itself; without --strict the motion is slowed there"
            )
        tight = tuple(sorted({*tight, *np.round(first.time[moment.astype(int)], 2).tolist()}))
        factor = factor * _slower_about(index[near], n, dt)
    return Trajectory(
        robot=robot,
        shapes=shapes,
        tasks=tasks,
        wish=asked,
        time=time,
        recorded=targets.time,
        approach=int(np.searchsorted(time, stretched[approach])),
        u=found[0],
        v=found[1],
        a=found[2],
        targets=targets.arms,
        hand={arm.side: seen.hand[i] for i, arm in enumerate(robot.arms)},
        turn={arm.side: seen.turn[i] for i, arm in enumerate(robot.arms)},
        bend={arm.side: seen.bend[i] for i, arm in enumerate(robot.arms)},
        closest=seen.closest,
        held=seen.held,
        solve_s=seen.solve_s,
        counts=exact.counts,
        slowest=slowest,
        tight=tight,
    )


class _Seen(NamedTuple):
    hand: list[np.ndarray]
    turn: list[np.ndarray]
    bend: list[np.ndarray]
    closest: np.ndarray
    room: np.ndarray
    held: Held
    solve_s: np.ndarray


def _run(
    stepper: Stepper, motion: Wish, reference: np.ndarray | None, halts: int, progress: Callable[[float], None]
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], _Seen]:
    """u, v, a (n, joints) from rest on, and what was seen; it halts in the last `halts`."""
    robot, n, arms = stepper.robot, len(motion.time), len(stepper.robot.arms)
    u, v, a = (np.zeros((n, len(robot.names))) for _ in range(3))
    seen = _Seen(
        [np.empty((n, 3)) for _ in range(arms)], [np.empty((n, 3, 3)) for _ in range(arms)],
        [np.empty((n, 3)) for _ in range(arms)], np.full(n, np.inf), np.full(n, np.inf),
        Held(np.zeros(u.shape, dtype=bool), np.zeros((n, arms), dtype=bool)), np.zeros(n),
    )  # fmt: skip
    state = State(robot.rest.copy(), np.zeros(len(robot.names)), np.zeros(len(robot.names)))
    pull = None if reference is None else np.gradient(reference, stepper.dt, axis=0)
    for k in range(n):
        u[k], v[k], a[k] = state.u, state.v, state.a
        begin = clock.perf_counter()
        if reference is not None and pull is not None:
            stepper.lean = (reference[k], pull[min(k + 1, n - 1)])
        left = n - 1 - k
        after = stepper.halt(state, left) if left < halts else stepper.step(state, aims_at(motion.arms, k, stepper.dt))
        seen.solve_s[k] = clock.perf_counter() - begin
        seen.closest[k], seen.room[k] = stepper.closest, stepper.room
        seen.held.joints[k], seen.held.shapes[k] = stepper.held
        for i in range(arms):
            seen.hand[i][k], seen.turn[i][k], seen.bend[i][k] = stepper.place(i)
        state = after
        if k % 64 == 0:
            progress(k / n)
    for i, arm in enumerate(robot.arms):
        seen.bend[i][:] = bend_of(seen.bend[i] - arm.shoulder, seen.hand[i] - arm.shoulder)
    return (u, v, a), seen


def _approach(stepper: Stepper, motion: Wish, dt: float) -> tuple[Wish, int]:
    """The motion with a way from rest before it, a smooth one for each hand; and its samples."""
    robot, starts, longest = stepper.robot, [], APPROACH_LEAST_S
    stepper.look(robot.rest)
    for i, target in enumerate(motion.arms):
        hand, turn, elbow = stepper.place(i)
        starts.append((hand, turn, elbow))
        far = float(np.linalg.norm(target.position[0] - hand))
        angle = (Rotation.from_matrix(turn).inv() * Rotation.from_matrix(target.rotation[0])).magnitude()
        longest = max(longest, 1.9 * far / APPROACH_SPEED, 1.9 * float(angle) / APPROACH_RATE)
    n = round(longest / dt)
    x = np.minimum(np.arange(n + round(SETTLE_S / dt)) / n, 1.0)
    share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    arms = []
    for target, (hand, turn, elbow), arm in zip(motion.arms, starts, robot.arms, strict=True):
        position = hand + share[:, None] * (target.position[0] - hand)
        both = Rotation.from_matrix(np.stack([turn, target.rotation[0]]))
        bend = bend_of(elbow - arm.shoulder, hand - arm.shoulder) if arm.elbow >= 0 else np.zeros(3)
        before = ArmTarget(
            position,
            position,
            Slerp([0.0, 1.0], both)(share).as_matrix(),
            position,
            bend + share[:, None] * (target.bend[0] - bend),
            position,
            np.ones(len(share)),
            np.zeros(len(share), dtype=bool),
        )
        whole = ArmTarget(*(np.concatenate([a, b]) for a, b in zip(before, target, strict=True)))
        arms.append(replace_rates(whole, np.arange(len(whole.weight)) * dt))
    held = len(share)
    time = np.concatenate([np.full(held, motion.time[0]), motion.time])
    slow = np.concatenate([np.ones(held), motion.slow])
    return replace(motion, time=time, arms=tuple(arms), slow=slow), held


def _slower(
    path: tuple[np.ndarray, np.ndarray, np.ndarray], robot: Robot, dt: float, motion: Wish, approach: int
) -> tuple[np.ndarray, Slowest | None]:
    """(n,) from 1: how much longer each moment takes, and the joint that asks for most."""
    u = gaussian_filter1d(path[0], 0.03 / dt, axis=0, mode="nearest")
    v = np.gradient(u, dt, axis=0)
    a = np.gradient(v, dt, axis=0)
    jerk = np.gradient(a, dt, axis=0)
    by_v = np.abs(v) / (VELOCITY_SHARE * robot.v_most)
    by_a = np.sqrt(np.abs(a) / (ACCELERATION_SHARE * robot.a_most))
    by_j = np.cbrt(np.abs(jerk) / (JERK_SHARE * robot.j_most))
    by = np.stack([by_v, by_a, by_j])
    need = by.max(axis=(0, 2))
    whole = np.maximum(need, 1.0)
    slowest = None
    k = approach + int(np.argmax(need[approach:]))
    if need[k] > 1.0:
        which, j = np.unravel_index(int(np.argmax(by[:, k])), by[:, k].shape)
        over = (np.abs(v[k]) / robot.v_most, np.abs(a[k]) / robot.a_most, np.abs(jerk[k]) / robot.j_most)[which][j]
        slowest = Slowest(
            robot.names[j], float(motion.time[k]), float(over), ("velocity", "acceleration", "jerk")[which]
        )
    whole = np.minimum(np.maximum(whole, motion.slow), MOST)
    width = max(1, round(SPREAD_S / dt))
    wide = maximum_filter1d(whole, 2 * width + 1, mode="nearest")
    return np.asarray(gaussian_filter1d(wide, 0.5 * width, mode="nearest")), slowest


def _slower_about(near: np.ndarray, n: int, dt: float) -> np.ndarray:
    """(n,) from 1 to 2: how much longer than before each moment about the samples `near` takes."""
    slow = np.zeros(n, dtype=bool)
    for k in np.unique(near.astype(int)).tolist():
        slow[max(0, k - round(TIGHT_BEFORE_S / dt)) : k + round(TIGHT_AFTER_S / dt) + 1] = True
    return 1.0 + np.asarray(gaussian_filter1d(slow.astype(float), 0.5 * SPREAD_S / dt, mode="nearest"))


def _fading(time: np.ndarray) -> np.ndarray:
    """Times at which the samples pass, the last `FADE_S` of them ever more slowly: their speed falls evenly to none."""
    share = np.clip((time - (time[-1] - FADE_S)) / FADE_S, 0.0, 1.0)
    return time + FADE_S * (2.0 * (1.0 - np.sqrt(1.0 - share)) - share)


def _on(motion: Wish, index: np.ndarray, time: np.ndarray, dt: float) -> Wish:
    """The motion at samples `index`, between which it is drawn smoothly, passed at `time`."""
    whole = np.arange(len(motion.time)) * dt
    recorded = np.interp(index * dt, whole, motion.time)
    return replace(resampled(replace(motion, time=whole), index * dt, time), time=recorded)
