"""The paper's four systems and five models, in its setting and in skevgp's."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm, truncnorm
from sklearn.base import RegressorMixin, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.pipeline import make_pipeline, make_union
from sklearn.utils import Bunch

import harness
from skevgp import BayesianMLPRegressor, CoefPrior, EVGPRegressor, ResidualRegressor
from skevgp.datasets import perturb_robot
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, NominalDynamics
from skevgp.metrics import containing_ratios, negative_log_predictive_density, prediction_error, std_norm
from skevgp.noise import Gaussian
from skevgp.robots import layout_of
from skevgp.solvers import Adam

# What the paper fits: mini-batches, inducing points per output, and the noise where the bound puts it.
PAPER: dict[str, Any] = {"solver": Adam(posterior="diagonal"), "sharing": "kernel", "noise_cv": None}
SETTINGS = ("paper", "author", "author-100", "skevgp", "skevgp-angles", "skevgp-nominal")
# Shares of the targets that intervals promise to hold, for a reliability curve.
PROMISED = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
# The prior scale of the weights in the author's library; which the paper took is not known.
AUTHORS_SCALE = {"author": 1.0, "author-100": 100.0}
ADAM = ("paper", *AUTHORS_SCALE)
# How wrong the nominal arm is, relative.
NOMINAL_ERROR = 0.2
# What convergence warnings say of a search that did not end by itself, and of what it found.
ENDED_EARLY = re.compile(
    "still (rising|fell)|stopped after|diverged|bound below the first|interrupted|ended at max_time|not stay finite"
)
NOTHING_LEARNED = re.compile(
    r"for (\d+) of \d+ outputs that are fitted together\. The Gaussian process learned nothing|became white noise"
)
# Trajectories of a quick run.
QUICK_TRAJECTORIES = 12
# The paper's Table 4, by system and model. Both cartpoles have the numbers of the paper's only one.
PUBLISHED = pd.read_csv(Path(__file__).with_name("published.csv"), index_col=["system", "model"])


@dataclass(frozen=True)
class Fit:
    """How to fit a model. ``max_iter=None`` is that of the regressor, or of a quick run."""

    system: str
    model: str
    setting: str
    seed: int
    size: str
    max_iter: int | None


QUICK = {  # iterations of L-BFGS, steps of Adam and epochs of the network in a quick run
    "pendulum": (300, 2000, 400),
    "cartpole": (200, 1000, 200),
    "cartpole_damped": (200, 1000, 200),
    "acrobot": (50, 100, 100),
    "iiwa14": (10, 2, 3),
}
SYSTEMS = tuple(QUICK)
# The network learns until rows held back gain nothing.
UNTIL_FLAT: dict[str, Any] = {"early_stopping": True, "n_iter_no_change": 30, "max_iter": 1000}


def authors_start(fit: Fit, n_inducing: int, with_features: bool) -> dict[str, Any]:
    """Return where EVGP starts in the author's library, twodlearn, whose defaults need not be the paper's.

    Noise of std 1, a signal of std 0.5, lengthscales (1 / m)^(1 / D) and inducing points from a truncated normal, in
    the data's units; weights with a prior scale of 1 or 100; Adam with a fixed step of 0.01 on batches of 50.
    """
    n_columns = layout_of(fit.system).n_columns
    points = truncnorm.rvs(-2.0, 2.0, size=(n_inducing, n_columns), random_state=fit.seed)
    length_scale = np.full(n_columns, n_inducing ** (-1.0 / n_columns))
    return {
        **PAPER,
        "solver": Adam(batch_size=50, learning_rate=0.01, schedule="constant", posterior="diagonal"),
        "kernel": ConstantKernel(0.25) * RBF(length_scale, (1e-5, 1e5)),
        "noise": Gaussian(variance=1.0),
        "inducing_init": points,
        **({"coef_prior": CoefPrior(scale=AUTHORS_SCALE[fit.setting])} if with_features else {}),
    }


def papers_prior(features: TransformerMixin, n_outputs: int) -> CoefPrior:
    """Return the prior of the paper's setting: weights that Newton's law gives ± 0.1, all others ± 1, per step."""
    labels = features.coef_groups(n_outputs)
    return CoefPrior(scale=np.where(labels == "known", 0.1, 1.0))


def evgp(physics: type[TransformerMixin] | None, fit: Fit, n_inducing: int) -> EVGPRegressor:
    """Return an EVGP with features of inertia and force, with gravity too, or without features."""
    features = None if physics is None else physics(fit.system)
    arguments: dict[str, Any] = {}
    if fit.setting == "skevgp-nominal":
        wrong = perturb_robot(fit.system, NOMINAL_ERROR, random_state=fit.seed)
        features = make_union(features, NominalDynamics(wrong))
    elif fit.setting == "paper":
        arguments = PAPER
        if features is not None:
            arguments = {**PAPER, "coef_prior": papers_prior(features, 2 * layout_of(fit.system).n_joints)}
    elif fit.setting in AUTHORS_SCALE:
        arguments = authors_start(fit, n_inducing, features is not None)
    elif fit.setting == "skevgp-angles":
        arguments = {"kernel_map": AngleEncoder(fit.system)}
    iterations = fit.max_iter
    if iterations is None and fit.size == "quick":
        iterations = QUICK[fit.system][fit.setting in ADAM]
    return EVGPRegressor(features, n_inducing=n_inducing, max_iter=iterations, random_state=fit.seed, **arguments)


def residual_network(fit: Fit, hidden_layer_sizes: tuple[int, int]) -> ResidualRegressor:
    """Return a network that learns the change of state."""
    network = BayesianMLPRegressor(
        hidden_layer_sizes,
        prior_scale=1.0 if fit.setting == "paper" else None,
        random_state=fit.seed,
        **({"max_iter": QUICK[fit.system][2]} if fit.size == "quick" else UNTIL_FLAT),
    )
    if fit.setting == "skevgp-angles":
        network = make_pipeline(AngleEncoder(fit.system), network)
    return ResidualRegressor(network)


# The sizes of the models on `SYSTEMS` (the paper's Table 2). For the network on iiwa14 the paper says [512, 512], and a
# number of parameters that is that of two layers of 250.
SIZES = {
    "VGP": (40, 100, 100, 250, 500),
    "RES-VGP": (40, 100, 100, 250, 500),
    "RES-DBNN": ((15, 15), (50, 50), (50, 50), (60, 60), (250, 250)),
    "EVGP-IF": (10, 60, 60, 150, 350),
    "EVGP-IFG": (10, 60, 60, 150, 350),
}
MODELS = tuple(SIZES)


def build(fit: Fit) -> RegressorMixin:
    size: Any = SIZES[fit.model][SYSTEMS.index(fit.system)]
    if fit.model == "RES-DBNN":
        return residual_network(fit, size)
    physics = {"EVGP-IF": InertiaForce, "EVGP-IFG": InertiaForceGravity}.get(fit.model)
    model = evgp(physics, fit, size)
    return ResidualRegressor(model) if fit.model == "RES-VGP" else model


def has(system: str, model: str, setting: str, angles: str = "raw") -> bool:
    """Return whether there is such a cell. Sines and cosines need no wrapped angles."""
    if setting == "skevgp-nominal":
        return system == "iiwa14" and model.startswith("EVGP")
    if setting == "author-100":
        return model.startswith("EVGP")
    if setting == "author":
        return model != "RES-DBNN"
    return setting != "skevgp-angles" or angles == "raw"


def fitted_part(regressor: Any) -> Any:
    """Return the EVGP or the network inside."""
    regressor = getattr(regressor, "regressor_", regressor)
    return regressor[-1] if hasattr(regressor, "steps") else regressor


def measures(target: np.ndarray, mean: np.ndarray, std: np.ndarray) -> dict[str, float]:
    """Return the paper's metrics, quantiles of the error over rows, the NLPD, and shares that intervals hold."""
    errors = np.linalg.norm(target - mean, axis=1)
    shares = containing_ratios(target, mean, std, norm.ppf(0.5 + 0.5 * np.array(PROMISED)))
    return {
        "error_mean": prediction_error(target, mean),
        "error_median": np.median(errors),
        "error_p99": np.quantile(errors, 0.99),
        "std_norm": std_norm(std),
        **dict(zip(("cr1", "cr2", "cr3"), containing_ratios(target, mean, std), strict=True)),
        "nlpd": negative_log_predictive_density(target, mean, std),
        **{f"within_{share}": ratio for share, ratio in zip(PROMISED, shares, strict=True)},
    }


