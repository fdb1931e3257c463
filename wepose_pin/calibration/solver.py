"""The least squares of a calibration as one problem, and its solver.

min ½ Σ w r(x)² + ½ (x − c)ᵀ Λ (x − c) with bounds on the lengths. `solve` hands it to CasADi's `nlpsol`: sequential
quadratic programming with the Gauss-Newton Hessian, JᵀWJ + Λ. Tests and `python -m benchmarks calibration` hold it
against Gauss-Newton with Marquardt's damping in a few lines of NumPy.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..errors import NoSolution
from .least_squares import GAP_ROWS, Gaussian, Observations, residuals

MIN_LENGTH = 0.01  # [m] below which a length has not converged
TOLERANCE = 1e-4  # standard deviations of the result that may be left to go
LOOSE_TOLERANCE = 0.05  # the same where the steps did not suffice
STEPS = 60
SAME_SCALE_STEPS = 10  # after which the unknowns are scaled anew
HALVINGS = 30  # of a step that does not lower the cost
# Marquardt's damping at the start, as a share of the Hessian's diagonal, by how much it changes, and within what.
DAMPING, DAMPING_FACTOR = 1e-4, 8.0
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e8
_QUIET = dict.fromkeys(("print_header", "print_iteration", "print_time", "print_status", "show_eval_warnings"), False)
# A quadratic program that raises prints its matrices, which no option keeps it from: it is asked whether it succeeded.
QUIET_QP = dict.fromkeys(("print_header", "print_iter", "print_info", "print_time", "error_on_fail"), False)


class Fit(NamedTuple):
    """A solution of the least squares."""

    x: np.ndarray
    closure: np.ndarray  # (n, 3) whitened residuals of the gap
    hinge: np.ndarray  # (n, k − 3) of the hinges, in units of `HINGE_STD`
    gaps: np.ndarray  # (n, 3) [m]
    jacobian: np.ndarray  # (n, k, m) of gap and hinges
    information: np.ndarray  # of x, prior included
    cost: float


@dataclass(frozen=True)
class LeastSquares:
    """Σ w r² + (x − c)ᵀ Λ (x − c), to be made least.

    Parameters
    ----------
    observations : the samples, whose residuals are r
    prior : c and Λ
    weights : w (n, k)
    """

    observations: Observations
    prior: Gaussian
    weights: np.ndarray

    @property
    def lower_bounds(self) -> np.ndarray:
        """(m,) of x: no length is below `MIN_LENGTH`, all else is free."""
        bounds = np.full(self.observations.layout.size, -np.inf)
        bounds[self.observations.layout.length] = MIN_LENGTH
        return bounds

    def evaluate(self, x: np.ndarray) -> Evaluation:
        """Residuals, their Jacobian and the cost at x."""
        return self.weigh(x, *residuals(x, self.observations))

    def weigh(self, x: np.ndarray, r: np.ndarray, J: np.ndarray, gaps: np.ndarray) -> Evaluation:
        """The cost with residuals (n, k), Jacobian (n, k, m) and gaps (n, 3) that are known at x."""
        off = x - self.prior.mean
        return Evaluation(self, x, r, J, gaps, float(np.sum(self.weights * r**2) + off @ self.prior.information @ off))

    def evaluate_start(self, start: np.ndarray | Fit) -> Evaluation:
        """The evaluation at x, or at a fit of the same samples with other weights."""
        if isinstance(start, Fit):
            return self.weigh(start.x, np.hstack((start.closure, start.hinge)), start.jacobian, start.gaps)
        return self.evaluate(start)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A problem at one x."""

    problem: LeastSquares
    x: np.ndarray  # (m,)
    r: np.ndarray  # (n, k)
    J: np.ndarray  # (n, k, m)
    gaps: np.ndarray  # (n, 3) [m]
    cost: float

    @cached_property
    def gradient(self) -> np.ndarray:
        """(m,) of half the cost."""
        mean, information = self.problem.prior
        weighted = (self.problem.weights * self.r).ravel()
        return self.J.reshape(-1, len(self.x)).T @ weighted + information @ (self.x - mean)

    @cached_property
    def information(self) -> np.ndarray:
        """JᵀWJ + Λ (m, m): the Gauss-Newton Hessian of half the cost."""
        J = self.J.reshape(-1, len(self.x))
        WJ = (self.problem.weights[:, :, None] * self.J).reshape(J.shape)
        return WJ.T @ J + self.problem.prior.information

    def remaining(self, gradient: np.ndarray | None = None) -> float:
        """What is left to go [standard deviations], by the gradient or by one with the bounds' multipliers (m,)."""
        gradient = self.gradient if gradient is None else gradient
        return float(np.sqrt(np.maximum(gradient @ np.linalg.solve(self.information, gradient), 0.0)))

    def fit(self) -> Fit:
        """The solution, where this is one."""
        return Fit(self.x, self.r[:, :GAP_ROWS], self.r[:, GAP_ROWS:], self.gaps, self.J, self.information, self.cost)


