"""Data and models of all kinds, drawn by hypothesis; what does not matter is drawn as small and simple as can be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sklearn.base import clone
from sklearn.gaussian_process import kernels as sk
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, PolynomialFeatures, StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.features import InertiaForceGravity
from skevgp.kernels import Cosine
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam


def fewer(by):
    """Settings of a test that takes long."""
    return settings(max_examples=max(settings.default.max_examples // by, 3))


@dataclass(frozen=True)
class Case:
    """A model before its fit, rows that it is to see, and rows to be predicted."""

    model: Any
    X: np.ndarray
    Y: np.ndarray
    X_new: np.ndarray

    def fitted(self, X: Any = None, Y: Any = None, **others: Any) -> Any:
        """To these rows or others, with further arguments of ``fit``."""
        return clone(self.model).fit(self.X if X is None else X, self.Y if Y is None else Y, **others)

    def with_model(self, **parameters: Any) -> Case:
        return replace(self, model=clone(self.model).set_params(**parameters))


# --- Rows. Quarters have ties, copies and constant columns; numbers of a seed have none.


def quarters(shape, most=8):
    return arrays(np.float64, shape, elements=st.integers(-most, most).map(lambda number: number / 4.0))


def scattered(shape):
    return st.integers(0, 10_000).map(lambda seed: np.random.RandomState(seed).uniform(-2.0, 2.0, shape))


def tables(n_rows, n_columns):
    return st.one_of(quarters((n_rows, n_columns)), scattered((n_rows, n_columns)))


def waves(X, n_outputs):
    """Targets that a model can learn from, and with some noise."""

    def of(seed):
        rng = np.random.RandomState(seed)
        return np.sin(2.0 * X @ rng.randn(X.shape[1], n_outputs)) + 0.1 * rng.randn(len(X), n_outputs)

    return st.integers(0, 10_000).map(of)


@st.composite
def data(draw, most_rows=24, most_columns=3, most_outputs=3, fewest_rows=1):
    """X, Y and new rows: some far off, and one of those that were seen."""
    n, d = draw(st.integers(fewest_rows, most_rows)), draw(st.integers(1, most_columns))
    o = draw(st.integers(1, most_outputs))
    X = draw(tables(n, d))
    Y = draw(st.one_of(waves(X, o), quarters((n, o))))
    new = draw(tables(draw(st.integers(1, 6)), d))
    return X, Y, np.vstack([new, 3.0 * new[:1], X[:1]])


# --- Kernels.

LENGTHS = st.sampled_from([1.0, 0.5, 2.0, 0.2, 10.0])


def _stationary(d):
    lengths = st.one_of(LENGTHS, st.lists(LENGTHS, min_size=d, max_size=d))
    rough = st.sampled_from([2.5, 1.5, np.inf, 0.5, 2.2])
    return [
        st.builds(sk.RBF, lengths),
        st.builds(lambda length, nu: sk.Matern(length, nu=nu), lengths, rough),
        st.builds(sk.RationalQuadratic, LENGTHS, LENGTHS),
    ]


def kernels(d, smooth=False):
    """Of d columns; smooth ones have waves that are long beside the steps of differences."""
    lengths = st.sampled_from([1.0, 2.0, 4.0]) if smooth else LENGTHS
    leaves = [*_stationary(d), st.builds(sk.DotProduct, lengths)]
    leaves += [st.builds(Cosine, st.lists(lengths, min_size=d, max_size=d))] if d > 1 else []
    leaves += [st.builds(sk.ExpSineSquared, lengths, lengths)] if d == 1 else []
    if smooth:
        leaves[1] = st.builds(lambda length: sk.Matern(length, nu=2.5), lengths)
    leaf = st.one_of(leaves)
    pairs = st.one_of(st.builds(sk.Sum, leaf, leaf), st.builds(sk.Product, leaf, leaf))
    signals = st.sampled_from([1.0, 4.0, 0.01])
    signal = signals.map(lambda value: sk.ConstantKernel(value, "fixed"))
    return st.builds(sk.Product, signal, st.one_of(leaf, pairs))


# --- Maps of X.


def own_columns(X):
    """Of each of three outputs other columns."""
    X = np.asarray(X)
    return np.stack([X, X[:, ::-1], X * X], axis=1)


def own_features(X):
    X = np.asarray(X)
    return np.stack([X[:, [0]], np.sin(X[:, [0]]), X[:, [-1]]], axis=1)


FEATURES = [
    None,
    PolynomialFeatures(1),
    PolynomialFeatures(2),
    InertiaForceGravity(),
    make_pipeline(StandardScaler(), PolynomialFeatures(1)),
    FunctionTransformer(np.tanh),
]
KERNEL_MAPS = [None, StandardScaler(), MinMaxScaler(), FunctionTransformer(np.tanh)]


@st.composite
def maps(draw, n_outputs, known=False):
    """A feature map and a kernel map, either perhaps with a row for each output; known are those that can be saved."""
    if known:
        features, inputs = ([one for one in all_ if not is_function(one)] for all_ in (FEATURES, KERNEL_MAPS))
        return {"feature_map": draw(st.sampled_from(features)), "kernel_map": draw(st.sampled_from(inputs))}
    own = n_outputs == 3
    features = [*FEATURES, FunctionTransformer(own_features)] if own else FEATURES
    inputs = [*KERNEL_MAPS, FunctionTransformer(own_columns)] if own else KERNEL_MAPS
    return {"feature_map": draw(st.sampled_from(features)), "kernel_map": draw(st.sampled_from(inputs))}


# Maps that are the same whatever rows they are fitted to.
STATELESS = st.fixed_dictionaries(
    {
        "feature_map": st.sampled_from([None, PolynomialFeatures(1), PolynomialFeatures(2)]),
        "kernel_map": st.sampled_from([None, FunctionTransformer(np.tanh)]),
    }
)


# --- What outputs share.


@st.composite
def sharings(draw, n_outputs, per_output=False):
    groups = draw(st.permutations(range(n_outputs)))
    cut = draw(st.integers(0, n_outputs))
    partition = [list(part) for part in (groups[:cut], groups[cut:]) if part]
    named = ["none", "kernel"] if per_output else ["all", "kernel", "none", partition]
    return draw(st.sampled_from(named))


# --- Models.


BOUNDS = st.sampled_from(["titsias", "tight"])
NOISES = st.sampled_from([0.1, 1.0, 0.001])


@st.composite
def fixed_models(draw, X, n_outputs, *, exact=None, smooth=False, known_maps=False, given_maps=None):
    """Models whose kernel, noise, inducing points and prior are given: a fit is a formula.

    A scale of 0 keeps a weight at its mean. ``exact`` says whether they are the exact model; None: some are.
    """
    d, given = X.shape[1], draw(maps(n_outputs, known_maps) if given_maps is None else given_maps)
    kernel = draw(kernels(d, smooth)) + sk.WhiteKernel(draw(NOISES), "fixed")
    parameters = {**given, "kernel": kernel, "max_iter": 0, "random_state": 0}
    mean, scale = draw(st.sampled_from([0.0, 0.5])), draw(st.sampled_from([1.0, 0.1, 3.0, 0.0]))
    share = given["feature_map"] is not None and n_outputs > 1 and draw(st.booleans())
    parameters["coef_prior"] = CoefPrior(mean, scale, shared=share)
    parameters["normalize_y"] = draw(st.booleans())
    if draw(st.integers(0, 3)) == 3 if exact is None else exact:
        return EGPRegressor(**parameters)
    parameters["sharing"] = draw(sharings(n_outputs, has_rows_of_outputs(given)))
    posterior = "full" if share else draw(st.sampled_from(["full", "diagonal"]))
    parameters["solver"] = LBFGS(posterior=posterior, bound=draw(BOUNDS))
    parameters["inducing_init"] = draw(points(X))
    parameters["n_inducing"] = 6
    return EVGPRegressor(**parameters)


def is_function(transformer):
    return isinstance(transformer, FunctionTransformer)


def has_rows_of_outputs(maps):
    return any(getattr(one, "func", None) in (own_columns, own_features) for one in maps.values())


@st.composite
def points(draw, X):
    """Inducing points: chosen by the model, or given, copies among them."""
    if draw(st.booleans()):
        return draw(st.sampled_from(["k-means", "greedy"]))
    return draw(tables(draw(st.integers(1, 8)), X.shape[1]))


@st.composite
def fixed_cases(draw, most_outputs=3, fewest_rows=1, **options):
    X, Y, X_new = draw(data(most_outputs=most_outputs, fewest_rows=fewest_rows))
    return Case(draw(fixed_models(X, Y.shape[1], **options)), X, one_or_more(draw, Y), X_new)


def one_or_more(draw, Y):
    """One output with or without an axis."""
    return Y[:, 0] if Y.shape[1] == 1 and draw(st.booleans()) else Y


@st.composite
def learned_cases(draw, most_outputs=3, known_maps=False, given_maps=None):
    X, Y, X_new = draw(data(most_rows=30, most_outputs=most_outputs))
    return Case(draw(learned_models(X, Y.shape[1], known_maps, given_maps)), X, Y, X_new)


@st.composite
def learned_models(draw, X, o, known_maps=False, given_maps=None):
    """Models that learn kernel, noise and inducing points.

    The fewest iterations with which fits and noise scales of Student-t noise alternate are three.
    """
    given = draw(maps(o, known_maps) if given_maps is None else given_maps)
    kernel = draw(st.one_of(st.none(), kernels(X.shape[1])))
    parameters = {**given, "kernel": kernel, "normalize_y": draw(st.booleans()), "random_state": 0}
    if draw(st.integers(0, 4)) == 4:
        return EGPRegressor(**parameters, max_iter=3)
    own = has_rows_of_outputs(given)
    parameters |= {"sharing": draw(sharings(o, own)), "n_inducing": draw(st.sampled_from([1, 5, 40]))}
    posterior = draw(st.sampled_from(["full", "diagonal"]))
    bound = draw(BOUNDS)
    parameters["solver"] = LBFGS(posterior=posterior, bound=bound)
    parameters["inducing_init"] = draw(st.sampled_from(["auto", "k-means", "greedy"]))
    kind = draw(st.sampled_from(["lbfgs", "student-t", "input noise", "adam", "natural", "restarts"]))
    if own and kind in ("adam", "natural"):
        parameters["sharing"] = "none"
    if kind == "student-t":
        parameters["noise"] = "student-t"
    elif kind == "input noise":
        parameters["noise"] = Gaussian(inputs=0.1)
    elif kind == "adam":
        parameters["solver"] = Adam(batch_size=10, posterior=posterior, bound=bound)
    elif kind == "natural":
        parameters["solver"] = Adam(batch_size=10, natural_gradient=True, bound=bound)
    elif kind == "restarts":
        parameters["solver"] = LBFGS(n_restarts=1, posterior=posterior, bound=bound)
    return EVGPRegressor(**parameters, max_iter=3)


# --- What is compared.


def columns_of(values):
    """With an axis of outputs."""
    return values.reshape(len(values), -1)


def size_of(model, case):
    """Of numbers around: targets, and what the prior of the weights and the kernel would make of the new rows.

    Rounding is measured in it, for errors of a cancellation are those of its terms.
    """
    kernels = model.kernel_ if isinstance(model.kernel_, list) else [model.kernel_]
    inputs = case.X_new if model.kernel_map_ is None else np.asarray(model.kernel_map_.transform(case.X_new))
    inputs = inputs if inputs.ndim == 2 else inputs.reshape(-1, inputs.shape[-1])
    signal = max(np.sqrt(kernel.diag(inputs)).max() for kernel in kernels)
    weights = 0.0
    if model.feature_map_ is not None:
        H = np.abs(np.asarray(model.feature_map_.transform(case.X_new)))
        weights = H.max() * np.abs(model.coef_prior_scale_).sum() + H.max() * np.abs(model.coef_).sum()
    return float(max(np.abs(case.Y).max(), signal, weights, np.sqrt(np.max(model.noise_variance_))))


def assert_near(found, expected, size, rtol=1e-8):
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=rtol * size)


def assert_same_predictions(one, other, X, size, rtol=1e-8):
    """Mean, std with and without noise."""
    for include_noise in (True, False):
        asked = {"return_std": True, "include_noise": include_noise}
        (mean, std), (other_mean, other_std) = one.predict(X, **asked), other.predict(X, **asked)
        assert_near(mean, other_mean, size, rtol)
        # Of a variance that cancels, half of the digits are left.
        assert_near(std**2, other_std**2, size**2, rtol)


def assert_same_bits(one, other, X):
    for found, expected in zip(one.predict(X, return_std=True), other.predict(X, return_std=True), strict=True):
        np.testing.assert_array_equal(found, expected)
