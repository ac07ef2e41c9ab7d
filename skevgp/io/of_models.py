"""How estimators, kernels and what is kept of fits are written down."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..data.source import RawRows
from ..estimators.bnn import BayesianMLPRegressor, Scaling, VariationalNetwork
from ..estimators.egp import EGPRegressor
from ..estimators.evgp import EVGPRegressor
from ..estimators.residual import ResidualRegressor
from ..features.rigid_body import RigidBodyRegressor
from ..fitting.exact import ExactFit
from ..fitting.fitted import FittedOutputs
from ..fitting.learned import Learned
from ..fitting.outliers import RowDoubts
from ..fitting.strategy import Fit
from ..fitting.units import Units
from ..identification.inverse_dynamics import InverseDynamics
from ..identification.joint_residual import JointResidual, QuietRegressor
from ..identification.stiction import JointNoise
from ..identification.weights import Known, Prior, Weights
from ..kernels.parse import KernelSpec
from ..model.exact import ExactModel
from ..model.model import SparseModel
from ..model.parameters import Parameter, ParameterTable
from ..model.predictor import CoefficientPrior, Predictor, PredictorGroup
from ..model.statistics import SufficientStatistics, Whitening
from ..noise.student_t import RowScales
from ..solvers.solvers import LBFGS, Adam
from ..utils.linalg import Jitter
from . import of_kernels
from .fields import (
    MalformedError,
    anything,
    array,
    columns,
    flag,
    integer,
    made,
    mapping,
    nothing,
    one_of,
    real,
    row,
    several,
    span,
    text,
    words,
)
from .of_kernels import COVARIANCE, TREE
from .records import Record, estimator, plain

# --- what is kept of fits ----------------------------------------------------------------------------------------

_PRIOR, _ARRAYS, _CURVE = made(CoefficientPrior), mapping(array("...")), several(real(finite=False))
_LIMIT = array("...", finite=False) | real(finite=False)


def _of_group(group: Any) -> dict[str, Any]:
    names = ("outputs", "kernel", "hyperparameters", "points", "signal", "mean", "root")
    found = {name: getattr(group, name) for name in names}
    return {**found, "L": group.whitening.L, "L_inv": group.whitening.L_inv}


def _group(found: dict[str, Any]) -> PredictorGroup:
    L, L_inv = found.pop("L"), found.pop("L_inv")
    # K is not needed, and what else there is follows from kernel and points.
    covariance = found["kernel"].at(np.log(found["hyperparameters"]), found["points"])
    return PredictorGroup(**found, whitening=Whitening(covariance, L, L_inv))


_GROUP = Record(
    "PredictorGroup",
    PredictorGroup,
    {
        "outputs": columns,
        "kernel": COVARIANCE,
        "hyperparameters": array("h", above=0.0),
        "points": array("m d"),
        "L": array("m m"),
        "L_inv": array("m m"),
        "signal": array("o", least=0.0),
        "mean": array("o q"),
        "root": array("o k q"),
    },
    frozenset(),
    _of_group,
    _group,
)

_TABLE = Record(
    "ParameterTable",
    ParameterTable,
    {"parameters": several(made(Parameter), tuple)},
    frozenset(),
    lambda table: {"parameters": table.parameters},
    lambda found: ParameterTable(found["parameters"]),
)

_FITS = [
    plain(
        CoefficientPrior,
        mean=array("o p"),
        scale=array("o p", least=0.0),
        reference=array("o p"),
        root=array("o p p") | nothing,
        shared=flag,
    ),
    _GROUP,
    plain(
        Predictor,
        groups=several(made(PredictorGroup), tuple),
        noise=array("o", least=0.0),
        offset=array("o p"),
        intercept=array("o"),
        shared=flag,
    ),
    plain(Units, target_mean=array("o"), target_unit=array("o", above=0.0), prior=_PRIOR),
    replace(
        plain(
            Parameter,
            name=text,
            start=array("..."),
            transform=one_of("identity", "log"),
            lower=_LIMIT,
            upper=_LIMIT,
            unit=_LIMIT,
            origin=_LIMIT,
            fixed=flag | array("...", "b"),
            widest=_LIMIT | nothing,
        ),
        # There was none before 0.2.
        may_lack=frozenset({"widest"}),
    ),
    _TABLE,
    plain(Jitter, size=real(least=0.0), well_conditioned=real(least=0.0)),
    plain(
        SparseModel,
        kernel=COVARIANCE,
        prior=_PRIOR,
        family=one_of("full", "diagonal"),
        groups=several(span, tuple),
        jitter=made(Jitter),
        complete=flag,
        kernels=several(COVARIANCE, tuple) | nothing,
    ),
    plain(
        SufficientStatistics,
        n_rows=real(least=0.0),
        VV=array("m m"),
        VH=array("m p"),
        VR=array("m o"),
        HH=array("p p"),
        HR=array("p o"),
        RR=array("o", least=0.0),
        unexplained=real(least=0.0),
        log_variance=real(),
        surplus=real(),
    ),
    plain(
        Learned,
        model=made(SparseModel),
        table=made(ParameterTable),
        values=_ARRAYS,
        statistics=several(made(SufficientStatistics)),
        predictor=made(Predictor),
        loss_curve=_CURVE,
        message=text,
        dependent=flag,
        doubts=made(RowDoubts) | nothing,
        known_bound=real(finite=False) | nothing,
        known_upper_bound=real(finite=False) | nothing,
        exact=flag,
    ),
    plain(RowDoubts, scales=made(RowScales), noise_factor=array("o", least=0.0)),
    # The rows are in no file; new ones get distances of their own.
    Record(
        "RowScales",
        RowScales,
        {"n_outputs": integer(1)},
        frozenset(),
        lambda scales: {"n_outputs": scales.n_outputs},
        lambda found: RowScales(found["n_outputs"], np.empty(0)),
    ),
    plain(
        FittedOutputs,
        units=made(Units),
        outputs=several(several(integer(0))),
        found=flag,
        learned=several(made(Learned), tuple),
        messages=several(text, tuple),
    ),
    plain(
        RawRows,
        inputs=array("n d") | array("n o d"),
        features=array("n p") | array("n o p"),
        targets=array("n o"),
        counts=array("n") | nothing,
        precision=array("n") | nothing,
        log_variance=array("n") | nothing,
    ),
    plain(
        ExactModel,
        kernel=COVARIANCE,
        prior=_PRIOR,
        vague=array("o p", "b"),
        rows=made(RawRows),
        kernels=several(COVARIANCE, tuple) | nothing,
    ),
    plain(
        Fit,
        values=_ARRAYS,
        bound=real(finite=False),
        loss_curve=_CURVE,
        converged=flag,
        message=text,
        predictor=made(Predictor) | nothing,
        n_rows=integer(1) | nothing,
    ),
    plain(
        ExactFit,
        units=made(Units),
        model=made(ExactModel),
        table=made(ParameterTable),
        fit=made(Fit),
        messages=several(text, tuple),
    ),
    plain(JointNoise, variance=real(least=0.0), coulomb=real(), velocity=real(above=0.0)),
    plain(JointResidual, model=made(QuietRegressor) | nothing, noise=made(JointNoise), held_for_no_group=flag),
    plain(
        Prior,
        mean=array("P"),
        covariance=array("P P"),
        scaled=array("p", "b"),
        coulomb=array("o", "i", least=0) | nothing,
        velocity=array("o", above=0.0),
    ),
    plain(Known, features=array("r o p"), targets=array("r o")),
    plain(
        Weights,
        mean=array("P"),
        covariance=array("P P"),
        prior=made(Prior),
        noise=several(made(JointNoise)),
        correlation_time=array("o", above=0.0),
        inflation=real(least=1.0),
        surprise=real(least=0.0, finite=False),
    ),
]


def _network(found: dict[str, Any]) -> VariationalNetwork:
    sizes, prior = found["sizes"], found["prior_log_std"]
    if len(sizes) < 2 or len(prior) != sum(first * second for first, second in pairwise(sizes)):
        raise MalformedError(f"a VariationalNetwork of the sizes {sizes} has not {len(prior)} weights")
    network = VariationalNetwork(sizes, np.ones(len(sizes) - 1).tolist(), found["slope"])
    # The file has a number for each weight; those of a layer are equal.
    ends = np.cumsum([first * second for first, second in pairwise(sizes)])
    network.prior_log_stds = prior[ends - 1]
    return network


def _prior_log_std(network: VariationalNetwork) -> np.ndarray:
    return np.repeat(network.prior_log_stds, [first * second for first, second in pairwise(network.sizes)])


_NETWORK = [
    Record(
        "VariationalNetwork",
        VariationalNetwork,
        {"sizes": several(integer(1), tuple), "slope": real(least=0.0), "prior_log_std": array("w")},
        frozenset(),
        lambda own: {"sizes": own.sizes, "slope": own.slope, "prior_log_std": _prior_log_std(own)},
        _network,
    ),
    plain(Scaling, x_mean=array("d"), x_scale=array("d", above=0.0), y_mean=array("o"), y_scale=array("o", above=0.0)),
]

# --- estimators --------------------------------------------------------------------------------------------------

_INPUTS = {"n_features_in_": integer(1), "feature_names_in_": words}
_LISTS = several(array("..."))
_NOISE = real(least=0.0) | array("o", least=0.0)
_OF_BOTH = {
    **_INPUTS,
    "feature_map_": anything,
    "kernel_map_": anything,
    "_example": anything,
    "_spec": made(KernelSpec),
    "_row_shapes": row(several(integer(0), tuple), several(integer(0), tuple)),
    "_predictor": made(Predictor),
    "_columns_changed": array("c", "i", least=0),
    "noise_variance_": _NOISE,
    "kernel_": TREE | several(TREE),
    "loss_curve_": array("t", finite=False),
    "n_iter_": integer(0),
    "coef_": array("p") | array("o p"),
    "coef_cov_": array("p p") | array("o p p"),
    "coef_std_": array("p", least=0.0) | array("o p", least=0.0),
    "coef_names_": words,
    "coef_prior_mean_": array("p") | array("o p"),
    "coef_prior_scale_": array("p", least=0.0, finite=False) | array("o p", least=0.0, finite=False),
}
_OF_SPARSE = {
    **_OF_BOTH,
    "_fitted": made(FittedOutputs),
    "inducing_points_": array("m d") | array("o m d") | _LISTS,
    "sharing_": several(several(integer(0))),
    "n_parameters_": integer(0),
    # NaN where a row does not count.
    "weights_": array("n", finite=False) | array("n o", finite=False),
}

_ESTIMATORS = [
    estimator(EVGPRegressor, **_OF_SPARSE),
    estimator(QuietRegressor, **_OF_SPARSE, _held_for_no_group=flag),
    estimator(EGPRegressor, **_OF_BOTH, _fitted=made(ExactFit), log_marginal_likelihood_value_=real(finite=False)),
    estimator(ResidualRegressor, **_INPUTS, regressor_=anything, base_=array("o", "i", least=0)),
    estimator(
        BayesianMLPRegressor,
        **_INPUTS,
        _network=made(VariationalNetwork),
        _scaling=made(Scaling),
        _theta=array("t"),
        _weights=several(array("...")),
        n_iter_=integer(0),
        loss_curve_=array("c", finite=False),
        validation_scores_=array("c", finite=False) | nothing,
        coefs_=_LISTS,
        coefs_std_=_LISTS,
        intercepts_=_LISTS,
        X_mean_=array("d"),
        noise_variance_=_NOISE,
        n_parameters_=integer(0),
    ),
    estimator(
        InverseDynamics,
        **_INPUTS,
        feature_map_=made(RigidBodyRegressor),
        _one_dimensional=flag,
        _weights=made(Weights),
        _known=made(Known),
        _outputs=several(text),
        _unexplained=several(text),
        _joints=several(made(JointResidual)),
        coef_=array("p"),
        coef_std_=array("p", least=0.0),
        coef_cov_=array("p p"),
        coef_names_=words,
        coef_prior_mean_=array("p"),
        coef_prior_scale_=array("p", least=0.0),
        gains_=array("o"),
        gains_std_=array("o", least=0.0),
        noise_variance_=array("o", least=0.0),
        standing_std_=array("o"),
        residual_std_=array("o", least=0.0),
        residual_models_=several(made(QuietRegressor) | nothing),
        n_iter_=integer(0),
        correlation_time_=array("o", above=0.0),
        inflation_=real(least=1.0),
        stiction_velocity_=array("o", above=0.0),
    ),
    estimator(LBFGS),
    estimator(Adam),
]

RECORDS: list[Record] = [*of_kernels.RECORDS, *_FITS, *_NETWORK, *_ESTIMATORS]
