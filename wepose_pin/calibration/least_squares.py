"""The least squares of a calibration in numbers: samples, prior and weights, and the solution by CasADi's `nlpsol`.

The expressions are those of `equations`. The weight of the data is measured, not assumed. In a few rounds of
Gauss-Newton the residual's own mean square gives its variance, and its autocorrelation the effective sample size.
Samples at which the palms are apart are outliers and lose their weight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..errors import NoSolution
from .equations import GAP_ROWS, HINGE_STD, Gaussian, Layout
from .protocols import Axis, Closure, Condition, Direction, FreeMotion

MIN_LENGTH = 0.01  # [m] below which a length has not converged
STEPS = 60
TOLERANCE = 1e-4  # of the gradient, by standard deviations of the prior
LOOSE_TOLERANCE = 0.05  # standard deviations of the result that may be left to go after the last step
_QUIET = dict.fromkeys(("print_header", "print_time", "error_on_fail"), False)
_QUIET_QP = _QUIET | dict.fromkeys(("print_iter", "print_info"), False)
_QUIET_NLP = _QUIET | dict.fromkeys(("print_iteration", "print_status", "show_eval_warnings"), False)
_BLAS = "classic" if ca.has_blas("classic") else "reference"
# Errors of orientations are slow: two samples closer than this [s] are never independent, however white the residual
# of one phase is. Chosen on simulated people, whose joint errors it brings within the covariance.
LEAST_CORRELATION_S = 3.0
MIN_CONTACT = 0.1  # weight of a sample's gap below which the palms are apart
# Residual variance, in units of the weights', that no person's hands stay below (a fraction of a millimetre).
LEAST_VARIANCE = 1e-4
THIRD_CHI2 = {1: 0.1485, 2: 0.7133, 3: 1.4237}  # 30 % quantile of chi², by degrees of freedom
ROUNDS = 5
ROUND_STEPS = 2  # of the rounds after the first: the next one goes on
FINAL_STEPS = 300  # of the last solve, which must converge: hands that hardly move take a hundred
QUICK_ROUNDS, QUICK_STEPS = 1, 15
OUTLIER = 5.0  # times the usual gap, at which the palms are apart
MIN_LATE_CONTACT = 0.4  # weight below which the palms are apart in the last rounds, when the fit is about right
# [rad] by which people's elbows leave a hinge (docs/people.md): an oblique axis, and one that wanders.
ELBOW_STD = np.deg2rad(4.0)
LEAST_BEND = 0.2  # sine of the angle by which a segment must bend to show its axis
CONTRADICTED = 3.0  # standard deviations between a measured length, or a pose, and what is known without it
POSED_ROUND = 1  # after which poses are used that do not contradict the closures
# [m] rms error of the lengths of simulated people after a minute (docs/validation.md), from soft tissue and shoulders,
# which the residuals show in part.
LEAST_LENGTH_STD = 0.010

# Residuals of a closure whose weight is measured: their samples and columns, the contact (n,) of these samples, and the
# least variance.
Block = tuple[slice, slice, np.ndarray, float]


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """½ Σ w r(x)² + ½ (x − c)ᵀ Λ (x − c) of n samples, each of one condition, at one x; to be made least."""

    layout: Layout
    data: np.ndarray  # (rows, n): Q of each sensor xyzw, `Layout.place`, [s] since the start pose
    condition_index: np.ndarray  # (n,) number of each sample's condition, in ascending order
    prior: Gaussian  # c and Λ
    x: np.ndarray  # (m,)
    weights: np.ndarray  # w (n, k) of the samples' residuals r
    contact: np.ndarray  # (n,) weight of each sample's gap, near 0 where the palms are apart
    effective_sample_size: float = 0.0  # of the gap
    posed: Mapping[str, float] = field(default_factory=dict)  # phase of poses → standard deviations off all else

    @cached_property
    def spans(self) -> list[tuple[Condition, slice]]:
        """Each condition with the slice of its samples."""
        edges = np.searchsorted(self.condition_index, np.arange(len(self.layout.conditions) + 1))
        return [(c, slice(int(edges[i]), int(edges[i + 1]))) for i, c in enumerate(self.layout.conditions)]

    @property
    def closures(self) -> list[tuple[Closure, slice]]:
        """Each closure with the slice of its samples."""
        return [(condition, span) for condition, span in self.spans if isinstance(condition, Closure)]

    @property
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

    def express_residuals(self, x: ca.MX | np.ndarray) -> tuple[ca.MX, ca.MX]:
        """Return the residuals (k, n) and the gaps (3, n) [m], zero without a closure, in CasADi."""
        r, gaps = zip(*(functions[0](x, data) for functions, data in self._functions), strict=True)
        return ca.horzcat(*r), ca.horzcat(*gaps)

    def express_jacobian(self, x: ca.MX | np.ndarray) -> ca.MX:
        """Return the transposed Jacobian of all residuals (m, n k), sample by sample, in CasADi."""
        return ca.horzcat(*(functions[1](x, data) for functions, data in self._functions))

    def measure_gaps(self, x: np.ndarray) -> np.ndarray:
        """Return the gaps (n, 3) [m] at x (m,), zero without a closure."""
        return np.asarray(self.express_residuals(x)[1]).T

    def place_points(self, x: np.ndarray) -> np.ndarray:
        """Return x with each unknown fixed point and height at the mean of the body's points that lie on it."""
        unknown = self.layout.unknown
        x, gaps = x.copy(), self.measure_gaps(x) if unknown else np.zeros((0, 3))
        for closure, span in self.closures:
            if closure.kind == "plane":
                x[unknown[closure]] += gaps[span, : closure.rows].mean()
            elif closure.kind == "fixed_point" and closure.at is None:
                x[unknown[closure]] += gaps[span].mean(axis=0)
        return x

    @property
    def lower_bounds(self) -> np.ndarray:
        """(m,) of x: no length is below `MIN_LENGTH`, all else is free."""
        bounds = np.full(len(self.x), -np.inf)
        bounds[self.layout.length] = MIN_LENGTH
        return bounds

    @cached_property
    def residuals(self) -> np.ndarray:
        """(n, k) of the samples; the first three are those of a closure, whitened, or of another condition."""
        return np.asarray(self.express_residuals(self.x)[0]).T

    @cached_property
    def jacobian(self) -> np.ndarray:
        """(n, k, m) of the residuals."""
        return np.asarray(self.express_jacobian(self.x)).T.reshape(*self.residuals.shape, -1)

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
    def remaining(self) -> float:
        """What is left to go to the minimum [standard deviations], but for lengths at their bound."""
        weighted, (mean, information) = (self.weights * self.residuals).ravel(), self.prior
        gradient = self.jacobian.reshape(-1, len(self.x)).T @ weighted + information @ (self.x - mean)
        free = (self.x > self.lower_bounds + 1e-6) | (gradient < 0.0)
        gradient = gradient[free]
        return float(np.sqrt(gradient @ np.linalg.solve(self.information[np.ix_(free, free)], gradient)))


