"""Random fits: estimators and options, and data with several kinds of nastiness at once."""

import mmap
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import polars as pl
from scipy import sparse
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.gaussian_process.kernels import (
    RBF,
    ConstantKernel,
    DotProduct,
    ExpSineSquared,
    Matern,
    RationalQuadratic,
    WhiteKernel,
)
from sklearn.impute import SimpleImputer
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, SplineTransformer, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, RigidBodyRegressor
from skevgp.kernels import Cosine
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam


class MapError(Exception):
    """Of a user's own map: it must come through as it is."""


class BadMap(TransformerMixin, BaseEstimator):
    """A map that goes wrong in one way, when it is fitted or at some later call."""

    def __init__(self, how="raises", late=False):
        self.how = how
        self.late = late

    def fit(self, X, y=None):
        self.calls_ = 0
        return self

    def transform(self, X):
        X = np.asarray(X, dtype=float)
        self.calls_ += 1
        if self.late and self.calls_ == 1:
            return X
        if self.how == "raises":
            raise MapError("the sensor model is not defined here")
        if self.how == "rows":
            return X[:-1]
        if self.how == "width":
            return np.column_stack([X, X])[:, : X.shape[1] + 1]
        if self.how == "words":
            return np.full(X.shape, "a")
        return np.full(X.shape, {"nan": np.nan, "infinity": np.inf, "huge": 1e200}[self.how])

    # What each may be refused with.
    messages = {  # noqa: RUF012
        "raises": "the sensor model is not defined here",
        "rows": "one row per row of X",
        "width": "columns",
        "words": "must be real numbers",
        "nan": "NaN or infinity",
        "infinity": "NaN or infinity",
        "huge": "must not exceed",
    }


@dataclass
class Case:
    """A fit, and by which messages (regular expressions) it may be refused; ``must``: one must come, if ``late``
    perhaps when it predicts.
    """

    model: object
    X: object
    y: object
    rows: object
    fit: dict = field(default_factory=dict)
    more: tuple | None = None
    refusals: list = field(default_factory=list)
    must: bool = False
    late: bool = False
    names: list = field(default_factory=list)

    def refused(self, message, must=True):
        self.refusals.append(message)
        self.must = self.must or must


def pick(rng, *options):
    return options[rng.randint(len(options))]


