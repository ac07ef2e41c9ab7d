"""Fits of feature maps with parameters θ: fits, and Newton steps of θ, alternate.

Each fit has the features h(x; θ̂) and the columns D = ∂h/∂z of `model.weights`, where z are coordinates of θ that are
standard normal a priori. Their weights K (z - ẑ) have the prior of z, so that kernel and noise are learned with θ
integrated out, to first order. Given kernel and noise, ẑ is the mode of p(z | y) with the weights β integrated out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc
from sklearn.exceptions import ConvergenceWarning

from ..data.dataset import Dataset
from ..data.maps import evenly_spaced, take_rows, transformed
from ..data.rows import times_weights
from ..exceptions import UnidentifiedWarning, warn_user
from ..features.theta import Prior
from ..maps.theta import LinearizedFeatures, Theta, theta_jacobian
from ..model.predictor import CoefficientPrior, Predictor
from ..model.weights import ThetaStep, likelihood_of_whitened, theta_step
from ..solvers import solvers_of_all_rows
from ..utils.monitor import Monitor
from ..utils.validation import is_dask
from .fitted import Fitted
from .problem import Problem

# Newton steps end if they are shorter than this many posterior standard deviations, or after so many.
_SETTLED, _STEPS = 0.02, 20
# Largest step, in prior standard deviations, and how often a step is halved.
_LONGEST, _HALVINGS = 1.0, 7
# Another fit follows, up to so many in all, if the features of the last one were not linear in θ on the way to its
# mode: if their errors have an rms of more than this many standard deviations of the noise.
_NONLINEAR, _FITS = 0.1, 4
# Number of rows for the starts. On fewer rows, so many values of θ are tried per parameter, and at most so many in all.
# The best of them are improved.
_START_ROWS, _TRIED_ROWS, _TRIED, _MOST_TRIED, _IMPROVED = 500, 100, 64, 256, 2
# Columns of ∂h/∂z that are 0 on so many rows are left out.
_SEEN_ROWS = 1000
# Values of all z at which columns of ∂h/∂z are found.
_TRIED_SLOPES = (0.0, 0.37, -0.61)
# A Newton step that is longer than so many posterior standard deviations, but does not raise log p(y, z) at any length,
# is one of rounding errors, or of a kink.
_MOVED = 0.5
# Optima of the features alone are different starts if they are so far apart, in prior standard deviations, and if their
# residuals are not larger than this many times the smallest ones.
_APART, _AS_GOOD = 0.5, 1.5
# Noise and parameters of the features alone are found in so many turns. The residuals are not below this share of y².
_TURNS, _LEAST_RESIDUAL = 3, 1e-14
# Number of starts with a Gaussian process.
_STARTS = 3
# Fits from several starts begin with so many iterations, and a tolerance of so many nats per row and output.
ROUGH_ITER, _ROUGH_TOL = 60, 1e-3
# Step of differences, in posterior standard deviations. A second derivative that is below this share of Gauss and
# Newton's is one of rounding errors, or of a kink.
_DIFFERENCE, _FLAT = 0.1, 0.1
# The data do not identify a parameter if its posterior standard deviation is above this share of the prior's.
_UNIDENTIFIED = 0.95
# They ask for a value outside of its prior if it is also further than so many standard deviations from the median.
_EDGE = 2.0
# A parameter that is further than this from the median disagrees with its prior, however well the data identify it.
_FAR = 3.0


# Takes a problem, an earlier fit to continue, whether a rough result is enough, and what it is for the progress.
FitProblem = Callable[[Problem, Fitted | None, bool, str], Fitted]
# Takes z and the step before. None: the features are not finite at z.
StepAt = Callable[[np.ndarray, ThetaStep], ThetaStep | None]


@dataclass(frozen=True)
class Calibration:
    """A fit with parameters θ."""

    # The data with the features at the mode of z, and the problem of the last fit.
    data: Dataset
    problem: Problem
    fitted: Fitted
    posterior: ThetaPosterior

    def warn(self) -> None:
        """Warn if the data do not identify a parameter, or ask for values outside of its prior."""
        if names := self.posterior.at_edges():
            warn_user(
                f"The parameters {names} ended at the edges of their priors, far from the medians. Their standard "
                "deviations may not be valid. Check the model and its units, or give the parameters wider priors.",
                ConvergenceWarning,
            )
        if names := self.posterior.unidentified():
            warn_user(
                f"The data do not identify the parameters {names}: their posterior is as wide as their prior. Fix "
                "them, give them a narrower prior, or add rows in which they matter.",
                UnidentifiedWarning,
            )


@dataclass(frozen=True)
class ThetaPosterior:
    """The posterior of z."""

    theta: Theta
    # (q,) and (q, q): mean and covariance of z.
    mean: np.ndarray
    covariance: np.ndarray
    # Nats by which the models' log likelihoods, each given the other outputs, are above that of all outputs together.
    counted_twice: float = 0.0
    # The result of `_Calibrator.bend`.
    bend: np.ndarray | None = None
    # (o, d, q): K of `model.weights`, without parameters that no output depends on.
    K: np.ndarray | None = None

    @classmethod
    def of(cls, theta: Theta, step: ThetaStep, together: bool, bend: np.ndarray | None = None) -> ThetaPosterior:
        """The posterior for features that are linear in z, as they are at a step, or have a bend.

        ``together``: no nats are counted twice.
        """
        twice = 0.0 if together else step.counted_twice()
        R = step.deviation().root
        RA = R if bend is None else R @ bend
        move = RA @ (R @ (step.gradient.sum(axis=0) - step.z))
        K = step.K[:, :, np.abs(step.K).max(axis=(0, 1), initial=0.0) > 0.0]
        return cls(theta, step.z + move, RA @ RA.T, twice, bend, K)

    def predictor(self, fitted: Fitted) -> Predictor:
        """The predictor of a fit, with outputs that share θ."""
        predictor = fitted.predictor()
        return predictor if self.K is None else predictor.with_theta(self.K)

    def z_under(self, priors: Sequence[Prior]) -> np.ndarray:
        """The coordinates (q,) of the mean under other priors of the same parameters."""
        return np.array([p.coordinate(value) for p, value in zip(priors, self.theta.values(self.mean), strict=True)])

    def attributes(self) -> tuple[dict[str, float], dict[str, float], np.ndarray]:
        """Posterior medians and standard deviations by name, and the covariance (q, q) of the parameters."""
        slopes = self.theta.slopes(self.mean)
        covariance = self.covariance * np.multiply.outer(slopes, slopes)
        names, std = self.theta.names, np.sqrt(np.diagonal(covariance))
        values = self.theta.values(self.mean)
        return dict(zip(names, values.tolist(), strict=True)), dict(zip(names, std.tolist(), strict=True)), covariance

    def unidentified(self) -> list[str]:
        """Names of the parameters of which the data say nothing."""
        return self._named(self._wide & (np.abs(self.mean) <= _EDGE))

    def at_edges(self) -> list[str]:
        """Names of the parameters at an edge of their prior, or far outside of it."""
        # At a bound, a value hardly depends on its coordinate, so that the posterior may be wide.
        distance = np.abs(self.mean)
        return self._named((distance > _FAR) | (self._wide & (distance > _EDGE)))

    @property
    def _wide(self) -> np.ndarray:
        return np.sqrt(np.diagonal(self.covariance)) > _UNIDENTIFIED

    def _named(self, chosen: np.ndarray) -> list[str]:
        return [name for name, is_chosen in zip(self.theta.names, chosen, strict=True) if is_chosen]

    def intervals(self, probability: float = 0.95) -> dict[str, tuple[float, float]]:
        """A credible interval of each parameter. It stays within the bounds of the prior."""
        reach = float(ndtri(0.5 + 0.5 * probability)) * np.sqrt(np.diagonal(self.covariance))
        edges = [self.theta.values(self.mean + sign * reach) for sign in (-1.0, 1.0)]
        return {
            name: (low, high) for name, low, high in zip(self.theta.names, *map(np.ndarray.tolist, edges), strict=True)
        }


# --- features and priors at a value of θ ------------------------------------------------------------------------------


def map_at(feature_map: Any, z: np.ndarray) -> Any:
    """A copy of a fitted map with its parameters at z (q,)."""
    copied = deepcopy(feature_map)
    theta = Theta.of(copied)
    assert theta is not None
    theta.set(z)
    return copied


def columns_of(feature_map: Any, rows: Any, q: int) -> np.ndarray:
    """The feature and the parameter (d, 2) of each column of ∂h/∂z (q,) that is not 0 on some rows."""
    used: Any = False
    # At one value alone, a column may be 0 by chance, such as that of cos(θ x) at θ = 0.
    for at in _TRIED_SLOPES:
        moved = map_at(feature_map, np.full(q, at))
        theta = Theta.of(moved)
        assert theta is not None
        jacobian = np.abs(theta_jacobian(moved, rows, theta))
        used = used | (jacobian.reshape(-1, *jacobian.shape[-2:]) > 0.0).any(axis=0)
    return np.argwhere(used)


def extended(prior: CoefficientPrior, step: ThetaStep) -> CoefficientPrior:
    """The prior of the weights of (h, D), given that of h. Each output's z has its prior given the other outputs."""
    (o, p), d = prior.scale.shape, step.K.shape[1]
    # Parameters without a column have no part in it.
    active = np.flatnonzero(np.abs(step.K).max(axis=(0, 1), initial=0.0) > 0.0)
    mean, scale, reference = (np.zeros((o, p + d)) for _ in range(3))
    mean[:, :p], reference[:, :p] = prior.mean, prior.reference
    root = np.zeros((o, p + d, p + d))
    root[:, :p, :p] = prior.roots()
    for output in range(o):
        # Shared weights have one posterior, and all of the information is in the first output.
        from_others, deviation = step.cavity(0 if prior.shared else output)
        columns = slice(p, p + len(active))
        W, widths, K = deviation.W[np.ix_(active, active)], deviation.widths[active], step.K[output][:, active]
        mean[output, p:] = K @ from_others[active]
        root[output, p:, columns] = K @ (W * widths)
        reference[output, columns] = -(W.T @ from_others[active]) / widths
    scale[...] = np.sqrt(np.square(root).sum(axis=2))
    groups = None if prior.groups is None else np.hstack([prior.groups, np.full((o, d), -1)])
    return CoefficientPrior(mean, scale, reference, root, prior.shared, prior.labels, groups)