def solve(problem: LeastSquares, steps: int = STEPS, *, strict: bool = True) -> LeastSquares:
    """Return the least squares at its minimum, by sequential quadratic programming with the Gauss-Newton Hessian.

    It takes `steps` at most. Where they do not suffice, or a length is at its bound, it raises `NoSolution` if
    `strict`, else it returns the last x.
    """
    (mean, information), weights = problem.prior, problem.weights
    start = np.maximum(problem.x, problem.lower_bounds)
    # In units of the prior's standard deviations the gradient says how far there is to go.
    scale = np.diag(information) ** -0.5
    z = ca.MX.sym("z", len(start))
    x = start + scale * z
    squares = ca.dot(ca.DM(weights.T), problem.express_residuals(x)[0] ** 2)
    cost = 0.5 * squares + 0.5 * ca.bilin(information, x - mean, x - mean)
    JT = scale * problem.express_jacobian(x)
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
    if not strict:
        return solution
    lengths, names = solution.x[problem.layout.length], problem.layout.lengths
    failure = "" if solution.remaining < LOOSE_TOLERANCE else f"{solution.remaining:.2g} standard deviations to go"
    if np.min(lengths, initial=np.inf) < 1.01 * MIN_LENGTH:  # it lies at its bound, to the solver's accuracy
        failure = f"{names[int(np.argmin(lengths))]} = {1e3 * np.min(lengths):.0f} mm"
    if failure:
        raise NoSolution(
            f"the lengths did not converge ({failure}); check that the points do in the phase what the protocol says, "
            f"and that every sensor sits where the session says"
        )
    return solution


# Weights --------------------------------------------------------------------------------------------------------------


