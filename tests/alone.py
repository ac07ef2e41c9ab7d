"""The bound of features and noise alone: what no fit that has ended may stay below.

With q(f) at its prior the bound costs no KL divergence, and is the likelihood of the Bayesian linear model y ~ N(Hμ,
HΣHᵀ + σ²I) less Σ k(x, x) / 2σ². That holds for any σ² within the noise's limits and for the signal variance at its
lower limit, so that the greatest such number is one that a fit to the same rows can reach: nothing is assumed of how
much there is to learn. (For posterior="diagonal" q(f) cannot be at its prior.)
"""

import numpy as np
from sklearn.base import clone

from skevgp import EGPRegressor

_JITTER = 1e-11


def lowest_signal_and_noise(model):
    """Of each output, in the user's units: the lower limit of s² and limits of σ², or what they are fixed at."""
    fitted, unit = model._fitted, model._fitted.units.target_unit**2
    models = [(list(range(len(unit))), fitted)] if isinstance(model, EGPRegressor) else None
    models = models or zip(fitted.outputs, fitted.models, strict=True)
    found = {}
    for outputs, one in models:
        for within, output in enumerate(outputs):
            limits = []
            for name in ("signal", "noise"):
                parameter = one.table[name]
                low, high = parameter.value_limits()[within]
                free, start = (
                    np.broadcast_to(v, parameter.start.shape)[within] for v in (parameter.free, parameter.start)
                )
                limits.append((low * unit[output], high * unit[output]) if free else (start * unit[output],) * 2)
            found[output] = limits[0][0], limits[1]
    return [found[output] for output in range(len(unit))]


def alone(model, X, y, sample_weight=None, relative_variance=None):
    """That bound of a fitted `EVGPRegressor` or `EGPRegressor`, in nats, summed over outputs."""
    y = np.asarray(y, dtype=float).reshape(len(y), -1)
    n, o = y.shape
    weight = np.ones(n) if sample_weight is None else np.asarray(sample_weight, dtype=float)
    variance = np.ones(n) if relative_variance is None else np.asarray(relative_variance, dtype=float)
    X = X if hasattr(X, "columns") else np.asarray(X, dtype=float)
    inputs = np.asarray(X if model.kernel_map_ is None else model.kernel_map_.transform(X), dtype=float)
    predictor, prior, total = model._posterior.predictor, model._fitted.units.prior, 0.0
    kernels = [model.kernel_] if o == 1 else model.kernel_
    H = np.zeros((n, 0))
    if model.feature_map_ is not None:
        H = model.feature_map_.transform(X)
        H = np.asarray(H.toarray() if hasattr(H, "toarray") else H, dtype=float)
    for output, (signal, limits) in enumerate(lowest_signal_and_noise(model)):
        diagonal = signal / predictor.signal[output] * clone(kernels[output]).diag(inputs)
        rest = y[:, output] - model._fitted.units.target_mean[output] - H @ prior.mean[output]
        scaled = H * prior.scale[output]
        total += _best(scaled, rest, diagonal, weight, variance, limits)
    return total


def _best(H, rest, diagonal, weight, variance, limits):
    """The greatest over σ² of log ∫ Π N(restᵢ | hᵢᵀw, σ²vᵢ)^ωᵢ N(w | 0, I) dw - Σ ωᵢ k(xᵢ, xᵢ) / 2σ²vᵢ."""
    root = np.sqrt(weight / variance)
    some = weight > 0
    H, rest, diagonal, weight, variance, root = (v[some] for v in (H, rest, diagonal, weight, variance, root))
    G, r = H * root[:, np.newaxis], rest * root
    U, s, Vt = np.linalg.svd(G, full_matrices=False)
    inside = U.T @ r
    outside = r - U @ inside
    outside -= U @ (U.T @ outside)
    # A direction in which the features hardly vary, sums of their products do not see.
    hidden = _JITTER * np.max(s, initial=0.0) ** 2
    seen = np.where(s**2 > hidden, s**2, 0.0)
    # Nor do they tell from 0 what is so little beside the targets, or beside what features that cancel add up to.
    explained = np.abs(G) @ np.abs(Vt.T @ np.divide(inside, s, where=seen > 0.0, out=np.zeros(len(s))))
    floor = (1e-10 * max(np.abs(r).max(initial=0.0), explained.max(initial=0.0))) ** 2 / max(weight.sum(), 1.0)
    low, high = max(limits[0], floor), max(limits[1], floor)
    if limits[1] < floor:
        return -np.inf
    low = max(low, 1e-290)
    sigma2 = np.geomspace(low, max(high, low), 2000)[:, np.newaxis]
    squares = ((inside**2) / (1.0 + seen / sigma2)).sum(axis=1) + outside @ outside
    trace = (weight / variance * diagonal).sum()
    # Of features that depend on each other: a direction in which they do not vary has the precision 1 of the prior,
    # which sums of products of the others, and the jitter of their Cholesky factor, hide.
    logs = np.log1p((s**2 + hidden) / sigma2).sum(axis=1) + (H.shape[1] - len(s)) * np.log1p(hidden / sigma2[:, 0])
    logs += weight.sum() * np.log(2 * np.pi * sigma2[:, 0])
    value = -0.5 * (logs + (weight * np.log(variance)).sum() + (squares + trace) / sigma2[:, 0])
    return float(value.max())