def restricted(prior: CoefficientPrior, p: int) -> CoefficientPrior:
    """The prior of the first p weights."""
    root = None if prior.root is None else prior.root[:, :p, :p]
    groups = None if prior.groups is None else prior.groups[:, :p]
    return replace(
        prior,
        mean=prior.mean[:, :p],
        scale=prior.scale[:, :p],
        reference=prior.reference[:, :p],
        root=root,
        groups=groups,
    )


class _Calibrator:
    """The data and the prior of a fit with parameters."""

    def __init__(self, data: Dataset, problem: Problem, theta: Theta):
        self.data, self.problem, self.theta = data, problem, theta
        self.prior = problem.units.prior
        self.p = self.prior.scale.shape[1]
        # Whether one model has all outputs. (If f is orthogonal, bounds are those of a free f, but steps are not.)
        self.together = self.prior.shared or problem.variant.orthogonal
        self.feature_map = data.maps.feature_map
        self.columns = columns_of(self.feature_map, _sample(data, _SEEN_ROWS)[0], len(theta))
        self.sample, targets = _sample(data, _START_ROWS)
        self.targets = targets - problem.units.target_mean
        # z of the last features of the sample.
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def data_at(self, z: np.ndarray) -> Dataset:
        """The data with the features linearised at z."""
        return self.data.through(LinearizedFeatures(map_at(self.feature_map, z), self.columns))

    # --- the features alone, on a sample ------------------------------------------------------------------------------

    def features(self, z: np.ndarray) -> np.ndarray:
        """The features of the sample, linearised at z, (k, p + d) or (k, o, p + d). They may be infinite or NaN."""
        if self._last is None or not np.array_equal(self._last[0], z):
            linearized = LinearizedFeatures(map_at(self.feature_map, z), self.columns)
            self._last = z, _values_or_nan(linearized.transform, self.sample)
        return self._last[1]

    def alone(self, z: np.ndarray, noise: np.ndarray) -> ThetaStep | None:
        """What the sample says about z without a Gaussian process, for noise variances (o,). None: it is not finite."""
        return self._alone(self.features(z), z, noise, self.columns)

    def value_alone(self, z: np.ndarray, noise: np.ndarray) -> float:
        """The log density of the sample and z without a Gaussian process. -inf: the features are not finite."""
        chosen = evenly_spaced(len(self.targets), _TRIED_ROWS)
        features = _values_or_nan(partial(transformed, map_at(self.feature_map, z)), take_rows(self.sample, chosen))
        step = self._alone(features, z, noise, self.columns[:0], chosen)
        return -np.inf if step is None else step.value

    def _alone(
        self,
        features: np.ndarray,
        z: np.ndarray,
        noise: np.ndarray,
        columns: np.ndarray,
        chosen: slice | np.ndarray = slice(None),
    ) -> ThetaStep | None:
        if not np.isfinite(features).all():
            return None
        likelihoods = []
        prior = replace(self.prior, reference=np.zeros_like(self.prior.reference))
        for o, variance in enumerate(noise):
            H = features if features.ndim == 2 else features[:, o]
            r = self.targets[chosen, o] - H[:, : self.p] @ prior.mean[o]
            likelihoods.append(likelihood_of_whitened(H / np.sqrt(variance), r / np.sqrt(variance)))
        return theta_step(likelihoods, prior, columns, z)

    def residual_variance(self, step: ThetaStep) -> np.ndarray:
        """Mean squared residuals (o,) of the features at a value of z."""
        fitted = times_weights(self.features(step.z)[..., : self.p], step.beta)
        squares = np.mean(self.targets**2, axis=0)
        least = _LEAST_RESIDUAL * np.where(squares > 0.0, squares, 1.0)
        return np.maximum(np.mean((self.targets - fitted) ** 2, axis=0), least)

    def nonlinearity(self, before: ThetaStep, after: ThetaStep) -> np.ndarray:
        """Mean squared error (o,) of the features at a value of z, linearised at another."""
        features_before, features_after = self.features(before.z), self.features(after.z)
        p = self.p
        moved = times_weights(features_after[..., :p] - features_before[..., :p], after.beta)
        moved -= times_weights(features_before[..., p:], after.K @ (after.z - before.z))
        return np.mean(moved**2, axis=0)

    def at(self, z: np.ndarray) -> ThetaStep:
        """What the sample says about z at a value, with the noise of the residuals there."""
        return self._known(self.alone(z, self.noise_at(z)))

    def noise_at(self, z: np.ndarray) -> np.ndarray:
        """The mean squared residuals (o,) at a value of z, with weights for noise as large as the targets."""
        squares = np.mean(self.targets**2, axis=0)
        return self.residual_variance(self._known(self.alone(z, np.where(squares > 0.0, squares, 1.0))))

    def starts(self, seed: int) -> list[ThetaStep]:
        """Different optima of the features alone, the best one first."""
        q = len(self.theta)
        n_tried = int(np.ceil(np.log2(min(_TRIED * q, _MOST_TRIED))))
        tried = ndtri(qmc.Sobol(q, seed=seed).random_base2(n_tried))
        noise = self.noise_at(np.zeros(q))
        optima = [self.improved(np.zeros(q), noise)]
        values = [self.value_alone(z, noise) for z in tried]
        best = [tried[i] for i in np.argsort(values)[::-1][:_IMPROVED] if np.isfinite(values[i])]
        optima += [self.improved(z, noise) for z in best]
        # Minus twice the log evidence with the noise variance of the residuals.
        loss = [len(self.targets) * float(np.log(variance).sum()) + float(step.z @ step.z) for step, variance in optima]
        distinct: list[ThetaStep] = []
        for step, variance in (optima[i] for i in np.argsort(loss)):
            as_good = (variance <= _AS_GOOD**2 * optima[int(np.argmin(loss))][1]).all()
            if as_good and all(np.abs(step.z - other.z).max() > _APART for other in distinct):
                distinct.append(step)
        return distinct[:_STARTS]

    def improved(self, z: np.ndarray, noise: np.ndarray) -> tuple[ThetaStep, np.ndarray]:
        """An optimum of the features alone from z, and the mean squared residuals (o,) there."""
        step = self._known(self.alone(z, noise))
        for _ in range(_TURNS):
            step = climbed(step, self._with_noise(noise))
            noise = self.residual_variance(step)
            step = self._known(self.alone(step.z, noise))
        return step, noise

    def _known(self, step: ThetaStep | None) -> ThetaStep:
        if step is None:
            raise ValueError(
                f"The features or their derivatives in the parameters {list(self.theta.names)} are NaN or infinite at "
                "values at which they were tried. Give the parameters narrower priors. The same rows must also always "
                "have the same features."
            )
        return step

    def _with_noise(self, noise: np.ndarray) -> StepAt:
        return lambda z, before: self.alone(z, noise)

    # --- with a Gaussian process --------------------------------------------------------------------------------------

    def finished(self, step: ThetaStep, data: Dataset, fitted: Fitted) -> Fitted:
        """A fit with the features and the prior at a value of z."""
        prior = replace(restricted(fitted.prior, self.p), reference=step.reference)
        return fitted.moved(data.source, extended(prior, step))

    def problem_at(self, step: ThetaStep, data: Dataset) -> Problem:
        """The problem with the features linearised at a value of z."""
        return self.problem.with_features(data, extended(self.prior, step))

    def step_at(self, fitted: Fitted, z: np.ndarray, before: ThetaStep) -> ThetaStep | None:
        """What the data say about z under the kernel and noise of a fit. None: the features are not finite."""
        try:
            data = self.data_at(z)
        except ValueError:
            return None
        prior = replace(restricted(fitted.prior, self.p), reference=before.reference)
        likelihoods = fitted.weight_likelihoods(data.source, extended(prior, before))
        return theta_step(likelihoods, prior, self.columns, z)

    def settled(self, step: ThetaStep, fitted: Fitted) -> ThetaStep:
        """The mode of z under the kernel and noise of a fit."""
        here = self._known(self.step_at(fitted, step.z, step))
        return climbed(here, partial(self.step_at, fitted))

    def bend(self, step: ThetaStep, fitted: Fitted) -> np.ndarray | None:
        """The inverse of A (q, q), below, if f is orthogonal to the features. None: it is the identity."""
        # z is then that of the best fit in least squares, where the gradient s(z) = σ⁻² Jᵀ (y - h(z)) - z is 0. The
        # residuals contain f and may be large, so that Gauss and Newton's s' = -Λ is not good enough. As Var[s] is Λ to
        # first order, the covariance is (s')⁻¹ Λ (s')⁻ᵀ = R A⁻¹ A⁻ᵀ R with R = Λ^(-1/2) and A = -R s' R (White 1982).
        R, columns = step.deviation().root, []
        for direction in R:
            ends = [self.step_at(fitted, step.z + sign * _DIFFERENCE * direction, step) for sign in (1.0, -1.0)]
            if ends[0] is None or ends[1] is None:
                return None
            forward, back = (end.gradient.sum(axis=0) - end.z for end in ends if end is not None)
            columns.append(R @ (back - forward) / (2.0 * _DIFFERENCE))
        A = np.array(columns).T
        if np.linalg.svd(A, compute_uv=False).min() < _FLAT:
            return None
        # No direction is less certain than in the prior, where the formula is not valid.
        U, widths, V = np.linalg.svd(R @ np.linalg.inv(A))
        return np.linalg.solve(R, U * np.minimum(widths, 1.0) @ V)