def solve_reweighted(start: LeastSquares, quick: bool = False) -> LeastSquares:
    """Return the fit with gap and hinges weighted by their own residuals: variance, and how long it stays correlated.

    Poses beside a closure are used where they do not contradict it. What they are compared with is found without them.
    `quick`: one round with few steps and without hinges.
    """
    rounds, steps = (QUICK_ROUNDS, QUICK_STEPS) if quick else (ROUNDS, STEPS)
    closures, poses = start.closures, start.poses
    stated, posed = _state_weights(start), dict[str, float]()
    if quick:
        stated[:, GAP_ROWS:] = 0.0
    weights = stated.copy()
    for span in [span for own in poses.values() for _, span in own] if closures else ():
        weights[span] = 0.0
    fit = replace(start, weights=weights)
    for k in range(rounds if closures else 0):
        fit = solve(fit, steps if k == 0 else ROUND_STEPS, strict=False)
        weights, contact = fit.weights.copy(), fit.contact.copy()
        least = MIN_LATE_CONTACT if k > 1 else MIN_CONTACT
        for closure, span in closures:
            # The lower third: the palms may be apart for half of the phase and more.
            rows = closure.rows
            size = np.sum(fit.residuals[span, :rows] ** 2, axis=1)
            usual = max(float(np.quantile(size, 0.3)) / THIRD_CHI2[rows], LEAST_VARIANCE)
            weight = (1.0 + size / (usual * OUTLIER**2 * rows)) ** -2
            contact[span] = np.where(weight > least, weight, 0.0)
        for block in _list_blocks(fit, contact, hinges=not quick):
            span, columns, touch, _ = block
            variance, correlated = _measure_block(fit, block)
            weights[span, columns] = touch[:, None] / (correlated * variance)
        if k == min(POSED_ROUND, rounds - 1):
            posed = {phase: _measure_pose(fit, own, stated, used=False) for phase, own in poses.items()}
            for span in [span for phase, own in poses.items() if posed[phase] <= CONTRADICTED for _, span in own]:
                weights[span] = stated[span]
        fit = replace(fit, weights=weights, contact=contact)
    fit = solve(fit, steps if quick else FINAL_STEPS, strict=not quick)
    if not closures and not quick:
        posed = {phase: _measure_pose(fit, own, stated, used=True) for phase, own in poses.items()}
    blocks = _list_blocks(fit, fit.contact, hinges=False)
    size = sum((float(block[2].sum()) / _measure_block(fit, block)[1] for block in blocks), 0.0)
    return replace(fit, effective_sample_size=size, posed=posed)


def _list_blocks(fit: LeastSquares, contact: np.ndarray, hinges: bool = True) -> list[Block]:
    blocks: list[Block] = []
    for closure, span in fit.closures:
        blocks.append((span, slice(closure.rows), contact[span], LEAST_VARIANCE))
        if fit.layout.hinges and hinges:
            # However well an elbow's axis fits this motion: what it leaves a hinge by follows the pose.
            every = np.ones(span.stop - span.start)
            blocks.append((span, slice(GAP_ROWS, None), every, (ELBOW_STD / HINGE_STD) ** 2))
    return [block for block in blocks if block[2].sum() > 0.0]


def _measure_block(fit: LeastSquares, block: Block) -> tuple[float, float]:
    """Return the variance of a block's residuals, and of how many samples one is independent."""
    span, columns, contact, least_variance = block
    r = fit.residuals[span, columns]
    variance = float(contact @ np.sum(r**2, axis=1)) / (r.shape[1] * float(contact.sum()))
    return max(variance, least_variance), count_correlated_samples(r * contact[:, None], fit.data[-1])


def _state_weights(fit: LeastSquares) -> np.ndarray:
    """Return the weights (n, k) of poses, which are stated, and those of closures to begin with."""
    weights = np.full((len(fit.contact), fit.layout.residuals), 1.0 / find_min_correlation(fit.data[-1]))
    weights[:, :GAP_ROWS] *= fit.contact[:, None]
    for condition, span in fit.spans:
        # The error of a pose is constant, and how an elbow leaves its hinge follows its angles: one effective sample.
        size = ELBOW_STD / HINGE_STD if isinstance(condition, FreeMotion) else 1.0
        if isinstance(condition, Axis):  # by the sine of its bend an axis leaves the horizontal if it is off
            first = 4 * fit.layout.sensors.index(condition.segment)
            x, y, _, _ = fit.data[first : first + 4, span]
            size = max(float(np.sqrt(np.mean(1.0 - (1.0 - 2.0 * (x**2 + y**2)) ** 2))), LEAST_BEND)
        if not isinstance(condition, Closure):
            weights[span] = size**-2 / (span.stop - span.start)
    return weights


def find_min_correlation(time: np.ndarray) -> float:
    """Return how many samples at times (n,) [s] lie in `LEAST_CORRELATION_S`."""
    return LEAST_CORRELATION_S / max(float(np.median(np.diff(time))), 1e-3)