def solve(
    problem: LeastSquares,
    start: np.ndarray | Fit,
    steps: int = STEPS,
    strict: bool = True,
    tolerance: float = TOLERANCE,
) -> Fit:
    """The minimiser, by CasADi's `nlpsol` with the Gauss-Newton Hessian.

    The unknowns are z = Lᵀ (x − x0) with L Lᵀ the information at the start x0: one of z is one standard deviation, so
    the gradient's size is a stopping rule. The information changes on the way, so z is chosen anew every few steps.

    Parameters
    ----------
    start : x to begin with, or a fit of the same samples with other weights
    steps : at most
    strict : raise where the steps do not suffice, instead of returning the last x
    tolerance : standard deviations that may be left to go

    Raises
    ------
    NoSolution
        It did not converge.
    """
    now = problem.evaluate_start(start)
    if np.any(now.x < problem.lower_bounds):
        now = problem.evaluate(np.maximum(now.x, problem.lower_bounds))
    bounded = problem.observations.layout.length
    multipliers, damping, left, largest = np.zeros(bounded.stop), DAMPING, steps, tolerance / 2.0
    while True:
        gradient = now.gradient.copy()
        gradient[bounded] += multipliers
        remaining = now.remaining(gradient)
        if not remaining >= tolerance or left <= 0:  # NaN is no way to go either
            break
        oracle = _Oracle(now, damping)
        now, multipliers = _minimise(oracle, min(left, SAME_SCALE_STEPS), largest)
        if not oracle.steps:  # `nlpsol` looks at the largest number of the gradient, `remaining` at all m together
            largest = tolerance / (2.0 * np.sqrt(len(now.x)))
        damping, left = oracle.damping, left - max(oracle.steps, 1)
    return accept(now, remaining, strict)


def _minimise(oracle: _Oracle, steps: int, tolerance: float) -> tuple[Evaluation, np.ndarray]:
    """The evaluation at the end, and the multipliers (k,) of the lengths' bounds there.

    It is done where no number of the gradient by z is above `tolerance`.
    """
    m, K = len(oracle.start.x), oracle.bounded.stop
    unknowns, multipliers = {"x": (m, 1), "p": (0, 1)}, {"lam:f": (1, 1), "lam:g": (K, 1)}
    values, slopes = {"f": (1, 1), "g": (K, 1)}, {"f": (1, 1), "grad:f:x": (m, 1), "g": (K, 1), "jac:g:x": (K, m)}
    functions = (
        _Function(oracle, "nlp", unknowns, values),
        _Function(oracle, "nlp_jac_fg", unknowns, slopes),
        _Function(oracle, "nlp_hess_l", unknowns | multipliers, {"hess:gamma:x:x": (m, m)}),
    )
    options: dict[str, Any] = _QUIET | {
        "jac_fg": functions[1],
        "hess_lag": functions[2],
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "max_iter": steps,
        "tol_du": tolerance,
        "min_step_size": 0.0,  # the gradient alone says when it is done
        "max_iter_ls": HALVINGS,
        "beta": 0.5,
        "merit_memory": 1,  # every step lowers the cost
        "qpsol": "qrqp",
        "qpsol_options": QUIET_QP,
    }
    solver = ca.nlpsol("calibration", "sqpmethod", functions[0], options)
    oracle.program = solver.find_function("qpsol")
    failed = False
    try:
        solution = solver(x0=np.zeros(m), lbg=np.full(K, MIN_LENGTH), ubg=np.inf)
    except RuntimeError:  # of an error below, or of bounds that contradict each other
        failed = True
    if isinstance(oracle.error, _NoStep):
        return oracle.accepted, np.zeros(K)
    if oracle.error is not None:
        raise oracle.error
    if not failed:
        z, lam = (np.asarray(solution[name]).ravel() for name in ("x", "lam_g"))
        if np.all(np.isfinite(z)):
            return oracle.evaluate(z), lam
    return oracle.accepted, np.zeros(K)


class _NoStep(Exception):
    """The quadratic program of a step has no solution."""


