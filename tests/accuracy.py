"""Small problems of a given signal-to-noise ratio and condition of k(X_m, X_m), and how far the library is off."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import FunctionTransformer

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.model.bounds import LOG_2PI, bounds_at_optimum
from skevgp.model.objectives import ElboObjective, ElboTerms, evaluate
from skevgp.solvers import LBFGS

from .oracle import at_the_fit
from .precise import PreciseModel, cholesky, condition, solved, squared_exponential

COEF_MEAN, COEF_SCALE = 0.5, 2.0


@dataclass(frozen=True)
class Features:
    """x -> its first columns, then ones: p of them."""

    p: int

    def __call__(self, X):
        return np.hstack([X, np.ones((len(X), self.p))])[:, : self.p]


@dataclass(frozen=True)
class Problem:
    """Rows drawn from a sparse model with signal variance 1."""

    X: np.ndarray
    y: np.ndarray
    points: np.ndarray
    X_new: np.ndarray
    lengthscale: float
    noise: float
    p: int

    @classmethod
    def drawn(cls, ratio, wanted, n=20, m=8, d=2, p=2, seed=0):
        """With a signal-to-noise ratio (of variances), and K of about the wanted condition; points are rows or not."""
        rng = np.random.RandomState(seed)
        X, X_new = rng.uniform(-1.0, 1.0, (n, d)), rng.uniform(-1.2, 1.2, (8, d))
        points = rng.uniform(-1.0, 1.0, (m, d)) if seed % 2 else X[:m].copy()
        lengthscale, noise = lengthscale_of(points, wanted), 1.0 / ratio
        L = cholesky(squared_exponential(points, points, [lengthscale]))
        V = solved(L, squared_exponential(points, X, [lengthscale])).astype(float)
        y = V.T @ rng.randn(m) + Features(p)(X) @ rng.randn(p) + np.sqrt(noise) * rng.randn(n)
        return cls(X, y, points, X_new, lengthscale, noise, p)

    @property
    def arguments(self):
        """Of both regressors; nothing is fitted."""
        kernel = ConstantKernel(1.0, "fixed") * RBF(np.full(self.X.shape[1], self.lengthscale), "fixed")
        return {
            "feature_map": FunctionTransformer(Features(self.p)) if self.p else None,
            "kernel": kernel + WhiteKernel(self.noise, "fixed"),
            "coef_prior": CoefPrior(mean=COEF_MEAN, scale=COEF_SCALE),
            "max_iter": 0,
        }

    @property
    def features_new(self):
        return Features(self.p)(self.X_new)

    def precise(self, **others):
        return PreciseModel(
            np.full(self.X.shape[1], self.lengthscale),
            1.0,
            self.noise,
            self.points,
            self.X,
            Features(self.p)(self.X),
            self.y,
            np.full(self.p, COEF_MEAN),
            np.full(self.p, COEF_SCALE),
            **others,
        )


def lengthscale_of(points, wanted):
    """Three digits of it."""
    low, high = 0.05, 5000.0
    for _ in range(12):
        middle = np.sqrt(low * high)
        if condition(squared_exponential(points, points, [middle])) < wanted:
            low = middle
        else:
            high = middle
    return float(f"{low:.3g}")


def sparse(problem, posterior="full", added=0):
    """The last so many rows by `partial_fit`."""
    first = len(problem.y) - added
    model = EVGPRegressor(inducing_init=problem.points, solver=LBFGS(posterior=posterior), **problem.arguments)
    model.fit(problem.X[:first], problem.y[:first])
    return model.partial_fit(problem.X[first:], problem.y[first:]) if added else model


def jitter_of(model):
    """What the fit says that it added: a power of ten."""
    (fitted,) = model._fitted.models
    (whitening,) = fitted.sparse.whitenings(fitted.values)
    added = whitening.jitter()
    return 10.0 ** np.round(np.log10(added)) if added else 0.0


def in_order(gradient, names=("hyperparameters", "signal", "noise", "inducing_points")):
    return np.concatenate([np.ravel(gradient[name]) for name in names])


@dataclass(frozen=True)
class Figures:
    """What a model says: of the library, or precisely."""

    bound: object
    gradient: np.ndarray | None
    mean: np.ndarray
    variance: np.ndarray

    def errors(self, of, noise, largest):
        """Of other figures, relative to these; the mean's to the largest |y|, the gradient's to its largest entry."""
        found = {
            "bound": abs(of.bound - self.bound) / abs(self.bound),
            "mean": abs(of.mean - self.mean).max() / largest,
            "variance": (abs(of.variance - self.variance) / (self.variance + noise)).max(),
            "latent variance": (abs(of.variance - self.variance) / self.variance).max(),
        }
        if self.gradient is not None and of.gradient is not None:
            found["gradient"] = abs(of.gradient - self.gradient).max() / abs(self.gradient).max()
        return {name: float(error) for name, error in found.items()}


class Collapsed:
    """EVGPRegressor with q at its optimum; with ``added`` rows of them by `partial_fit`."""

    def __init__(self, problem, family="full", added=0):
        self.problem, self.family, self.added = problem, family, added
        self.model = sparse(problem, family, added)
        self.precise = problem.precise(jitter=jitter_of(self.model))

    def found(self):
        mean, std = self.model.predict(self.problem.X_new, return_std=True, include_noise=False)
        gradient = None
        if not self.added:
            fitted, blocks = at_the_fit(self.model, self.problem.X, self.problem.y)
            gradient = in_order(evaluate(fitted.sparse, fitted.values, blocks, bounds_at_optimum)[1])
        return Figures(self.model.lower_bound_, gradient, mean, std**2)

    def figures(self, precise, gradient=True):
        rows, full = (self.problem.X_new, self.problem.features_new), self.family == "full"
        mean, variance = precise.predict(*rows)
        return Figures(
            self._bound(precise),
            precise.gradient(self._bound) if gradient and not self.added else None,
            mean,
            variance if full else precise.diagonal_variance(*rows),
        )

    def _bound(self, precise):
        return precise.bound if self.family == "full" else precise.diagonal_bound


class Uncollapsed(Collapsed):
    """The loss of mini-batches, on all rows, for a joint Gaussian q of which the optimum is a likely draw."""

    def __init__(self, problem):
        super().__init__(problem)
        self.fitted, self.blocks = at_the_fit(self.model, problem.X, problem.y)
        self.elbo = ElboObjective(self.fitted.sparse, self.fitted.table, self.blocks)
        values, rng = self.elbo.table.values_at_start(), np.random.RandomState(0)
        (root,) = self.elbo.family.roots(values, [])
        moved = {"mean": values["mean"] + rng.randn(len(root)) @ root}
        moved["spread"] = values["spread"] + 0.1 * rng.randn(*values["spread"].shape)
        self.values = values | moved
        (self.root,) = self.elbo.family.roots(self.values, [])

    def found(self):
        fitted, values, units = self.fitted, self.values, self.model._fitted.units
        terms_of = lambda groups: [ElboTerms(self.elbo, values, group) for group in groups]  # noqa: E731
        loss, gradient = evaluate(fitted.sparse, values, self.blocks, terms_of)
        n, whitenings = len(self.problem.y), list(fitted.sparse.whitenings(values))
        # The loss leaves out what all outputs have in common; and residuals have a unit.
        loss += 0.5 * n * (LOG_2PI + np.log(values["noise"][0])) + n * np.log(units.target_unit[0])
        by_q = fitted.sparse.predictor(values, whitenings, self.elbo.family.means(values), [self.root])
        predictor = units.predictor([by_q], [[0]])
        mean, variance = predictor.predict(self.problem.X_new, self.problem.features_new, return_variance=True)
        return Figures(-loss, -in_order(gradient), mean[:, 0], variance[:, 0])

    def figures(self, precise, gradient=True):
        # Of the weights themselves, not of what they differ by from the reference that residuals are taken from.
        mean = self.values["mean"][0].copy()
        mean[len(self.problem.points) :] += self.model._fitted.units.prior.reference[0]
        of = partial(PreciseModel.elbo, mean=mean, root=self.root)
        rows = self.problem.X_new, self.problem.features_new
        by_q = precise.predict_by(mean, self.root, *rows)
        return Figures(of(precise), precise.gradient(of) if gradient else None, *by_q)


class Exact:
    """EGPRegressor."""

    def __init__(self, problem):
        self.problem, self.precise = problem, problem.precise(exact=True)
        self.model = EGPRegressor(**problem.arguments).fit(problem.X, problem.y)

    def found(self):
        mean, std = self.model.predict(self.problem.X_new, return_std=True, include_noise=False)
        (fitted,) = self.model._fitted.models
        gradient = fitted.posterior.exact.log_likelihood(fitted.values)[1]
        gradient = in_order(gradient, ("hyperparameters", "signal", "noise"))
        return Figures(self.model.log_marginal_likelihood_value_, gradient, mean, std**2)

    def figures(self, precise, gradient=True):
        rows = self.problem.X_new, self.problem.features_new
        return Figures(precise.bound, precise.gradient() if gradient else None, *precise.predict(*rows))


MODELS = {
    "collapsed": Collapsed,
    "diagonal": partial(Collapsed, family="diagonal"),
    "given q": Uncollapsed,
    "partial_fit": partial(Collapsed, added=7),
    "exact": Exact,
}


def measure_of(model, gradient=True):
    """Relative errors of figures, as a function of them."""
    precisely = model.figures(model.precise, gradient)
    return partial(precisely.errors, noise=model.precise.noise, largest=np.abs(model.problem.y).max())


def errors(model, gradient=True, draws=1):
    """Relative errors of the library's figures; and the largest that come of a unit in the last place of doubles.

    Parameters
    ----------
    model : one of `MODELS`
    gradient : bool, default=True
        Whether they are of the gradient too, which takes most of the time.
    draws : int, default=1
        Of the others.

    Returns
    -------
    library, inputs, kernel : dict of float
        Of the library; of the precise model whose inputs are off by a unit; and whose values of the kernel are as well.
    """
    measure = measure_of(model, gradient)

    def largest(moved):
        each = [measure(model.figures(moved(seed), gradient)) for seed in range(draws)]
        return {name: max(one[name] for one in each) for name in each[0]}

    return measure(model.found()), largest(model.precise.nudged), largest(model.precise.rounded)