def count_correlated_samples(r: np.ndarray, time: np.ndarray) -> float:
    """Return how many samples of `r` (n, k) at times (n,) [s] make one independent one: 1 + 2 Σ ρ to the first zero."""
    n, least = len(r), find_min_correlation(time)
    spectrum = np.abs(np.fft.rfft(r - r.mean(axis=0), 2 * n, axis=0)) ** 2
    rho = np.fft.irfft(spectrum, 2 * n, axis=0)[:n].sum(axis=1)
    if not rho[0] > 0.0:
        return max(1.0, least)
    crossing = int(np.argmax(rho <= 0.0)) if np.any(rho <= 0.0) else n
    return max(float(1.0 + 2.0 * rho[1:crossing].sum() / rho[0]), least)


def estimate_covariance(fit: LeastSquares) -> np.ndarray:
    """Return the covariance (m, m) of x under errors that are correlated over time.

    The weights count as many samples as one as the errors last. That is right where the motion is as slow as the
    errors. Where the motion covers a good part of its range meanwhile, an error acts on other unknowns from sample to
    sample and cancels. So the gradient's covariance is that of sums over windows of the errors' duration,
    C (Λ + Σ (Σ w J)ᵀ σ² (Σ w J) / duration) C, as of Newey and West 1987 with their triangle of weights.
    """
    weights, J, C = fit.weights, fit.jacobian, fit.covariance
    gradient = fit.prior[1].copy()
    for condition, span in fit.spans:
        if not isinstance(condition, Closure):
            gradient += np.einsum("nk,nki,nkj->ij", weights[span], J[span], J[span], optimize=True)
    for block in _list_blocks(fit, fit.contact):
        span, columns, contact, _ = block
        slope, (variance, duration) = J[span, columns], _measure_block(fit, block)
        # The fit has reduced the residuals: their variance gets back what it took.
        taken = np.einsum("nki,ij,nkj->n", slope, C, slope, optimize=True)
        variance += float(contact @ taken) / (slope.shape[1] * float(contact.sum()))
        pull, length = weights[span, columns, None] * slope, round(duration)
        summed = np.concatenate((np.zeros((1, *pull.shape[1:])), np.cumsum(pull, axis=0)))
        ends = np.arange(1, len(pull) + length)
        windows = summed[np.minimum(ends, len(pull))] - summed[np.maximum(ends - length, 0)]
        windows = windows.reshape(-1, C.shape[0])
        gradient += variance / length * windows.T @ windows
    return C @ gradient @ C


class MeasuredLength(NamedTuple):
    """A measured length beside the estimate without it, from the motion, the prior and other measured lengths."""

    metres: float  # [m] as measured
    expected: float  # [m] without it
    std: float  # [m] of that
    measured_std: float  # [m]

    @property
    def deviation(self) -> float:
        """By how many standard deviations the two differ."""
        return abs(self.metres - self.expected) / float(np.hypot(self.std, self.measured_std))


def compare_measured(fit: LeastSquares, measured: Mapping[str, tuple[float, float]]) -> dict[str, MeasuredLength]:
    """Return each measured length, name → ([m], its standard deviation [m]), beside the solution without it."""
    layout, compared = fit.layout, {}
    least_std = 0.0 if layout.model.table.is_mechanism else LEAST_LENGTH_STD
    for name, (metres, std) in measured.items():
        row = layout.lengths.index(name)
        variance = fit.covariance[row, row]
        rest = 1.0 / variance - 1.0 / std**2  # information without that of the measured length
        expected = metres + (fit.x[row] - metres) / (variance * rest)
        compared[name] = MeasuredLength(metres, float(expected), max(float(rest**-0.5), least_std), std)
    return compared


def _measure_pose(
    fit: LeastSquares, poses: Sequence[tuple[Direction | Axis, slice]], stated: np.ndarray, used: bool
) -> float:
    """By how many standard deviations a phase of poses deviates from what is known without it.

    A pose has no residual that would show how it was held, as a closure has: only the other conditions can. `stated`
    (n, k) are the weights of the residuals where the poses are used, and `used` says whether the fit uses them.
    """
    r, H, degrees = [], [], 0
    for condition, span in poses:
        whiten = np.sqrt(stated[span, :GAP_ROWS].sum(axis=0))
        r.append(whiten * fit.residuals[span, :GAP_ROWS].mean(axis=0))
        H.append(whiten[:, None] * fit.jacobian[span, :GAP_ROWS].mean(axis=0))
        degrees += 2 if isinstance(condition, Direction) else 1
    z, slope = np.concatenate(r), np.concatenate(H)
    of_rest = slope @ fit.covariance @ slope.T
    chi2 = float(z @ np.linalg.solve(np.eye(len(z)) + (-of_rest if used else of_rest), z))
    # The deviate of a normal variable that is as rare as chi² (Wilson and Hilferty 1931).
    spread = 2.0 / (9.0 * degrees)
    return float((np.cbrt(chi2 / degrees) - (1.0 - spread)) / np.sqrt(spread))
