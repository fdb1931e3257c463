"""Joint limits: the accelerations that never lead to a violation of them, and the stop within them.

Over a step the jerk is constant: the acceleration is linear, the velocity quadratic, the position cubic. Three bounds
on the acceleration at the end of a step follow; the tightest counts:

1. The acceleration and its change within the step keep the limits of acceleration and jerk.
2. If the joint then brakes as hard as both limits allow, it stops before its position limit and never exceeds its
   velocity limit (`_predict_braking`). A state that keeps this bound has a successor that keeps it: braking.
3. Within what 2 allows, the joint lands softly: it reaches its limit without acceleration (`_lands_softly`). A joint
   that brakes at full strength up to its limit bounces off, because the jerk limit delays the release of the brake.

The bounds of both sides agree where a brake can be released within the joint's velocities and range
(`reduce_acceleration_limits`).
"""

import numpy as np

from ..compilation import compiled, inlined, kernel

LAND_A, LAND_J = 0.7, 0.5  # share of acceleration and jerk used to land; the rest is a reserve for coming in too fast
MAX_APPROACH_GAIN = 8.0  # [1/s] of the last approach of two shapes, whatever the joints' braking allows
MAX_BRAKE_SHARE = 0.9  # of the range of joint velocities in a step, used at most to keep two shapes apart
_BISECTIONS = 30
_ROUNDING = 1e-9  # [rad or m, s] tolerance on a bound
STOP_S = 0.06  # [s] time constant with which a low velocity decays; at a higher one joints brake at their limits
STOP_RISES = 1.5  # least time constant, in times that a joint needs to reach its full acceleration
STOP_SHARE = 0.02  # of the velocity that one step can brake: below it the velocity goes to zero at once
STATIC_SPEED = 1e-9  # [rad/s or m/s] below it a joint is at rest
MAX_STOP_S = 5.0  # [s]; a stop that takes longer counts as none


@inlined
def _predict_braking(v, a, first, a_max, j_step, dt):  # type: ignore[no-untyped-def]
    """Largest displacement and velocity if the next acceleration is `first` and the joint then brakes hardest.

    Between the samples too.
    """
    far, fast, way, after = 0.0, v, 0.0, first
    while True:
        slope, end = (after - a) / dt, v + 0.5 * dt * (a + after)
        fast = max(fast, end)
        peaks = a > 0.0 > after  # the velocity has its maximum within the step
        top = v - 0.5 * a * a / slope if peaks else v
        fast = max(fast, top)
        if end <= 0.0 < top:  # stops within the step: the later root of v + a t + ½ slope t²
            root = np.sqrt(max(a * a - 2.0 * slope * v, 0.0))
            t = -(a + root) / slope if a > 0.0 else 2.0 * v / (root - a)
            far = max(far, way + t * (v + t * (0.5 * a + t * slope / 6.0)))
        way += dt * (v + dt * (a / 3.0 + after / 6.0))
        far = max(far, way)
        v, a = end, after
        if v <= 0.0 and a <= 0.0:
            return far, fast
        after = max(a - j_step, -a_max)


@inlined
def _lands_softly(room, v, a, a_max, j_max, gain):  # type: ignore[no-untyped-def]
    """Whether the velocity is at or below the landing velocity, early enough to release the acceleration.

    The landing velocity is that of constant braking, and close to the limit `gain` [1/s] times the room, where
    position, velocity and acceleration decay together. With s the margin below it and e the acceleration above that
    of the brake, s' = -e; e can be removed at `j_max` in time if s ≥ e² / (2 j).
    """
    knee = a_max / gain**2  # the room above which braking is constant
    slow = gain * room if room < knee else np.sqrt(2.0 * a_max * (room - 0.5 * knee))
    excess = max(a + min(gain * max(v, 0.0), a_max), 0.0)
    return v + 0.5 * excess * excess / j_max <= slow + _ROUNDING


@inlined
def _bound_acceleration(v, a, room, v_max, a_max, j_max, dt):  # type: ignore[no-untyped-def]
    """Largest next acceleration by bounds 1 and 2, and by all three."""
    j_step = j_max * dt
    bottom, top = max(a - j_step, -a_max), min(a + j_step, a_max)
    if bottom > top:  # outside its limits: back
        bottom = top = max(min(a, a_max + j_step) - j_step, -a_max - j_step)
    hard = _bisect(False, bottom, top, v, a, room, v_max, a_max, j_max, dt)
    return hard, _bisect(True, bottom, hard, v, a, room, v_max, a_max, j_max, dt)