def in_range(train: Bunch, test: Bunch, errors: np.ndarray) -> dict[str, Any]:
    """Return errors inside and outside the training rows' ranges, and what is outside (column:rows:end:farthest)."""
    low, high = train.data.min(axis=0), train.data.max(axis=0)
    inside = ~((test.data < low) | (test.data > high)).any(axis=1)
    return {
        "error_inside": errors[inside].mean() if inside.any() else np.nan,
        "error_outside": errors[~inside].mean() if not inside.all() else np.nan,
        "inside": inside.mean(),
        "outside": " ".join(
            f"{column}:{n}:{limit:.3g}:{reached:.3g}"
            for column, tested in enumerate(test.data.T)
            for n, limit, reached in (
                ((tested > high[column]).sum(), high[column], tested.max()),
                ((tested < low[column]).sum(), low[column], tested.min()),
            )
            if n
        ),
    }


def groups_of(regressor: Any, train: Bunch) -> dict[str, np.ndarray]:
    """Return the argument ``groups`` of fit, for a regressor that has it."""
    inner = getattr(regressor, "regressor", regressor)
    return {"groups": train.groups} if isinstance(inner, EVGPRegressor) and "groups" in train else {}


def how_it_ended(messages: list[str], n_outputs: int) -> dict[str, Any]:
    """Return whether a search ended by itself, and of at least how many outputs the GP learned nothing."""
    said = " ".join(messages)
    counts = [int(found[1] or n_outputs) for found in NOTHING_LEARNED.finditer(said)]
    return {"converged": not ENDED_EARLY.search(said), "unlearned": min(sum(counts), n_outputs)}


def limited(row: Any) -> bool:
    """Return whether a limit of iterations ended the fit of a row."""
    return str(row["converged"]) == "False" or str(row["max_iter"]).removesuffix(".0") == str(row["n_iter"])


def fitted_row(fit: Fit, train: Bunch, test: Bunch, **columns: Any) -> dict[str, Any]:
    """Fit a model and evaluate it on test rows; return the columns of a CSV that are not the cell's."""
    regressor = build(fit)
    seconds, caught = harness.timed(lambda: regressor.fit(train.data, train.target, **groups_of(regressor, train)))
    messages = [str(warning.message) for warning in caught if issubclass(warning.category, ConvergenceWarning)]
    mean, std = regressor.predict(test.data, return_std=True)
    fitted = fitted_part(regressor)
    return {
        **measures(test.target, mean, std),
        **in_range(train, test, np.linalg.norm(test.target - mean, axis=1)),
        "n_parameters": fitted.n_parameters_,
        "fit_seconds": seconds,
        **columns,
        "max_iter": "" if fit.max_iter is None or fit.model == "RES-DBNN" else fit.max_iter,
        "n_iter": fitted.n_iter_,
        "bound_per_row": getattr(fitted, "lower_bound_", np.nan) / len(train.data),
        **how_it_ended(messages, train.target.shape[1]),
    }
