"""The intervals from which filters and headings start, and checks that the person is static in them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadPhase, WeposeError
from ..recording import ImuSensor, OrientationSensor, Recording, compute_rate, find_runs, format_span, format_time
from .base import Orientation
from .noise import SensorNoise, estimate_noise

# Motion in the start pose: root mean square of the rate, and largest rotation from the mean. A standing person sways
# below 3 deg/s and 3 deg. Above `MOVES` the mean pose is not the start pose; above `SWAYS` it is a warning.
MOVES_DEG_S, MOVES_DEG = 20.0, 15.0
SWAYS_DEG_S, SWAYS_DEG = 6.0, 5.0
# Where a sensor turns faster than `SWAYS_DEG_S` over `BLOCK_S`, it moves; a tremor averages out over so long.
BLOCK_S = 0.2
LEAST_STATIC_S = 1.0  # of an interval with motion in it, that must be static

# Without stated phases the most static window of this length in the beginning is used.
WINDOW_S = 2.0
BEGINNING_S = 20.0

# Samples of a static phase, and the share of them that each sensor must have measured.
FEWEST_AT_START, LEAST_SHARE_AT_START = 10, 0.5


def find_reference_phases(
    recording: Recording, sways: bool
) -> tuple[tuple[float, float], tuple[float, float], dict[str, SensorNoise], list[Diagnostic]]:
    """Find the start pose [s], the phase of noise and bias [s], segment → noise of its sensor, and their diagnostics.

    The noise is that of sensors with a filter; the recording's diagnostics come first. `sways`: a person stands in the
    start pose; a mechanism stands still. `WeposeError`: a phase with too few samples, with motion, or without gravity.
    """
    stated, lying = recording.phases.get("start", ()), recording.phases.get("static", ())
    where = recording.where()
    if lying and not stated:
        raise BadPhase(f"{where}: phases.static without phases.start; name its seconds, start = [[from, to]]")
    diagnostics = list(recording.diagnostics)
    for phase, intervals in (("start", stated), ("static", lying)):
        if len(intervals) > 1:
            facts = {"start": intervals[0][0], "end": intervals[0][1]}
            diagnostics.append(Diagnostic("phase-intervals-ignored", WARNING, phase, facts=facts))
    start, place = stated[0] if stated else find_static_window(recording), "phases.start"
    _check_samples(recording, start, "start")
    if not stated or recording.start_is_guessed:
        diagnostics.append(Diagnostic("start-pose-guessed", WARNING, facts={"start": start[0], "end": start[1]}))
        place = "the guessed start pose"
    else:
        start = _find_static_part(recording, start, "start", diagnostics)
    static = start
    if lying:
        _check_samples(recording, lying[0], "static")
        static = _find_static_part(recording, lying[0], "static", diagnostics)
    noises: dict[str, SensorNoise] = {}
    for segment, sensor in recording.sensors.items():
        if not sensor.aligned:
            diagnostics += _check_motion(recording, segment, start, place)
            diagnostics += _check_motion(recording, segment, static, "phases.static") if lying else []
        if isinstance(sensor, ImuSensor):
            part, worn = sensor.part(recording.find_measured(segment, static)), static == start and sways
            try:
                noises[segment] = estimate_noise(part.gyro_S, part.accel_S, recording.rate_hz, worn)
            except WeposeError as error:
                raise type(error)(f"{where}: sensors.{segment}: {error}") from error
    return start, static, noises, diagnostics


def _check_samples(recording: Recording, interval: tuple[float, float], phase: str) -> None:
    """Check that each sensor has measured in an interval [s]."""
    place = f"{recording.where()}: phases.{phase}: [{format_time(interval[0])}, {format_time(interval[1])}]"
    samples = len(recording.time[recording.span(interval)])
    if samples < FEWEST_AT_START:
        raise BadPhase(f"{place} holds {samples} samples; it needs at least {FEWEST_AT_START}, better two seconds")
    for segment in recording.sensors:
        measured = len(recording.find_measured(segment, interval))
        if measured < max(FEWEST_AT_START, LEAST_SHARE_AT_START * samples):
            raise BadPhase(
                f"{place}: sensors.{segment} is lost in {samples - measured} of its {samples} samples: its tilt "
                f"is not known; name seconds in which it measures, or take [sensors.{segment}] out"
            )


def _find_static_part(
    recording: Recording, interval: tuple[float, float], phase: str, diagnostics: list[Diagnostic]
) -> tuple[float, float]:
    """Find the longest part [s] of a stated interval in which no sensor moves, and add the diagnostic that says so.

    `BadPhase`: the interval has motion in it, and no part of `LEAST_STATIC_S` without.
    """
    span = recording.span(interval)
    size = span.stop - span.start
    blocks = np.arange(0, size, max(1, round(BLOCK_S * recording.rate_hz)))
    fastest, rate_deg_s, moves = "", 0.0, np.zeros(len(blocks), dtype=bool)
    for segment, sensor in recording.sensors.items():
        if sensor.aligned:
            continue
        part = sensor.part(span)
        measured = np.ones(size) if part.gap is None else 1.0 - part.gap
        counts = np.add.reduceat(measured, blocks)
        rate = compute_rate(part, recording.rate_hz) * measured[:, None]
        means = np.add.reduceat(rate, blocks) / np.maximum(1.0, counts)[:, None]
        off = np.degrees(np.linalg.norm(means - np.median(means[counts > 0.0], axis=0), axis=1)) * (counts > 0.0)
        moves |= off > SWAYS_DEG_S
        if off.max() > rate_deg_s:
            fastest, rate_deg_s = segment, float(off.max())
    if not moves.any():
        return interval
    moves = np.convolve(moves, [1, 1, 1], mode="same") > 0  # motion begins and ends gently: a block more on both sides
    begin, end = max(find_runs(~moves), key=lambda run: run[1] - run[0], default=(0, 0))
    rows = span.start + np.append(blocks, size)
    static = (float(recording.time[rows[begin]]), float(recording.time[rows[end] - 1]))
    if begin == end or static[1] - static[0] < LEAST_STATIC_S:
        raise BadPhase(
            f"{recording.where()}: phases.{phase}: sensors.{fastest} turns at up to {rate_deg_s:.0f} deg/s in "
            f"{format_span(interval)}, and less than {LEAST_STATIC_S:g} s of it is static; name seconds in which "
            f"nothing moves, better four"
        )
    facts: dict[str, float | str] = {"phase": f"phases.{phase}", "start": static[0], "end": static[1]}
    facts |= {"stated_start": interval[0], "stated_end": interval[1]}
    facts["example"] = f"{phase} = [[{format_time(static[0])}, {format_time(static[1])}]]"
    value, limit = np.deg2rad([rate_deg_s, SWAYS_DEG_S]).tolist()
    diagnostics.append(Diagnostic("static-phase-trimmed", WARNING, fastest, value, limit, facts))
    return static


def _check_motion(recording: Recording, segment: str, interval: tuple[float, float], place: str) -> list[Diagnostic]:
    """Check that a sensor is static in an interval [s]; sway gives a warning.

    The rotation excludes the mean rate, in which the gyroscope's bias and a steady rotation cannot be separated.
    """
    sensor = recording.sensors[segment].part(recording.find_measured(segment, interval))
    rate = np.degrees(compute_rate(sensor, recording.rate_hz))
    rms = float(np.sqrt(np.mean(np.sum(rate**2, axis=1))))
    bias = 0.0 if isinstance(sensor, OrientationSensor) else rate.mean(axis=0)
    angle = np.cumsum(rate - bias, axis=0) / recording.rate_hz
    turn = float(np.linalg.norm(angle - angle.mean(axis=0), axis=1).max())
    if rms > MOVES_DEG_S or turn > MOVES_DEG:
        raise BadPhase(
            f"{recording.where()}: sensors.{segment} turns by {turn:.0f} deg and at {rms:.0f} deg/s rms in {place} "
            f"({format_span(interval)}); name seconds in which it is static, up to {MOVES_DEG_S:g} deg/s and "
            f"{MOVES_DEG:g} deg"
        )
    if rms <= SWAYS_DEG_S and turn <= SWAYS_DEG:
        return []
    value, limit, rotation, rotation_limit = np.deg2rad([rms, SWAYS_DEG_S, turn, SWAYS_DEG]).tolist()
    facts: dict[str, float | str] = {"phase": place, "start": interval[0], "end": interval[1]}
    facts |= {"rotation": rotation, "rotation_limit": rotation_limit}
    return [Diagnostic("start-pose-motion", WARNING, segment, value, limit, facts)]


def find_static_window(recording: Recording) -> tuple[float, float]:
    """Find the interval [s] of `WINDOW_S` in the first `BEGINNING_S` in which all sensors measure and move least.

    A steady rotation about the vertical has no variance: the mean rate that all sensors share counts as motion.
    `BadPhase`: every window has a lost sensor.
    """
    time, rate_hz = recording.time, recording.rate_hz
    n = int(np.searchsorted(time, time[0] + BEGINNING_S, side="right"))
    window = min(max(round(WINDOW_S * rate_hz), 10), n)
    stride = max(1, window // 40)  # the windows need not begin at every sample

    def slide(values: np.ndarray) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(values[:n], window, axis=0)[::stride]

    motion, vertical_rates = np.zeros(len(range(0, n - window + 1, stride))), []
    for sensor in recording.sensors.values():
        rates = slide(compute_rate(sensor.part(slice(n)), rate_hz))
        motion += rates.var(axis=-1).sum(axis=-1)
        if isinstance(sensor, ImuSensor):
            up = slide(sensor.accel_S).mean(axis=-1)
            force = np.maximum(np.linalg.norm(up, axis=1), 1e-9)  # of a dead accelerometer zero
            vertical_rates.append(np.einsum("ni,ni->n", rates.mean(axis=-1), up) / force)
        if sensor.gap is not None:  # a bridge has no motion
            motion[slide(sensor.gap).any(axis=-1)] = np.inf
    if vertical_rates:
        motion += len(vertical_rates) * np.mean(vertical_rates, axis=0) ** 2
    if not np.isfinite(motion).any():
        lost = [name for name, sensor in recording.sensors.items() if sensor.gap is not None and sensor.gap[:n].any()]
        raise BadPhase(
            f"{recording.where()}: no {WINDOW_S:g} s in the first {BEGINNING_S:g} s in which all sensors measure: "
            f"{', '.join(f'sensors.{name}' for name in lost)} are lost there; take them out, or name the start pose, "
            f"[phases] start = [[from, to]]"
        )
    first = int(np.argmin(motion)) * stride
    return float(time[first]), float(time[first + window - 1])


def collect_orientations(recording: Recording, filtered: Mapping[str, Orientation]) -> dict[str, Rotation]:
    """Return segment → n orientations R_VS of its sensor, `filtered` or measured; without mounts."""
    return {
        segment: Rotation.from_quat((sensor if isinstance(sensor, OrientationSensor) else filtered[segment]).quat_VS)
        for segment, sensor in recording.sensors.items()
    }


def average_start(
    recording: Recording, R_VS: Mapping[str, Rotation], start: tuple[float, float]
) -> dict[str, Rotation]:
    """Return segment → mean orientation of its sensor in the start pose [s]."""
    return {name: each[recording.find_measured(name, start)].mean() for name, each in R_VS.items()}
