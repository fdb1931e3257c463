"""The least squares of a calibration in numbers: samples, prior and weights, and the solution by CasADi's `nlpsol`.

The expressions are those of `equations`. Tests hold the solution against Gauss-Newton with Marquardt's damping in a few
lines of NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ..errors import NoSolution
from .equations import Gaussian, Layout
from .protocols import Axis, Closure, Condition, Direction

MIN_LENGTH = 0.01  # [m] below which a length has not converged
STEPS = 60
TOLERANCE = 1e-4  # of the gradient, by standard deviations of the prior
LOOSE_TOLERANCE = 0.05  # standard deviations of the result that may be left to go after the last step
_QUIET = dict.fromkeys(("print_header", "print_time", "error_on_fail"), False)
_QUIET_QP = _QUIET | dict.fromkeys(("print_iter", "print_info"), False)
_QUIET_NLP = _QUIET | dict.fromkeys(("print_iteration", "print_status", "show_eval_warnings"), False)
_BLAS = "classic" if ca.has_blas("classic") else "reference"


@dataclass(frozen=True)
class Observations:
    """n samples, each of one condition."""

    layout: Layout
    data: np.ndarray  # (rows, n): Q of each sensor xyzw, `Layout.place`, [s] since the start pose
    condition_index: np.ndarray  # (n,) number of each sample's condition, in ascending order

    def __len__(self) -> int:
        return self.data.shape[1]

    @cached_property
    def spans(self) -> list[tuple[Condition, slice]]:
        """Each condition with the slice of its samples."""
        edges = np.searchsorted(self.condition_index, np.arange(len(self.layout.conditions) + 1))
        return [(c, slice(int(edges[i]), int(edges[i + 1]))) for i, c in enumerate(self.layout.conditions)]

    @cached_property
    def closures(self) -> list[tuple[Closure, slice]]:
        """Each closure with the slice of its samples."""
        return [(condition, span) for condition, span in self.spans if isinstance(condition, Closure)]

    @cached_property
    def poses(self) -> dict[str, list[tuple[Direction | Axis, slice]]]:
        """Phase → its stated poses, each with the slice of its samples."""
        poses: dict[str, list[tuple[Direction | Axis, slice]]] = {}
        for condition, span in self.spans:
            if isinstance(condition, Direction | Axis):
                poses.setdefault(condition.phase, []).append((condition, span))
        return poses

    @cached_property
    def _functions(self) -> list[tuple[tuple[ca.Function, ca.Function], ca.DM]]:
        """The functions of each condition with its data, which CasADi maps them over."""
        return [(self.layout.functions[condition], ca.DM(self.data[:, span])) for condition, span in self.spans]

    def residuals(self, x: ca.MX | np.ndarray) -> tuple[ca.MX, ca.MX]:
        """Return the residuals (k, n) and the gaps (3, n) [m], zero without a closure, in CasADi."""
        r, gaps = zip(*(functions[0](x, data) for functions, data in self._functions), strict=True)
        return ca.horzcat(*r), ca.horzcat(*gaps)

    def jacobian(self, x: ca.MX | np.ndarray) -> ca.MX:
        """Return the transposed Jacobian of all residuals (m, n k), sample by sample, in CasADi."""
        return ca.horzcat(*(functions[1](x, data) for functions, data in self._functions))

    def gaps(self, x: np.ndarray) -> np.ndarray:
        """Return the gaps (n, 3) [m] at x (m,), zero without a closure."""
        return np.asarray(self.residuals(x)[1]).T

    def place_points(self, x: np.ndarray) -> np.ndarray:
        """Return x with each unknown fixed point and height at the mean of the body's points that lie on it."""
        unknown = self.layout.unknown
        x, gaps = x.copy(), self.gaps(x) if unknown else np.zeros((len(self), 3))
        for closure, span in self.closures:
            if closure.kind == "plane":
                x[unknown[closure]] += gaps[span, : closure.rows].mean()
            elif closure.kind == "fixed_point" and closure.at is None:
                x[unknown[closure]] += gaps[span].mean(axis=0)
        return x


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """½ Σ w r(x)² + ½ (x − c)ᵀ Λ (x − c) at one x, to be made least; and how the weights were found (`weights`)."""

    observations: Observations  # n samples, each with k residuals r
    prior: Gaussian  # c and Λ
    weights: np.ndarray  # w (n, k)
    x: np.ndarray  # (m,)
    contact: np.ndarray  # (n,) weight of each sample's gap, near 0 where the palms are apart
    effective_sample_size: float = 0.0  # of the gap
    posed: Mapping[str, float] = field(default_factory=dict)  # phase of poses → standard deviations off all else

    @property
    def lower_bounds(self) -> np.ndarray:
        """(m,) of x: no length is below `MIN_LENGTH`, all else is free."""
        bounds = np.full(len(self.x), -np.inf)
        bounds[self.observations.layout.length] = MIN_LENGTH
        return bounds

    @cached_property
    def _residuals(self) -> tuple[np.ndarray, np.ndarray]:
        r, gaps = self.observations.residuals(self.x)
        return np.asarray(r).T, np.asarray(gaps).T

    @property
    def residuals(self) -> np.ndarray:
        """(n, k) of the samples; the first three are those of a closure, whitened, or of another condition."""
        return self._residuals[0]

    @property
    def gaps(self) -> np.ndarray:
        """(n, 3) [m], zero without a closure."""
        return self._residuals[1]

    @cached_property
    def jacobian(self) -> np.ndarray:
        """(n, k, m) of the residuals."""
        return np.asarray(self.observations.jacobian(self.x)).T.reshape(*self.residuals.shape, -1)

    @cached_property
    def information(self) -> np.ndarray:
        """JᵀWJ + Λ (m, m)."""
        J = self.jacobian.reshape(-1, len(self.x))
        return (J.T * self.weights.ravel()) @ J + self.prior[1]

    @cached_property
    def covariance(self) -> np.ndarray:
        """(m, m) the inverse of the information."""
        return np.linalg.inv(self.information)

    @property
    def gradient(self) -> np.ndarray:
        """(m,) of half the cost."""
        weighted, (mean, information) = (self.weights * self.residuals).ravel(), self.prior
        return self.jacobian.reshape(-1, len(self.x)).T @ weighted + information @ (self.x - mean)

    @property
    def remaining(self) -> float:
        """What is left to go to the minimum [standard deviations], but for lengths at their bound."""
        free = (self.x > self.lower_bounds + 1e-6) | (self.gradient < 0.0)
        gradient = self.gradient[free]
        return float(np.sqrt(gradient @ np.linalg.solve(self.information[np.ix_(free, free)], gradient)))