@inlined
def _bisect(soft, low, high, v, a, room, v_max, a_max, j_max, dt):  # type: ignore[no-untyped-def]
    """Largest acceleration in [`low`, `high`] that keeps bound 3 (`soft`) or 2; `low` where none does."""
    if _keeps_bound(soft, high, v, a, room, v_max, a_max, j_max, dt):
        return high
    if not _keeps_bound(soft, low, v, a, room, v_max, a_max, j_max, dt):
        return low
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if _keeps_bound(soft, middle, v, a, room, v_max, a_max, j_max, dt):
            low = middle
        else:
            high = middle
    return low


@inlined
def _keeps_bound(soft, after, v, a, room, v_max, a_max, j_max, dt):  # type: ignore[no-untyped-def]
    if not soft:
        far, fast = _predict_braking(v, a, after, a_max, j_max * dt, dt)
        return far <= room + _ROUNDING and fast <= v_max + _ROUNDING
    # Half a step later with that acceleration: the first moment at which the joint can react fully.
    v_ahead = v + dt * (0.5 * a + after)
    room_ahead = room - dt * (1.5 * v + dt * (7.0 * a + 6.5 * after) / 12.0)
    if v_ahead + 0.5 * max(after, 0.0) ** 2 / (LAND_J * j_max) > v_max:
        return False
    gain = min(0.5 * j_max / a_max, 0.3 / dt)  # the landing itself needs up to LAND_A gain a_max of jerk
    return _lands_softly(room_ahead, v_ahead, after, LAND_A * a_max, LAND_J * j_max, gain)


@kernel
def compute_acceleration_bounds(u, v, a, lower, upper, v_max, a_max, j_max, dt, low, high):  # type: ignore[no-untyped-def]
    """Fill `low` and `high` (n,) with the bounds on the accelerations at the next sample."""
    for j in range(len(u)):
        up, soft_up = _bound_acceleration(v[j], a[j], upper[j] - u[j], v_max[j], a_max[j], j_max[j], dt)
        down, soft_down = _bound_acceleration(-v[j], -a[j], u[j] - lower[j], v_max[j], a_max[j], j_max[j], dt)
        high[j] = min(up, max(soft_up, -down))
        low[j] = max(-down, min(-soft_down, up))
        if low[j] > high[j]:  # a range too short for its own limits, or rounding
            low[j] = high[j] = 0.5 * (low[j] + high[j])


@compiled
def compute_separation_bounds(jacobian, distance, clearance, v, a, low, high, a_max, j_max, dt):  # type: ignore[no-untyped-def]
    """(m,) lowest rate [m/s] of distances half a step ahead, from which approaching shapes still stop in time.

    Bound 3 for several joints at once. It uses half of what all joints together can brake; the other half is a reserve
    for their own limits. The change of the acceleration within the coming step is subtracted. What joints cannot brake
    is not asked for; at rest it is enough not to approach. `jacobian` (m, n) is of the distances (m,) [m], `low` and
    `high` (n,) are the bounds of `compute_acceleration_bounds`.
    """
    bounds = np.empty(len(distance))
    static = not (v.any() or a.any())
    for k in range(len(distance)):
        brake, jerk, closing, closing_a, ahead, most = 1e-9, 1e-9, 0.0, 0.0, 0.0, 0.0
        for j in range(len(v)):
            g, v_mid = jacobian[k, j], v[j] + 0.5 * dt * a[j]
            brake += 0.5 * abs(g) * a_max[j]
            jerk += 0.5 * abs(g) * j_max[j]
            closing -= g * v_mid
            closing_a -= g * a[j]
            ahead += g * (1.5 * v[j] + 0.5 * dt * a[j])
            most += g * (v_mid + dt * (high[j] if g > 0.0 else low[j]))
            most -= (1.0 - MAX_BRAKE_SHARE) * abs(g) * dt * (high[j] - low[j])
        room = distance[k] - clearance[k] + dt * ahead
        gain = min(0.5 * jerk / brake, 0.3 / dt, MAX_APPROACH_GAIN)
        knee = LAND_A * brake / gain**2
        slow = gain * room if room < knee else np.sqrt(2.0 * LAND_A * brake * (room - 0.5 * knee))
        excess = max(closing_a - jerk * dt + min(gain * max(closing, 0.0), LAND_A * brake), 0.0)
        bounds[k] = min(0.5 * excess**2 / (LAND_J * jerk) - slow, most)
        if static:
            bounds[k] = min(bounds[k], 0.0)
    return bounds