def inputs(rng, names):
    """Columns (n, d): wild scales, offsets, constants, copies, outliers, equal rows."""
    n = int(pick(rng, 1, 2, 3, 5, 10, 20, 40, 60, 100, 150))
    d = int(pick(rng, 1, 1, 2, 3, 5))
    if rng.rand() < 0.03:
        n, d = min(n, 60), int(pick(rng, 30, 100, 500))
    names += [f"n={n}", f"d={d}"]

    def now(probability, name):
        drawn = rng.rand() < probability
        if drawn:
            names.append(name)
        return drawn

    X = rng.uniform(-2, 2, (n, d)) if now(0.3, "uniform") else rng.randn(n, d)
    if now(0.1, "path"):
        X = np.cumsum(X, axis=0) * 0.1
    if now(0.1, "sorted"):
        X = np.sort(X, axis=0)
    if now(0.1, "lattice"):
        X = np.round(X)
    if now(0.1, "outliers-in-X"):
        X[rng.randint(n)] *= 1e6
    if now(0.1, "nearly-collinear"):
        X[:, -1] = X[:, 0] + 1e-9 * rng.randn(n)
    if now(0.2, "scales"):
        X = X * 10.0 ** rng.uniform(-12, 12, d)
    if now(0.15, "constant-column"):
        X[:, 0] = pick(rng, 0.0, 3.0, 0.1, 1e8 + 0.1, -1e-12, 1e12)
    if now(0.1, "copied-column"):
        X[:, -1] = X[:, 0]
    if now(0.2, "equal-rows"):
        X = X[rng.randint(0, max(1, n // 3), n)]
    if now(0.15, "equal-up-to-rounding"):
        X = X[rng.randint(0, max(1, n // 2), n)] * (1.0 + 4e-16 * rng.choice([-1, 0, 1], (n, d)))
    if now(0.1, "offset"):
        X = X + 1e8
    if now(0.02, "tiny"):
        X = X * 1e-100
    if now(0.02, "vast"):
        X = X * 1e70
    if now(0.02, "denormal"):
        X = np.where(rng.rand(n, d) < 0.3, 5e-324, X)
    if now(0.05, "signed-zeros"):
        X = np.where(rng.rand(n, d) < 0.3, -0.0, X)
    return X


def targets(rng, X, o, names):
    """Targets (n, o): waves, lines, steps, constants, noise; with outliers, scales, offsets."""
    n, d = X.shape
    size = np.abs(X).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    spread = (X / size).std(axis=0) * size
    standard = (X - X.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    if not np.isfinite(standard).all():
        standard = np.zeros(X.shape)
    along = standard @ (rng.randn(d, o) / np.sqrt(d))
    kinds = {
        "wave": np.sin(2 * along),
        "fast-wave": np.sin(40 * along),
        "line": along,
        "zeros": np.zeros((n, o)),
        "constant": np.full((n, o), 5.1),
        "noise": rng.randn(n, o),
        "step": np.sign(along),
        "parabola": along**2,
        "line-and-1e-8-noise": along + 1e-8 * rng.randn(n, o),
        "heavy-tails": along + rng.standard_cauchy((n, o)),
        "one-row-differs": (np.arange(n) == 0)[:, np.newaxis] * np.ones((1, o)),
    }
    columns, name = [], ""
    for output in range(o):
        if output == 0 or rng.rand() < 0.5:
            name = pick(rng, *kinds)
        names.append(name)
        columns.append(kinds[name][:, output])
    Y = np.stack(columns, axis=1).astype(float)
    if rng.rand() < 0.3:
        names.append("noisy")
        Y = Y + 10.0 ** rng.uniform(-8, 0) * rng.randn(n, o)
    if rng.rand() < 0.1:
        names.append("outliers")
        Y[rng.randint(n)] += 10.0 ** rng.uniform(1, 8)
    if rng.rand() < 0.2:
        names.append("scaled-y")
        Y = Y * 10.0 ** rng.uniform(-12, 12, o)
    if rng.rand() < 0.02:
        names.append("extreme-y")
        Y = Y * 10.0 ** pick(rng, -120, 80)
    if rng.rand() < 0.1:
        names.append("offset-y")
        Y = Y + 1e8
    return Y


def kernel_of(rng, d):
    own = pick(rng, 1.0, np.ones(d)) if d <= 30 else 1.0
    with_noise = WhiteKernel(pick(rng, 1.0, 1e-6), pick(rng, "fixed", (1e-12, 1e3), (1e-5, 1e5)))
    base = pick(
        rng,
        RBF(own),
        RBF(1.0, "fixed"),
        RBF(own, (1e-3, 1e3)),
        Matern(own, nu=0.5),
        Matern(own, nu=1.5),
        Matern(own, nu=2.5),
        Matern(1.0, nu=2.2) if d < 3 else Matern(1.0, nu=2.5),
        RationalQuadratic(),
        DotProduct(),
        Cosine(own),
        Cosine(own) * RBF(own),
        RBF(own) + DotProduct(),
        RBF(own) * RationalQuadratic() + Matern(own, nu=1.5),
        (ExpSineSquared() if d == 1 else RBF(own)) * RBF(1.0),
        ConstantKernel(),
    )
    if rng.rand() < 0.4:
        base = ConstantKernel(pick(rng, 1.0, 100.0), pick(rng, "fixed", (1e-5, 1e5), (1e-12, 1e12))) * base
    return base + with_noise if rng.rand() < 0.3 else base


def feature_map_of(rng, n, d):
    if d > 30:
        return pick(rng, None, InertiaForce())
    return pick(
        rng,
        None,
        None,
        InertiaForce(),
        InertiaForceGravity(),
        PolynomialFeatures(1),
        PolynomialFeatures(2) if d < 6 else PolynomialFeatures(1),
        make_union(PolynomialFeatures(1), InertiaForce()),  # each column twice
        make_pipeline(StandardScaler(), PolynomialFeatures(1)),
        FunctionTransformer(lambda X: 0.0 * np.asarray(X, dtype=float)),
        FunctionTransformer(lambda X: np.tanh(np.asarray(X, dtype=float))),
        make_pipeline(StandardScaler(), SplineTransformer(4)) if n > 1 and d < 6 else None,
    )


def kernel_map_of(rng, d):
    return pick(
        rng,
        None,
        None,
        None,
        StandardScaler(),
        AngleEncoder(),
        FunctionTransformer(lambda X: np.asarray(X, dtype=float)[:, :1]),
        FunctionTransformer(lambda X: np.arctan(np.asarray(X, dtype=float))),
    )


def solver_of(rng, posterior):
    drawn = rng.rand()
    if drawn < 0.65:
        return LBFGS(posterior=posterior)
    if drawn < 0.75:
        return LBFGS(n_restarts=1, posterior=posterior)
    if drawn < 0.83:
        return Adam(posterior=posterior)
    natural = bool(posterior == "full" and rng.rand() < 0.6)
    return Adam(
        batch_size=int(pick(rng, 1, 7, 64, 1000)),
        learning_rate=pick(rng, 0.01, 0.1, 1.0),
        natural_gradient=natural,
        schedule=pick(rng, "cosine", "constant"),
        posterior=posterior,
    )


def share_of(rng, o):
    if o > 1 and rng.rand() < 0.2:
        return [[0], list(range(1, o))]
    return pick(rng, "auto", "all", "kernel", "none")


def of_gaussian_process(rng, n, d, o):
    """Options that the sparse and the exact model have in common."""
    options = {
        "feature_map": feature_map_of(rng, n, d),
        "kernel_map": kernel_map_of(rng, d),
        "normalize_y": bool(rng.rand() < 0.4),
        "random_state": int(rng.randint(100)),
    }
    if rng.rand() < 0.4:
        drawn = options["kernel_map"]
        options["kernel"] = kernel_of(rng, d if drawn is None else drawn.fit_transform(np.eye(2, d)).shape[1])
    elif rng.rand() < 0.1:
        options["noise"] = Gaussian(10.0 ** rng.uniform(-10, 2))
    if options["feature_map"] is not None and rng.rand() < 0.3:
        options["coef_prior"] = CoefPrior(scale=pick(rng, 0.0, 1e-8, 1.0, 1e8), mean=pick(rng, "auto", 0.0, 3.0))
    if options["feature_map"] is not None and o > 1 and rng.rand() < 0.1:
        options["coef_prior"] = clone(options.get("coef_prior", CoefPrior())).set_params(shared=True)
    return options


def sparse_model(rng, n, d, o, case):
    options = of_gaussian_process(rng, n, d, o)
    posterior = str(pick(rng, "full", "full", "full", "diagonal"))
    solver = options["solver"] = solver_of(rng, posterior)
    options["sharing"] = share_of(rng, o)
    options["n_inducing"] = pick(rng, 1, 2, 5, 10, 20, n, 200, "auto")
    options["max_iter"] = pick(rng, None, None, 0, 3, 30, 60)
    options["noise_cv"] = pick(rng, 5, None, None, 2)
    options["inducing_init"] = str(pick(rng, "auto", "auto", "k-means", "greedy"))
    lbfgs = isinstance(solver, LBFGS)
    if not lbfgs:
        options["max_iter"] = int(pick(rng, 0, 3, 30, 100))
    elif d > 5 or (options["max_iter"] is None and n > 40):
        options["max_iter"] = 20
    if options["n_inducing"] == "auto":
        if lbfgs:
            solver.max_inducing = 30
        else:
            case.refused('n_inducing="auto" needs')
    if rng.rand() < 0.1:
        options["noise"] = "student-t"
    elif rng.rand() < 0.05:
        options["noise"] = Gaussian(inputs=pick(rng, 0.01, 0.0))
        options["max_iter"] = 10
    noise = options.get("noise")
    if not lbfgs and (noise == "student-t" or getattr(noise, "inputs", None) is not None):
        case.refused("needs solver=")
    if getattr(options.get("coef_prior"), "shared", False) is True:
        if not lbfgs:
            case.refused("needs solver=")
        if posterior == "diagonal":
            case.refused("needs posterior=")
        case.refused("share", must=False)
    if rng.rand() < 0.1:
        options["warm_start"] = True
    return EVGPRegressor(**options)


def exact_model(rng, n, d, o):
    options = of_gaussian_process(rng, n, d, o)
    options["max_iter"] = int(pick(rng, 0, 5, 200, 200))
    options["n_restarts"] = int(pick(rng, 0, 0, 1))
    if options["feature_map"] is not None and rng.rand() < 0.15:
        options["coef_prior"] = clone(options.get("coef_prior", CoefPrior())).set_params(scale=np.inf)
    if rng.rand() < 0.1:
        options["optimizer"] = None
    return EGPRegressor(**options)


def network(rng):
    return BayesianMLPRegressor(
        pick(rng, (), (3,), (10, 5)),
        max_iter=int(pick(rng, 1, 5, 30)),
        batch_size=pick(rng, "auto", 1, 10),
        early_stopping=bool(rng.rand() < 0.2),
        n_samples=int(pick(rng, 1, 10, 100)),
        learning_rate_init=pick(rng, 0.01, 1.0),
        random_state=0,
    )


def random_case(seed):
    """Case number ``seed``."""
    rng = np.random.RandomState(seed)
    case = Case(None, None, None, None)
    names = case.names
    X = inputs(rng, names)
    n, d = X.shape
    o = int(pick(rng, 1, 1, 2, 3))
    kind = rng.rand()
    if kind < 0.06:
        names.append("inverse-dynamics")
        return _inverse_dynamics(rng, case, n)
    Y = targets(rng, X, o, names)
    case.X, case.y = X, Y if o > 1 or rng.rand() < 0.5 else Y[:, 0]
    if kind < 0.16:
        names.append("exact")
        case.model = exact_model(rng, n, d, o)
        if case.model.coef_scale is not None and np.all(case.model.coef_scale == np.inf):
            case.refused("vague|depend|coef_scale|rows", must=False)
    elif kind < 0.21:
        names.append("network")
        case.model = network(rng)
        case.refused("held back|early_stopping|validation", must=False)
    else:
        names.append("sparse")
        case.model = sparse_model(rng, n, d, o, case)
        if kind < 0.29:
            names.append("residual")
            case.model = ResidualRegressor(case.model)
            if o > d:
                case.refused("base|columns")
    if names[-1] in ("sparse", "exact"):
        _weigh(rng, case, n)
    if "Cosine" in repr(case.model) and np.abs(X).max() > 1e5:
        # Of a phase so large, rounding leaves no digits.
        case.refused("must be positive semi-definite", must=False)
    if "Spline" in repr(case.model):
        case.refused("minimum of 2 is required by SplineTransformer", must=False)
        if "denormal" in names:
            # Its knots are differences that vanish.
            case.refused(r"SplineTransformer\((.|\n)*returned NaN or infinity", must=False)
    step = X.std(axis=0)
    case.rows = np.vstack([X, X + np.where(np.isfinite(step), step, 0.0)])[:100]
    if rng.rand() < 0.2:
        some = rng.randint(0, n, 7)
        case.more = X[some] + 0.1 * np.nan_to_num(step), case.y[some]
    _contain(rng, case)
    if rng.rand() < 0.12:
        _spoil(rng, case, d)
    if "vast" in names or "extreme-y" in names or "tiny" in names or "denormal" in names:
        case.refused("must not exceed|must be 0 or exceed|too large", must=False)
    return case


def _inverse_dynamics(rng, case, n):
    robot = pick(rng, None, "pendulum", "acrobot")
    joints = 2 if robot == "acrobot" else 1
    n = max(n, 12) if rng.rand() < 0.8 else n
    t = np.linspace(0.0, 6.0, n)[:, np.newaxis]
    q = np.sin(t * rng.uniform(0.5, 2, joints))
    X = np.hstack([q, np.cos(t * rng.uniform(0.5, 2, joints)), -q]) * 10.0 ** pick(rng, 0, 0, -8, 3)
    y = targets(rng, X, joints, case.names)
    case.names.append(str(robot))
    case.model = InverseDynamics(
        RigidBodyRegressor(robot) if robot and rng.rand() < 0.3 else robot,
        n_inducing=int(pick(rng, 0, 5, 10)),
        gain_scale=pick(rng, 0.0, 0.1),
        consistent=bool(rng.rand() < 0.3),
        max_iter=int(pick(rng, 0, 5)),
        random_state=0,
    )
    case.X, case.y, case.rows = X, y, X + 0.01
    if rng.rand() < 0.5:
        case.fit["groups"] = rng.randint(0, 4, n)
    if n == 1:
        case.refused("minimum of 2|at least 2|n_samples = 1")
    case.refused("must not exceed|must be 0 or exceed", must=False)
    return case


def _weigh(rng, case, n):
    """Weights of rows, their relative variances, groups."""
    if rng.rand() < 0.2:
        case.names.append("weights")
        weight = pick(rng, rng.randint(0, 3, n).astype(float), rng.rand(n), 10.0 ** rng.uniform(-12, 12, n))
        if not (weight > 0).any():
            weight[0] = 1.0
        case.fit["sample_weight"] = weight
    if rng.rand() < 0.1:
        case.names.append("variances")
        case.fit["relative_variance"] = 10.0 ** rng.uniform(-6, 6, n)
    if isinstance(case.model, EVGPRegressor) and rng.rand() < 0.15:
        case.names.append("groups")
        case.fit["groups"] = pick(rng, rng.randint(0, 4, n), np.zeros(n, int), np.arange(n), list("abcd" * n)[:n])


def _mapped(X, dtype):
    """A read-only memory map that needs no file."""
    X = np.ascontiguousarray(X, dtype=dtype)
    room = mmap.mmap(-1, max(1, X.nbytes))
    room.write(X.tobytes())
    return np.frombuffer(memoryview(room).toreadonly(), dtype=dtype, count=X.size).reshape(X.shape)


def _contain(rng, case):
    """X and y in containers of all kinds."""
    kind = pick(
        rng, *4 * ["plain"], "fortran", "strided", "reversed", "read-only", "mapped", "mapped32", "float32", "int",
        "object", "list", "pandas", "polars", "nullable", "longdouble", "bool", "y-read-only",
    )  # fmt: skip
    X, rows = case.X, case.rows
    small = np.abs(X).max() < 1e30 and np.abs(rows).max() < 1e30
    if kind in ("int", "bool") and isinstance(case.model, InverseDynamics):
        kind = "plain"
    case.names.append(kind)
    if kind == "fortran":
        case.X = np.asfortranarray(X)
    elif kind == "strided":
        case.X = np.repeat(np.repeat(X, 2, axis=0), 3, axis=1)[::2, ::3]
    elif kind == "reversed":
        case.X = np.ascontiguousarray(X[::-1])[::-1]
    elif kind == "read-only":
        case.X = X.copy()
        case.X.flags.writeable = False
    elif kind == "y-read-only":
        case.y = case.y.copy()
        case.y.flags.writeable = False
    elif kind == "mapped":
        case.X = _mapped(X, np.float64)
    elif kind in ("mapped32", "float32") and small:
        case.X = _mapped(X, np.float32) if kind == "mapped32" else X.astype(np.float32)
    elif kind == "int" and small:
        case.X = np.clip(np.round(X), -1e9, 1e9).astype(np.int64)
        case.y = np.clip(np.round(case.y), -1e9, 1e9).astype(np.int64)
    elif kind == "bool":
        case.X, case.rows = X.mean() < X, rows > X.mean()
    elif kind == "object":
        case.X = X.astype(object)
    elif kind == "list":
        case.X, case.y = X.tolist(), case.y.tolist()
    elif kind == "longdouble":
        case.X = X.astype(np.longdouble)
    elif kind in ("pandas", "polars", "nullable"):
        columns = [f"x{j}" for j in range(X.shape[1])]
        if kind == "polars":
            case.X, case.rows = (pl.DataFrame(dict(zip(columns, own.T, strict=True))) for own in (X, rows))
        else:
            dtype = "Float64" if kind == "nullable" else None
            case.X, case.rows = (pd.DataFrame(own, columns=columns, dtype=dtype) for own in (X, rows))
        if case.more is not None:
            more = pd.DataFrame(case.more[0], columns=columns)
            case.more = (pl.DataFrame(more.to_dict("list")) if kind == "polars" else more), case.more[1]


def _spoil(rng, case, d):
    """Something that has to be refused."""
    X, y, model = case.X, case.y, case.model
    is_gp = isinstance(model, EVGPRegressor | EGPRegressor)
    kinds = {
        "nan-in-X": "X contains NaN|missing|NaN",
        "inf-in-X": "infinity|inf",
        "nan-in-y": "y contains NaN",
        "short-y": "inconsistent numbers of samples",
        "no-y": "requires y to be passed",
        "sparse-X": "[Ss]parse",
        "words": "could not convert string|not numbers|real numbers",
        "one-dimensional-X": "Expected 2D array",
        "three-dimensional-X": "[Ff]ound array with dim 3|dim 3",
        "complex-X": "[Cc]omplex",
        "huge-X": "must not exceed|too large|infinity",
        "huge-y": "must not exceed|too large|infinity",
        "empty": "0 sample",
        "no-columns": "0 feature",
        "cube-y": "dim 3|y should be|[Bb]ad input shape|array with dim",
        **({"bad-map": ""} if is_gp else {}),
        **({"bad-weight": "sample_weight"} if is_gp else {}),
        **({"missing-and-imputed": ""} if is_gp else {}),
    }
    kind = pick(rng, *kinds)
    case.names.append(kind)
    array, target = np.array(X, dtype=float), np.array(y, dtype=float)
    where = rng.randint(len(array)), rng.randint(d)
    case.X, case.y = array, target
    if kind == "nan-in-X":
        array[where] = np.nan
    elif kind == "inf-in-X":
        array[where] = pick(rng, np.inf, -np.inf)
    elif kind == "nan-in-y":
        target[where[0]] = np.nan
    elif kind == "short-y":
        case.y = np.concatenate([target, target[:1]])
    elif kind == "no-y":
        case.y = None
    elif kind == "sparse-X":
        case.X = pick(rng, sparse.csr_matrix, sparse.coo_array)(array)
    elif kind == "words":
        case.X = np.array([["a"] * d] * len(array))
    elif kind == "one-dimensional-X":
        case.X = array[:, 0]
    elif kind == "three-dimensional-X":
        case.X = array[:, :, np.newaxis]
    elif kind == "complex-X":
        case.X = array + 1j
    elif kind == "huge-X":
        array[where] = pick(rng, 1e101, 1e300)
    elif kind == "huge-y":
        target[where[0]] = 1e200
    elif kind == "empty":
        case.X, case.y, case.fit = array[:0], target[:0], {}
    elif kind == "no-columns":
        case.X = array[:, :0]
    elif kind == "cube-y":
        case.y = np.zeros((len(array), 2, 2))
    elif kind == "bad-weight":
        case.fit["sample_weight"] = pick(
            rng, -np.ones(len(array)), np.full(len(array), np.nan), np.zeros(len(array)), np.ones(len(array) + 1), "a"
        )
    elif kind == "missing-and-imputed":
        frame = pd.DataFrame(array, columns=[f"x{j}" for j in range(d)])
        if len(frame) > 2:
            frame.iloc[where] = np.nan
        filled = [SimpleImputer(keep_empty_features=True)]
        model.set_params(
            kernel_map=make_pipeline(*filled), feature_map=None, coef_prior=CoefPrior(mean="auto", scale="auto")
        )
        # What it was to be refused for may have been these.
        case.must = case.must and model.share_coef is not True
        model.set_params(coef_prior=CoefPrior(shared="auto"), kernel=None)
        case.X, case.rows, case.more = frame, frame, None
        # Columns of one row may be all that is known of one.
        case.refused("input_noise|must not exceed|must be 0 or exceed", must=False)
        return
    elif kind == "bad-map":
        how = pick(rng, *BadMap.messages)
        late = bool(rng.rand() < 0.3) or how == "width"
        model.set_params(**{pick(rng, "feature_map", "kernel_map"): BadMap(how, late)})
        case.names.append(f"{how}{'-late' if late else ''}")
        # Other options may have been wrong for the map before it is used. A fit may call it once only.
        case.refused(f"{BadMap.messages[how]}|coef_mean|must not exceed|share_coef")
        case.late = late
        case.refused("kernel", must=False)
        return
    case.refused(kinds[kind])
