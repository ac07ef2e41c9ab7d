"""Fitted models of all kinds, small, and rows for them."""

from functools import cache

import numpy as np
import pandas as pd
import polars as pl
from sklearn.base import clone
from sklearn.compose import ColumnTransformer, make_column_selector
from sklearn.decomposition import PCA
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
from sklearn.kernel_approximation import RBFSampler
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    Normalizer,
    OneHotEncoder,
    OrdinalEncoder,
    PolynomialFeatures,
    PowerTransformer,
    QuantileTransformer,
    RobustScaler,
    SplineTransformer,
    StandardScaler,
)

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor
from skevgp.datasets import load_robot, perturb_robot
from skevgp.features import (
    AngleEncoder,
    Friction,
    InertiaForce,
    InertiaForceGravity,
    LinkGravity,
    LogNormal,
    NominalDynamics,
    RigidBodyRegressor,
    Uniform,
)
from skevgp.kernels import Cosine
from skevgp.noise import Gaussian
from skevgp.robots import get_system
from skevgp.solvers import LBFGS, Adam

RNG = np.random.RandomState(0)
X, X_NEW = RNG.uniform(-2.0, 2.0, (60, 2)), RNG.uniform(-2.0, 2.0, (7, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]), X[:, 0] * X[:, 1], X[:, 1] ** 2]) + 0.05 * RNG.randn(60, 3)
ROWS, ROWS_NEW = RNG.uniform(0.1, 1.0, (60, 5)), RNG.uniform(0.1, 1.0, (7, 5))  # of the acrobot
STATES = ROWS[:, :4] + 0.1 * np.sin(ROWS[:, 1:]) + 0.01 * RNG.randn(60, 4)

# Changes of the velocities of another acrobot.
CHANGES = 0.03 * NominalDynamics(perturb_robot("acrobot", 0.3, random_state=0)).fit_transform(ROWS)
CHANGES += 0.001 * np.random.RandomState(1).randn(60, 2)
# Its speeds with friction, so that the data identify its parameter.
_FRICTION = Friction("acrobot", parameters={"sharpness": Uniform(0.5, 2.5)})
SLOWED = STATES + np.pad(clone(_FRICTION).fit_transform(ROWS)[:, 4:], ((0, 0), (2, 0)))
_FACTOR = {"outputs": ["dq1/dt", "dq2/dt"], "parameters": {"mass(q1)": LogNormal(1.0, 0.5)}}


def frame(rows):
    warm = np.where(rows[:, 0] > 0.0, "hot", "cold")
    return pd.DataFrame({"a": rows[:, 0], "b": rows[:, 1], "word": warm})


def polars(rows):
    return pl.DataFrame({"a": rows[:, 0], "b": rows[:, 1]})


def encoded(*words):
    return ColumnTransformer([("numbers", StandardScaler(), ["a", "b"]), ("words", OneHotEncoder(), ["word"]), *words])


def evgp(*maps, **options):
    """A model whose fit is short: choosing what outputs share and calibrating would take most of the time."""
    options = {"n_inducing": 6, "max_iter": 3, "sharing": "all", "noise_cv": None, "random_state": 0, **options}
    return EVGPRegressor(*maps, **options)