@compiled
def compute_stop(u, v, a, lower, upper, v_max, a_max, j_max, dt):  # type: ignore[no-untyped-def]
    """Return states (m, 3, n) from the present one to rest, and each joint's largest travel (m, n) in the step after.

    A state is position, velocity and acceleration, here `u`, `v`, `a` (n,) [rad or m, s]. Each joint brakes as hard as
    it can, within its limits if the present state keeps them in the sense of `compute_acceleration_bounds`. The last
    state is not at rest where that takes longer than `MAX_STOP_S`.
    """
    n = len(u)
    steps = int(MAX_STOP_S / dt)
    states, travel, length = np.zeros((steps, 3, n)), np.zeros((steps, n)), 1
    for j in range(n):
        place, speed, accel, k = u[j], v[j], a[j], 0
        states[0, 0, j], states[0, 1, j], states[0, 2, j] = place, speed, accel
        j_step = j_max[j] * dt
        fade = max(STOP_S, STOP_RISES * a_max[j] / j_max[j])
        peak = abs(speed) + abs(accel) * (dt + 0.5 * abs(accel) / j_max[j])
        far = peak * (2.0 * a_max[j] / j_max[j] + 2.0 * dt + fade) + 0.5 * peak * peak / a_max[j]
        free = upper[j] - place > far and place - lower[j] > far  # no limit is near
        while k + 1 < steps and (abs(speed) > STATIC_SPEED or abs(accel) > STATIC_SPEED / dt):
            after = -speed / fade
            if abs(speed) < STOP_SHARE * a_max[j] * dt:  # in two steps to zero
                after = -speed / dt - 0.5 * accel
            after = min(max(min(max(after, -a_max[j]), a_max[j]), accel - j_step), accel + j_step)
            if not free:
                up, down = upper[j] - place, place - lower[j]
                fits = _keeps_bound(False, after, speed, accel, up, v_max[j], a_max[j], j_max[j], dt)
                fits &= _keeps_bound(False, -after, -speed, -accel, down, v_max[j], a_max[j], j_max[j], dt)
                if not fits:
                    high, _ = _bound_acceleration(speed, accel, up, v_max[j], a_max[j], j_max[j], dt)
                    low, _ = _bound_acceleration(-speed, -accel, down, v_max[j], a_max[j], j_max[j], dt)
                    after = min(max(after, -low), high)
            faster = max(abs(speed), abs(speed + 0.5 * dt * (accel + after)))
            travel[k, j] = dt * (faster + 0.125 * dt * abs(after - accel))
            place += dt * (speed + dt * (accel / 3.0 + after / 6.0))
            speed += 0.5 * dt * (accel + after)
            accel = after
            k += 1
            states[k, 0, j], states[k, 1, j], states[k, 2, j] = place, speed, accel
        length = max(length, k + 1)
        states[k:, 0, j] = place
        if k + 1 < steps:  # below `STATIC_SPEED`
            states[k, 1, j] = states[k, 2, j] = 0.0
    return states[:length], travel[:length]


def reduce_acceleration_limits(
    a_max: np.ndarray, v_max: np.ndarray, j_max: np.ndarray, span: np.ndarray, dt: float
) -> np.ndarray:
    """Acceleration limits from which a joint returns to zero within half of its velocities and range `span`.

    While full braking is released the velocity changes by a² / (2 j), and on the way to rest the position by
    2 a³ / (3 j²); at least by one step's, even where the jerk limit allows more.
    """
    by_jerk = np.minimum(np.sqrt(j_max * v_max), np.cbrt(0.75 * j_max**2 * span))
    return np.minimum(a_max, np.minimum(by_jerk, np.minimum(0.25 * v_max / dt, 0.1 * span / dt**2)))