def climbed(step: ThetaStep, step_at: StepAt) -> ThetaStep:
    """Newton steps of z. Each is shortened until it raises log p(y, z), or is followed by a much shorter one."""
    for _ in range(_STEPS):
        move = step.newton()
        length, share = _length(move, step), min(1.0, _LONGEST / max(np.abs(move).max(), np.finfo(float).tiny))
        if length < _SETTLED:
            break
        for _ in range(_HALVINGS):
            trial = step_at(step.z + share * move, step)
            if trial is not None and (trial.value > step.value or _length(trial.newton(), trial) < 0.5 * length):
                break
            share /= 2.0
        else:
            break
        assert trial is not None
        step = trial
    return step


def _length(move: np.ndarray, step: ThetaStep) -> float:
    """The largest component of a step, in posterior standard deviations."""
    return float(np.max(np.abs(move) / step.deviation().std))


def _values_or_nan(function: Callable[[Any], Any], rows: Any) -> np.ndarray:
    """What a map returns, or NaN if it raises a ValueError for numbers that are not finite."""
    try:
        with np.errstate(all="ignore"):
            return np.asarray(function(rows), dtype=np.float64)
    except ValueError:
        return np.full((1, 1), np.nan)


def _sample(data: Dataset, size: int) -> tuple[Any, np.ndarray]:
    """Up to ``size`` rows of X for the feature map, and their targets (k, o)."""
    if is_dask(data.X):
        chosen = evenly_spaced(len(data.X), size)
        X, y = data.X[chosen].compute(), data.y[chosen].compute()
    else:
        positions = data.chosen.positions
        chosen = evenly_spaced(data.chosen.n_rows, size)
        chosen = chosen if positions is None else positions[chosen]
        X, y = take_rows(data.given, chosen), data.y[chosen]
    return X, np.asarray(y, dtype=np.float64).reshape(len(y), -1)


