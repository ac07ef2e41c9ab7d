"""Sparse Gaussian process regression that scales, and that knows physics."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from . import datasets, exceptions, features, io, kernels, metrics, noise, plotting, solvers
    from .control.rollout import rollout
    from .estimators.bnn import BayesianMLPRegressor
    from .estimators.egp import EGPRegressor
    from .estimators.evgp import EVGPRegressor
    from .estimators.report import FeatureReport, feature_report
    from .estimators.residual import ResidualRegressor
    from .fitting.prior import CoefPrior
    from .identification.contact import ContactMonitor
    from .identification.inverse_dynamics import InverseDynamics

__all__ = [
    "BayesianMLPRegressor",
    "CoefPrior",
    "ContactMonitor",
    "EGPRegressor",
    "EVGPRegressor",
    "FeatureReport",
    "InverseDynamics",
    "ResidualRegressor",
    "__version__",
    "datasets",
    "exceptions",
    "feature_report",
    "features",
    "io",
    "kernels",
    "metrics",
    "noise",
    "plotting",
    "rollout",
    "solvers",
]

_SUBMODULES = ("datasets", "exceptions", "features", "io", "kernels", "metrics", "noise", "plotting", "solvers")
_HOME = {
    "BayesianMLPRegressor": "estimators.bnn",
    "CoefPrior": "fitting.prior",
    "ContactMonitor": "identification.contact",
    "EGPRegressor": "estimators.egp",
    "EVGPRegressor": "estimators.evgp",
    "FeatureReport": "estimators.report",
    "InverseDynamics": "identification.inverse_dynamics",
    "ResidualRegressor": "estimators.residual",
    "feature_report": "estimators.report",
    "rollout": "control.rollout",
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
