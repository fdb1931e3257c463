"""The interface of orientation filters: frozen parameters, a state apart from them, one compiled step for all uses."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from ..compilation import inlined
from ..errors import BadData
from .noise import SensorNoise

T = TypeVar("T")

# [rad/√s] by which a static sensor may rotate about the vertical undetected: 0.01 deg/s for 10 s at a time
STATIC_TURN_NOISE = 8e-4
START_HEADING_STD = 1e-5  # [rad] the start defines the heading; above zero, so that P can be inverted


class AboutVertical(NamedTuple):
    """A filter's corrections about the vertical since its start, and what it knows of the bias there.

    The fields are arrays over samples or over sensors.

    Parameters
    ----------
    heading : [rad] sum of the corrections of its heading
    rate : [rad/s] sum of the corrections of the gyroscope's bias, each at the attitude that the sensor had then
    rate_var : [rad²/s²] variance of the bias now
    """

    heading: np.ndarray
    rate: np.ndarray
    rate_var: np.ndarray


VERTICAL_COLUMNS = len(AboutVertical._fields)
HEADING, RATE, RATE_VAR = range(VERTICAL_COLUMNS)


@inlined
def add_correction(sums, heading, rate, rate_var):  # type: ignore[no-untyped-def]
    """Add a correction by `heading` [rad] and `rate` [rad/s] to `sums` (3,), a row of `AboutVertical`.

    `rate_var` [rad²/s²] is the variance of the bias now.
    """
    sums[HEADING] += heading
    sums[RATE] += rate
    sums[RATE_VAR] = rate_var


class FilterRun(NamedTuple):
    """Results of a run, one row a sample; V is the sensor's own world, as in `OrientationFilter`."""

    quat_VS: np.ndarray  # (n, 4) xyzw, orientation after the sample
    gyro_bias: np.ndarray  # (n, 3) [rad/s]
    attitude_cov: np.ndarray | None  # (n, 3, 3) [rad²] of the error on the right, in S; None: the filter has none
    about_vertical: np.ndarray | None = None  # (n, 3) as `AboutVertical`; None: the filter has no covariance

    def part(self, rows: slice | np.ndarray) -> FilterRun:
        """Return the samples `rows`, of a slice as views."""
        return FilterRun(*(None if values is None else values[rows] for values in self))  # type: ignore[arg-type]

    def extended(self, n: int) -> FilterRun:
        """Return arrays of n samples that begin with these; the others are to be filled."""
        whole = make_run(n, covariance=self.attitude_cov is not None)
        for values, own in zip(whole, self, strict=True):
            if values is not None and own is not None:
                values[: len(own)] = own
        return whole


def make_run(n: int, *, covariance: bool = True) -> FilterRun:
    """Return arrays for n samples, to be filled."""
    # One piece of memory for all takes half the time of four.
    shapes = [(n, 4), (n, 3), *([(n, 3, 3), (n, VERTICAL_COLUMNS)] if covariance else [])]
    ends = np.cumsum([0, *map(math.prod, shapes)])
    memory = np.empty(ends[-1])
    arrays = [memory[ends[k] : ends[k + 1]].reshape(shape) for k, shape in enumerate(shapes)]
    return FilterRun(*arrays, *([] if covariance else [None]))


def make_record(**values: Any) -> np.ndarray:
    """Return a record (1,) with these fields, numbers or arrays, for a compiled step; all are floats.

    A step is compiled for the types of the record, and a parameter may be stated as an integer.
    """
    types = [(name, float, np.shape(value)) for name, value in values.items()]
    record = np.zeros(1, np.dtype(types, align=True))
    for name, value in values.items():
        record[name] = value
    return record


@dataclass
class FilterState:
    """State of a filter without covariance."""

    quat_VS: np.ndarray  # (4,) xyzw
    gyro_bias: np.ndarray  # (3,) [rad/s]


