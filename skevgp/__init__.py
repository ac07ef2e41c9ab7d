"""Sparse Gaussian process regression that scales, and that knows physics."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from . import datasets, exceptions, features, io, kernels, metrics, plotting, solvers
    from .bnn import BayesianMLPRegressor
    from .exact import EGPRegressor
    from .inverse_dynamics import InverseDynamics
    from .prediction.rollout import rollout
    from .regressor import EVGPRegressor
    from .residual import ResidualRegressor

__all__ = [
    "BayesianMLPRegressor",
    "EGPRegressor",
    "EVGPRegressor",
    "InverseDynamics",
    "ResidualRegressor",
    "__version__",
    "datasets",
    "exceptions",
    "features",
    "io",
    "kernels",
    "metrics",
    "plotting",
    "rollout",
    "solvers",
]

_SUBMODULES = ("datasets", "exceptions", "features", "io", "kernels", "metrics", "plotting", "solvers")
_HOME = {
    "BayesianMLPRegressor": "bnn",
    "EGPRegressor": "exact",
    "EVGPRegressor": "regressor",
    "InverseDynamics": "inverse_dynamics",
    "ResidualRegressor": "residual",
    "rollout": "prediction.rollout",
}


def __getattr__(name: str) -> Any:
    """Import public names when they are first used: ``import skevgp`` is quick and needs no optional package."""
    if name in _SUBMODULES:
        return import_module(f".{name}", __name__)
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
