"""The filters of the comparison with their settings: ours, NCF and GDC, and other packages.

All start from the same static phase: its bias is removed (but for "default gains"), and where a start can be given it
is the tilt measured at the beginning. The heading is aligned by the experiments, for all alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from wepose_pin import rotations
from wepose_pin.filters import METHODS, GdcParams, NcfParams
from wepose_pin.filters.phases import SensorNoise
from wepose_pin.filters.static import StaticTest

from ..trials import run_filter
from .gains import make_gains

OURS = "smekf"  # the paper's filter
DEFAULT = "amekf"  # the default of the commands
PUBLISHED = "smekf_published"

Orient = Callable[[np.ndarray, np.ndarray, float, SensorNoise], np.ndarray]

# Out of the box. NCF: k_P 0.5, k_I 0 of its most used code (x-io MahonyAHRS.h, twoKpDef and twoKiDef; Arduino's
# MahonyAHRS). Mahony 2008 simulates with k_P 1, k_I 0.3, which is worse by far: 69 against 16 deg on half of BROAD,
# since an integral this fast takes the hand's acceleration for bias. GDC: β 0.033, Madgwick's own for an IMU (2010
# report, 2011 paper); the 0.1 of x-io's MadgwickAHRS.h is no better.
DEFAULT_GAINS: dict[str, Any] = {"ncf": NcfParams(0.5, 0.0), "gdc": GdcParams(0.033)}


class Contender(NamedTuple):
    """A filter with its settings.

    `orient` takes gyro_S (n, 3) [rad/s], accel_S (n, 3) [m/s²], rate_hz and the static phase's noise and gives quat_VS
    (n, 4) xyzw, in a world of its own with z up. `method`: the key of `METHODS` where it is ours with its defaults.
    """

    label: str
    orient: Orient
    method: str | None = None


def list_contenders(setting: str, trial: str = "") -> list[Contender]:
    """List the contenders: ours, smekf as published, NCF and GDC, tuned and with default gains, the installed peers.

    `setting`: "real" or a key of `gains.STATED`; `trial`: the name of a real one (see `make_gains`).
    """
    tuned = make_gains(setting, trial)._asdict()
    filters = [_make_ours(method) for method in METHODS if method not in (*tuned, PUBLISHED)]
    # Of people it enters as measured orientations: joint accelerations are not the paper's.
    filters.append(_make_ours(PUBLISHED)._replace(method=None))
    filters += [_make_ours(method, params) for method, params in tuned.items()]
    filters += [_make_default(method, params) for method, params in DEFAULT_GAINS.items()]
    return filters + [Contender(label, orient) for label, (module, orient) in _PEERS.items() if find_spec(module)]


def _make_ours(method: str, params: Any = None) -> Contender:
    """Make the contender of a filter of ours, with its defaults or with `params`."""

    def orient(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise) -> np.ndarray:
        return run_filter(gyro_S, accel_S, rate_hz, noise, method, params).quat_VS

    return Contender(method, orient, method if params is None else None)


def _make_default(method: str, params: Any) -> Contender:
    """Published gains without a static phase: the bias starts at zero."""

    def orient(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise) -> np.ndarray:
        unknown = replace(noise, gyro_bias=np.zeros(3))
        return run_filter(gyro_S, accel_S, rate_hz, unknown, method, params).quat_VS

    return Contender(f"{method}, default gains", orient)


# Peers with the parameters that their authors recommend. VQF (Laidig and Seel 2023; BROAD is theirs too) is meant to be
# run with its defaults and estimates the bias itself. The static phase's is removed beforehand all the same, as for the
# others: that never costs it more than 0.002 deg, and in a minute at 100 Hz it helps.
def _vqf(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise) -> np.ndarray:
    gyro, accel = np.ascontiguousarray(gyro_S - noise.gyro_bias), np.ascontiguousarray(accel_S, dtype=float)
    return rotations.xyzw_from_wxyz(import_module("vqf").VQF(1.0 / rate_hz).updateBatch(gyro, accel)["quat6D"])


def _run_offline_vqf(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise) -> np.ndarray:
    """Run VQF forward and backward over the whole recording, as a smoother."""
    gyro, accel = np.ascontiguousarray(gyro_S - noise.gyro_bias), np.ascontiguousarray(accel_S, dtype=float)
    return rotations.xyzw_from_wxyz(import_module("vqf").offlineVQF(gyro, accel, None, 1.0 / rate_hz)["quat6D"])


# x-io's Fusion (chapter 7 of Madgwick's thesis) as its README and examples have it: gain 0.5, accelerations beyond
# 10 deg rejected for up to 5 s, its `Bias` in front, here from the static phase's bias on. All others were measured to
# be worse (its bare defaults, which reject nothing; `Bias` from zero) or the same to 0.1 deg (the bias removed once).
def _imufusion(gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise) -> np.ndarray:
    fusion = import_module("imufusion")
    bias = fusion.Bias().set_settings(fusion.BiasSettings(sample_rate=rate_hz))
    bias.set_offset(np.degrees(noise.gyro_bias))
    ahrs = fusion.Ahrs().set_settings(
        fusion.AhrsSettings(
            sample_rate=rate_hz, gain=0.5, gyroscope_range=2000.0, acceleration_rejection=10.0, rejection_timeout=5.0
        )
    )
    # The same start as the others; its own would fix the heading for three seconds.
    quat_start = rotations.quat_from_gravity(accel_S[: StaticTest().samples(rate_hz)].mean(axis=0))
    ahrs.set_quaternion(np.roll(quat_start, 1)).skip_startup()
    gyro, accel = np.degrees(gyro_S), accel_S / noise.gravity  # [deg/s], [g]
    quat_wxyz = np.empty((len(gyro), 4))
    for k in range(len(gyro)):
        quat_wxyz[k] = ahrs.update_no_magnetometer(bias.update(gyro[k]), accel[k]).get_quaternion()
    # The package computes in single precision: the norm has an error of 1e-7.
    return rotations.xyzw_from_wxyz(quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True))


_PEERS: dict[str, tuple[str, Orient]] = {  # label → the package it needs, and how it is run
    "vqf": ("vqf", _vqf),
    "offline vqf": ("vqf", _run_offline_vqf),
    "imufusion": ("imufusion", _imufusion),
}