def solve(problem: LeastSquares, steps: int = STEPS, *, strict: bool = True) -> LeastSquares:
    """Return the least squares at its minimum, by sequential quadratic programming with the Gauss-Newton Hessian.

    It takes `steps` at most. Where they do not suffice it raises `NoSolution` if `strict`, else it returns the last x.
    """
    observations, (mean, information), weights = problem.observations, problem.prior, problem.weights
    start = np.maximum(problem.x, problem.lower_bounds)
    # In units of the prior's standard deviations the gradient says how far there is to go.
    scale = np.diag(information) ** -0.5
    z = ca.MX.sym("z", len(start))
    x = start + scale * z
    squares = ca.dot(ca.DM(weights.T), observations.residuals(x)[0] ** 2)
    cost = 0.5 * squares + 0.5 * ca.bilin(information, x - mean, x - mean)
    JT = scale * observations.jacobian(x)
    hessian = ca.mtimes(JT @ ca.diag(ca.DM(weights.ravel())), JT.T, _BLAS)
    hessian += np.outer(scale, scale) * information
    inputs = {"x": z, "p": ca.MX.sym("none", 0, 1), "lam:f": ca.MX.sym("lam", 1), "lam:g": ca.MX.sym("none", 0, 1)}
    options: dict[str, Any] = _QUIET_NLP | {
        "hess_lag": ca.Function("nlp_hess_l", [*inputs.values()], [hessian], [*inputs], ["hess:gamma:x:x"]),
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "max_iter": steps,
        "tol_du": TOLERANCE,
        "min_step_size": 0.0,  # the gradient alone says when it is done
        "max_iter_ls": 30,
        "beta": 0.5,
        "merit_memory": 1,  # every step lowers the cost
        "qpsol": "qrqp",
        "qpsol_options": _QUIET_QP,
    }
    program: dict[str, Any] = {"x": z, "f": cost}
    solver = ca.nlpsol("calibration", "sqpmethod", program, options)
    minimiser = np.asarray(solver(x0=0.0, lbx=(problem.lower_bounds - start) / scale)["x"]).ravel()
    if not np.all(np.isfinite(minimiser)):
        minimiser = np.zeros(len(start))
    solution = replace(problem, x=np.maximum(start + scale * minimiser, problem.lower_bounds))
    if strict and not solution.remaining < LOOSE_TOLERANCE:
        raise NoSolution(
            f"the lengths did not converge ({solution.remaining:.2g} standard deviations to go); check that the hands "
            f"do in the phase what the protocol says, and that every sensor sits where the session says"
        )
    return solution