class OrientationFilter(Protocol):
    """A filter made for one sensor: ``Filter(noise, rate_hz, quat_VS, params)``.

    V is the sensor's own world: z up, heading of the `quat_VS` from which the filter starts. A run, the same run cut
    in two, and a run sample by sample are bit-identical.
    """

    def __init__(self, noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray) -> None: ...

    def run(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray, out: FilterRun | None = None
    ) -> FilterRun:
        """Take samples, `gyro_S` (n, 3) [rad/s], `accel_S` (n, 3) [m/s²], `static` (n,) bool, or one without the n.

        The state continues from the run before.

        The result fills `out` and is `out`, where it is given.
        """
        ...


def prepare_samples(
    gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return one sample or many as the contiguous arrays that the compiled steps take: (n, 3), (n, 3), (n,)."""
    gyro = np.ascontiguousarray(gyro_S, dtype=float).reshape(-1, 3)
    accel = np.ascontiguousarray(accel_S, dtype=float).reshape(-1, 3)
    is_static = np.ascontiguousarray(static, dtype=np.bool_).reshape(-1)
    if not len(gyro) == len(accel) == len(is_static):  # the compiled steps would read beyond an array's end
        raise BadData(
            f"{len(gyro)} rows of gyro_S, {len(accel)} of accel_S, {len(is_static)} of static: they must be as many"
        )
    return gyro, accel, is_static


# Symmetric 3×3 matrices and their upper triangles: xx xy xz yy yz zz -------------------------------------------------


def symmetric(upper: np.ndarray) -> np.ndarray:
    """Matrices (…, 3, 3) from their upper triangles (…, 6)."""
    return upper[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


@inlined
def into_sensor(R, P, more, out):  # type: ignore[no-untyped-def]
    """Upper triangle `out` (6,) of ``Rᵀ P R + more I`` of symmetric 3×3 `P`; `R` (3, 3)."""
    xx, xy, xz, yy, yz, zz = P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    at = 0
    for i in range(3):
        a, b, c = R[0, i], R[1, i], R[2, i]
        u, v, w = xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c
        for j in range(i, 3):
            out[at] = R[0, j] * u + R[1, j] * v + R[2, j] * w
            at += 1
    out[0] += more
    out[3] += more
    out[5] += more


@inlined
def fill_symmetric(upper, out):  # type: ignore[no-untyped-def]
    """`out` (3, 3) of its upper triangle (6,)."""
    out[0, 0], out[0, 1], out[0, 2] = upper[0], upper[1], upper[2]
    out[1, 0], out[1, 1], out[1, 2] = upper[1], upper[3], upper[4]
    out[2, 0], out[2, 1], out[2, 2] = upper[2], upper[4], upper[5]


@inlined
def store_sample(state, k, quat_VS, gyro_bias, attitude_cov, about_vertical):  # type: ignore[no-untyped-def]
    """Fill row `k` of the arrays of a `FilterRun` from the record of a filter with covariance."""
    for i in range(4):
        quat_VS[k, i] = state.quat_VS[i]
    for i in range(3):
        gyro_bias[k, i] = state.gyro_bias[i]
    fill_symmetric(state.attitude_cov, attitude_cov[k])
    for i in range(VERTICAL_COLUMNS):
        about_vertical[k, i] = state.about_vertical[i]


def run_in_parallel(function: Callable[..., T], *columns: Iterable[Any], threads: int | None = None) -> list[T]:
    """Return ``[function(*row) for row in zip(*columns)]``, computed in threads: one for each sensor's compiled run.

    The runs release the interpreter's lock, so that `threads` of them run at once, by default as many as there are
    processors. The order is that of the columns; the first error of a run is raised here.
    """
    rows = list(zip(*columns, strict=True))
    workers = min(threads or count_processors(), len(rows))
    if workers <= 1:
        return [function(*row) for row in rows]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda row: function(*row), rows))


def count_processors() -> int:
    """Return the number of processors that this process may use, or WEPOSE_THREADS where that is set."""
    if (stated := os.environ.get("WEPOSE_THREADS", "")).isdecimal():
        return max(1, int(stated))
    if hasattr(os, "sched_getaffinity"):  # Linux: a container or taskset may have fewer than the machine
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
