"""The least squares of a calibration beside SciPy's: the same residuals, weights, prior and start. For `bench` only."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from ..filters.sensors import filter_recording
from ..recording import Recording
from ..subject import Subject
from . import problem
from .known import known_before
from .lengths import _looks
from .problem import Looks, filled, residuals, solve
from .protocols import load_protocol
from .touching import touching_start
from .weighing import weighed

OURS = "Gauss-Newton, ours"
_STATUS = Path("/proc/self/status")


class Problem(NamedTuple):
    """Σ w r² + (x − c)ᵀ Λ (x − c), to be made least from a start."""

    looks: Looks
    center: np.ndarray  # c (m,)
    prior: np.ndarray  # Λ (m, m)
    weights: np.ndarray  # (n, 5)
    start: np.ndarray  # (m,)


def posed(
    recording: Recording, prior: Subject, gauge: Mapping[str, float], gauge_std: float, rates_hz: tuple[float, ...]
) -> tuple[list[Problem], list[Callable[[], Problem]]]:
    """The last problem of a hands-together calibration at each rate of looks, and calibrations whole, filters apart."""
    found, protocol = filter_recording(recording), load_protocol("clasp")
    problems: list[Problem] = []
    whole: list[Callable[[], Problem]] = []
    for rate_hz in rates_hz:
        looks, _ = _looks(recording, found, protocol, rate_hz)

        def calibrated(looks: Looks = looks) -> Problem:
            def place(some: Looks) -> np.ndarray:
                return known_before(recording, found, some, prior, gauge, gauge_std)[0]

            center, information = known_before(recording, found, looks, prior, gauge, gauge_std)
            start, touching = touching_start(looks, place)
            _, weights, _, _ = weighed(looks, center, information, start, touching, quick=False)
            weights = np.broadcast_to(weights, (looks.data.shape[1], 5)).copy()
            return Problem(looks, center, information, weights, start)

        problems.append(calibrated())
        whole.append(calibrated)
    return problems, whole


def building(of: Problem) -> float:
    """Seconds that CasADi's functions take to build, once for so many looks."""
    problem._look.cache_clear()
    problem._mapped.cache_clear()
    begin = time.perf_counter()
    problem._mapped(of.looks.layout, of.looks.conditions[0], 0, of.looks.data.shape[1])
    return time.perf_counter() - begin


def solvers(of: Problem) -> dict[str, Callable[[], float]]:
    """Name → a function that solves it and gives the cost."""
    looks, center, prior, weights, start = of
    root_w, root_prior = np.sqrt(weights), np.linalg.cholesky(prior).T
    n, m = len(weights), len(center)
    look = problem._look(looks.layout, looks.conditions[0], 0)
    one = [ca.SX.sym("x", m), ca.SX.sym("data", looks.data.shape[0])]
    alone = ca.Function("alone", one, look(*one)[:1])  # without the Jacobian that `residuals` gives as well
    x, data = ca.MX.sym("x", m), ca.MX.sym("data", *looks.data.shape)
    every = ca.Function("all", [x, data], [alone.map(n)(ca.repmat(x, 1, n), data)])
    columns, r = np.ascontiguousarray(looks.data.T), np.empty((n, 5))

    def value(x: np.ndarray) -> np.ndarray:
        filled(every, (np.ascontiguousarray(x), columns), (r,))
        return np.concatenate(((root_w * r).ravel(), root_prior @ (x - center)))

    def slope(x: np.ndarray) -> np.ndarray:
        J = root_w[:, :, None] * residuals(x, looks)[1]
        return np.concatenate((J.reshape(-1, m), root_prior))

    def by_scipy(jacobian: Callable[[np.ndarray], np.ndarray] | str) -> float:
        return 2.0 * float(least_squares(value, start, jacobian, method="trf", x_scale="jac").cost)

    return {
        OURS: lambda: solve(looks, center, prior, weights, start).cost,
        "least_squares, our Jacobian": lambda: by_scipy(slope),
        "least_squares, 2-point": lambda: by_scipy("2-point"),
    }


def peak_memory(of: Problem, name: str) -> float:
    """By how much solving it raises a new process's resident memory at its highest [bytes]; NaN but on Linux."""
    if not _STATUS.exists():
        return float("nan")
    code = f"import sys; from {__name__} import _peak; _peak(sys.stdin.buffer, {name!r})"
    run = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(of), capture_output=True, check=True)
    return float(run.stdout)


def _peak(file: object, name: str) -> None:
    of = pickle.load(file)  # type: ignore[arg-type]
    run = solvers(of)[name]
    residuals(of.start, of.looks.take(np.arange(10)))  # libraries have loaded what they load
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the highest so far is forgotten
    run()
    print(1024.0 * (_resident("VmHWM") - before))


def _resident(key: str) -> float:
    """[kB]"""
    lines = _STATUS.read_text(encoding="ascii").splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(key)))