def calibrate(
    data: Dataset,
    problem: Problem,
    fit: FitProblem,
    rng: np.random.RandomState,
    monitor: Monitor,
    previous: tuple[Fitted | None, ThetaPosterior | None] = (None, None),
) -> Calibration | None:
    """Fit a problem whose feature map has parameters, or return None if it has none.

    ``problem`` is that of the prior medians. The prior of the weights is found there. If the parameters are those of
    ``previous``, a fit and its posterior, the fit continues that one.
    """
    if data.maps.kernel_map is not None and (of_kernel := Theta.of(data.maps.kernel_map)) is not None:
        raise ValueError(f"Only a feature_map may have parameters; those of kernel_map are {list(of_kernel.names)}.")
    theta = None if data.maps.feature_map is None else Theta.of(data.maps.feature_map)
    if theta is None:
        return None
    solver, noise = problem.solver, problem.noise
    if solver.stochastic or problem.variant.family == "diagonal" or noise.heavy_tails or noise.inputs is not None:
        raise ValueError(
            f"A feature map with parameters ({', '.join(theta.names)}) needs {solvers_of_all_rows()} with "
            f'posterior="full", and Gaussian noise of y only; got solver={solver!r} and noise={noise!r}.'
        )
    # θ has one posterior, given one kernel.
    calibrator = _Calibrator(data, replace(problem, averages=False), theta)
    fitted, before = previous
    seed, goes_on = rng.randint(np.iinfo(np.int32).max), False
    if before is not None and before.theta.names == theta.names:
        goes_on, starts = True, [calibrator.at(before.z_under(theta.priors))]
    else:
        fitted, starts = None, calibrator.starts(seed)
    step, best = starts[0], -np.inf
    for number, start in enumerate(starts if len(starts) > 1 else (), start=1):
        rough = fit(
            calibrator.problem_at(start, calibrator.data_at(start.z)), None, True, f"parameters, start {number}"
        )
        if monitor.stopped or monitor.out_of_time:
            break
        start = calibrator.settled(start, rough)
        bound = calibrator.finished(start, calibrator.data_at(start.z), rough).lower_bound
        bound -= 0.0 if calibrator.together else start.counted_twice()
        if bound > best:
            best, step, fitted = bound, start, rough
    # Without a fit of the noise, the optimum of the features alone is better than a step under a first guess.
    noise_known = goes_on or problem.max_iter > 0 or problem.spec.starts.noise.value is not None
    trusted = True
    for number in range(1, _FITS + 1):
        at_start = step
        problem = calibrator.problem_at(step, calibrator.data_at(step.z))
        fitted = fit(problem, fitted, False, f"parameters, fit {number}")
        ended = monitor.stopped or monitor.out_of_time
        trusted = noise_known and not ended
        if trusted:
            step = calibrator.settled(step, fitted)
        ended = ended or problem.max_iter == 0
        if ended or (calibrator.nonlinearity(at_start, step) < _NONLINEAR**2 * fitted.predictor().noise).all():
            break
    assert fitted is not None
    at_mode = calibrator.data_at(step.z)
    theta_at_mode = Theta.of(at_mode.maps.feature_map.feature_map)
    assert theta_at_mode is not None
    bend = calibrator.bend(step, fitted) if problem.variant.orthogonal and trusted else None
    posterior = ThetaPosterior.of(theta_at_mode, step, calibrator.together, bend)
    if not trusted or _length(step.newton(), step) > _MOVED:
        posterior = replace(posterior, mean=step.z)
    return Calibration(at_mode, problem, calibrator.finished(step, at_mode, fitted), posterior)


def rough_tol(problem: Problem) -> float:
    """The tolerance, in nats, of fits that only choose between starts."""
    return _ROUGH_TOL * problem.source.n_rows * problem.n_outputs


def after_more_rows(
    posterior: ThetaPosterior, linearized: LinearizedFeatures, fitted: Fitted
) -> tuple[ThetaPosterior, Fitted]:
    """The posterior of z, and the models, after new rows. The features stay linearised where they are."""
    p = fitted.prior.scale.shape[1] - len(linearized.columns)
    prior = restricted(fitted.prior, p)
    z = posterior.theta.coordinates()
    step = theta_step(fitted.weight_likelihoods(), prior, linearized.columns, z)
    together = prior.shared or fitted.models[0].posterior.sparse.variant.orthogonal
    updated = ThetaPosterior.of(posterior.theta, step, together, posterior.bend)
    return updated, fitted.reweighted(extended(prior, step))