# All kinds.
KERNELS = {
    "sum": ConstantKernel(2.0) * Matern([1.0, 1.0], nu=2.5)
    + DotProduct()
    + Matern(nu=1.5)
    + Matern(nu=0.5)
    + Matern(nu=np.inf)
    + Matern(nu=2.2)
    + RBF(1.0, "fixed")
    + ConstantKernel()
    + WhiteKernel(),
    "product": RationalQuadratic() * ExpSineSquared() + Cosine([1.0, 2.0]) * RBF([1.0, 1.0]),
}
_ACROBOT = (ROWS, STATES, ROWS_NEW)
# Name -> a model, what it is fitted to, and rows to predict.
CASES = {
    "plain": (evgp(noise_cv=5), X, Y[:, 0], X_NEW),
    "outputs": (EVGPRegressor(n_inducing=6, max_iter=1, random_state=0), X[:30], Y[:30, :2], X_NEW),
    "groups": (evgp(sharing=[[0, 2], [1]], normalize_y=True), X, Y, X_NEW),
    "kernel": (evgp(sharing="kernel", solver=LBFGS(posterior="diagonal")), X, Y, X_NEW),
    "adam": (evgp(solver="adam"), X, Y, X_NEW),
    "adam-object": (evgp(solver=Adam(batch_size=20, posterior="diagonal")), X, Y, X_NEW),
    "auto-m": (evgp(n_inducing="auto", solver=LBFGS(max_inducing=12)), X, Y[:, 0], X_NEW),
    "student-t": (evgp(noise="student-t"), X, Y[:, 0], X_NEW),
    "input-noise": (evgp(noise=Gaussian(inputs=0.1)), X, Y[:, 0], X_NEW),
    "shared-weights": (evgp(InertiaForce(), coef_prior=CoefPrior(shared=True)), X, Y, X_NEW),
    **{f"kernel-{name}": (evgp(kernel=kernel), X, Y[:, 0], X_NEW) for name, kernel in KERNELS.items()},
    "exact": (EGPRegressor(InertiaForce(), max_iter=3, coef_prior=CoefPrior(scale=np.inf)), X, Y, X_NEW),
    "exact-plain": (EGPRegressor(max_iter=3), X, Y[:, 0], X_NEW),
    "residual": (ResidualRegressor(evgp(), base=[1]), X, Y[:, 0], X_NEW),
    "network": (BayesianMLPRegressor((5,), max_iter=2, early_stopping=True, random_state=0), X, Y, X_NEW),
    "network-in-a-pipeline": (
        ResidualRegressor(
            make_pipeline(
                AngleEncoder("acrobot"),
                BayesianMLPRegressor((4,), max_iter=2, random_state=np.random.RandomState(3)),
            )
        ),
        *_ACROBOT,
    ),
    "unions": (
        evgp(
            make_union(InertiaForce(), PolynomialFeatures(2), SplineTransformer(4)),
            kernel_map=ColumnTransformer(
                [("a", StandardScaler(), [0]), ("b", "passthrough", slice(1, 2)), ("c", SplineTransformer(), [1])]
            ),
        ),
        X,
        Y,
        X_NEW,
    ),
    "more-maps": (
        evgp(
            make_pipeline(
                SimpleImputer(),
                QuantileTransformer(n_quantiles=10),
                PowerTransformer(),
                RBFSampler(n_components=5, random_state=0),
                Normalizer(),
            ),
            kernel_map=make_pipeline(MinMaxScaler(), RobustScaler(), MaxAbsScaler(), FunctionTransformer(), PCA(2)),
        ),
        X,
        Y[:, 0],
        X_NEW,
    ),
    "words": (evgp(kernel_map=encoded()), frame(X), Y[:, 0], frame(X_NEW)),
    "polars": (evgp(InertiaForce(), kernel_map=StandardScaler()), polars(X), Y[:, 0], polars(X_NEW)),
    "words-in-a-pipeline": (make_pipeline(encoded(), evgp()), frame(X), Y[:, 0], frame(X_NEW)),
    "selected": (
        evgp(
            kernel_map=ColumnTransformer(
                [
                    ("numbers", StandardScaler(), make_column_selector(dtype_include=np.number)),
                    ("words", OrdinalEncoder(), make_column_selector(pattern="word")),
                ]
            )
        ),
        frame(X),
        Y[:, 0],
        frame(X_NEW),
    ),
    "named-columns": (
        evgp(InertiaForce(), kernel_map=StandardScaler().set_output(transform="pandas")),
        frame(X)[["a", "b"]],
        Y,
        frame(X_NEW)[["a", "b"]],
    ),
    "a-system": (evgp(InertiaForceGravity(get_system("acrobot")), kernel_map=AngleEncoder("acrobot")), *_ACROBOT),
    "nominal": (evgp(NominalDynamics("acrobot")), *_ACROBOT),
    "factors": (evgp(NominalDynamics("acrobot", **_FACTOR)), ROWS[:30], CHANGES[:30], ROWS_NEW),
    "friction": (evgp(_FRICTION), ROWS, SLOWED, ROWS_NEW),
    "nominal-of-a-model": (evgp(NominalDynamics(load_robot("acrobot"))), *_ACROBOT),
    "time-steps": (
        evgp(make_union(InertiaForceGravity("acrobot", dt="column"), LinkGravity("acrobot", dt="column"))),
        np.column_stack([ROWS, np.full(60, 0.03)]),
        STATES,
        np.column_stack([ROWS_NEW, np.full(7, 0.02)]),
    ),
    "torques": (
        evgp(RigidBodyRegressor("acrobot"), sharing="none"),
        STATES.repeat(2, axis=1)[:, :6],
        STATES[:, :2],
        ROWS_NEW[:, [0, 1, 2, 3, 4, 0]],
    ),
    "inverse-dynamics": (
        InverseDynamics("acrobot", n_inducing=5, max_iter=1, random_state=0),
        STATES.repeat(2, axis=1)[:30, :6],
        STATES[:30, :2],
        ROWS_NEW[:, [0, 1, 2, 3, 4, 0]],
    ),
    "physics-alone": (
        InverseDynamics(RigidBodyRegressor("acrobot", friction=["viscous"]), n_inducing=0),
        STATES.repeat(2, axis=1)[:, :6],
        STATES[:, :2],
        ROWS_NEW[:, [0, 1, 2, 3, 4, 0]],
    ),
    "a-map": (NominalDynamics("acrobot"), ROWS, None, ROWS_NEW),
}


@cache
def fitted(name):
    model, inputs, targets, _ = CASES[name]
    return clone(model).fit(inputs, targets)


def new_rows(name):
    return CASES[name][3]


def predictions(model, rows):
    """All that a model predicts."""
    if not hasattr(model, "predict"):
        return [model.transform(rows)]
    found = [*model.predict(rows, return_std=True)]
    if isinstance(model, EVGPRegressor | EGPRegressor | BayesianMLPRegressor):
        found += [*model.predict(rows, return_cov=True), model.sample_y(rows, 3)]
    return found