class _Oracle:
    """What `nlpsol` asks of a problem, in z = Lᵀ (x − x0); each z is evaluated once.

    Parameters
    ----------
    start : the evaluation at x0, whose information is L Lᵀ
    damping : of the first step

    Attributes
    ----------
    bounded : the lengths among the unknowns, which have bounds
    accepted, steps : the evaluation where the last step began, and how many steps there were with it
    error : raised by an evaluation
    program : the quadratic program of the steps
    """

    program: ca.Function

    def __init__(self, start: Evaluation, damping: float) -> None:
        self.start = self._now = self.accepted = start
        self.bounded = start.problem.observations.layout.length
        self._z = np.zeros(len(start.x))
        self._x_by_z = np.linalg.inv(np.linalg.cholesky(start.information)).T
        self.damping, self.steps, self._tries, self._begins_step = damping, 0, 0, False
        self.error: BaseException | None = None

    def evaluate(self, z: np.ndarray) -> Evaluation:
        if not np.array_equal(z, self._z):
            self._z = z.copy()
            self._now = self.start.problem.evaluate(self.start.x + self._x_by_z @ z)
            self._tries += 1
        return self._now

    def values(self, z: np.ndarray) -> tuple[Any, ...]:
        """Half the cost, and the lengths (k,) [m]; the first after `curvature` is at the end of the program's step.

        Raises
        ------
        _NoStep
            The program has no solution.
        """
        if self._begins_step and not _succeeded(self.program):
            raise _NoStep
        self._begins_step = False
        now = self.evaluate(z)
        return 0.5 * now.cost, now.x[self.bounded]

    def slopes(self, z: np.ndarray) -> tuple[Any, ...]:
        """Half the cost with its gradient (m,), and the lengths (k,) [m] with their Jacobian (k, m)."""
        cost, lengths = self.values(z)
        return cost, self._x_by_z.T @ self._now.gradient, lengths, self._x_by_z[self.bounded]

    def curvature(self, z: np.ndarray) -> tuple[Any, ...]:
        """The Gauss-Newton Hessian (m, m) of half the cost, damped; that of the lengths is zero.

        Where the hands hardly move, undamped steps are shortened again and again. So Marquardt's damping grows with
        each try that did not lower the cost, and falls with a step that did at once.
        """
        self.accepted = self.evaluate(z)
        self.steps += 1
        self._begins_step = True
        if self._tries:
            self.damping *= DAMPING_FACTOR ** (self._tries - 2)
            self.damping = min(max(self.damping, LEAST_DAMPING), MOST_DAMPING)
        self._tries = 0
        H = self.accepted.information
        return (self._x_by_z.T @ (H + self.damping * np.diag(np.diag(H))) @ self._x_by_z,)


def _succeeded(program: ca.Function) -> bool:
    """Whether the quadratic program found a solution when it was solved last."""
    for memory in (1, 0):  # which one `sqpmethod` takes differs between versions
        with contextlib.suppress(RuntimeError):  # it was not solved in this one
            return bool(program.stats(memory)["success"])
    return True


_Shapes = Mapping[str, tuple[int, int]]  # by CasADi's names of inputs or outputs


class _Function(ca.Callback):
    """A function of an oracle, by CasADi's name of it; inputs after the first, z, are not looked at."""

    def __init__(self, oracle: _Oracle, name: str, inputs: _Shapes, outputs: _Shapes) -> None:
        ca.Callback.__init__(self)
        self._oracle, self._inputs, self._outputs = oracle, list(inputs.items()), list(outputs.items())
        self._function = {"nlp": oracle.values, "nlp_jac_fg": oracle.slopes, "nlp_hess_l": oracle.curvature}[name]
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(*self._inputs[i][1])

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(*self._outputs[i][1])

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Sequence[Any], results: Sequence[Any]) -> int:
        """Write the results where CasADi wants them, column by column; 1 after an error, which `_minimise` raises."""
        if self._oracle.error is not None:
            return 1
        try:
            values = self._function(np.frombuffer(arguments[0]))
        except BaseException as error:  # CasADi would keep its text alone, of Ctrl-C too
            self._oracle.error = error
            return 1
        for result, value in zip(results, values, strict=True):
            if result is not None:
                np.frombuffer(result)[:] = np.ravel(value, order="F")
        return 0


def accept(now: Evaluation, remaining: float, strict: bool) -> Fit:
    """The fit at the end; `NoSolution` where too many standard deviations remain, if `strict`."""
    if remaining < LOOSE_TOLERANCE or not strict:
        return now.fit()
    raise NoSolution(
        f"the lengths did not converge ({remaining:.2g} standard deviations to go); check that the hands do in the "
        f"phase what the protocol says, and that every sensor sits where the session says"
    )
