"""How maps are written down: ours, and scikit-learn's common ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from sklearn import compose, decomposition, impute, kernel_approximation, pipeline, preprocessing

from ..features.angles import AngleEncoder
from ..features.gravity import GravityMap, Lever, LinkGravity, Links, SineGravity
from ..features.newton import InertiaForce, InertiaForceGravity
from ..features.nominal import NominalDynamics
from ..features.rigid_body import RigidBodyRegressor
from ..robots.numbers import JOINTS, RobotNumbers
from ..robots.rigid_body import RigidBody
from ..robots.systems import GravityTerm, Layout, Link, System
from ..utils.frames import FrameColumns
from .fields import anything, array, flag, integer, made, mapping, nothing, one_of, real, row, several, text, words
from .records import Record, bare, estimator, plain, state_of

_INPUTS = {"n_features_in_": integer(1), "feature_names_in_": words}
_INDICES = several(integer(0), tuple)

# --- ours --------------------------------------------------------------------------------------------------------

_VECTOR = row(real(), real(), real())
_OF_ROBOT = {**_INPUTS, "_layout": made(Layout), "_timed": flag}


def _rigid_body_regressor() -> Record:
    record = estimator(
        RigidBodyRegressor,
        **_OF_ROBOT,
        _terms=several(text, tuple),
        _velocity=array("", above=0.0) | array("o", above=0.0),
        _body=made(RigidBody),
        model_=anything,
    )
    name = "_sklearn_auto_wrap_output_keys"

    def take(thing: Any) -> dict[str, Any]:
        return {key: value for key, value in state_of(thing).items() if key != name}

    def make(found: dict[str, Any]) -> Any:
        thing = record.make(found)
        if "_terms" in found:
            # As `fit` sets it.
            setattr(thing, name, {"transform"} if thing.robot is None else set())
        return thing

    return Record(record.name, record.kind, record.fields, record.may_lack, take, make)


_OURS = [
    plain(
        Link,
        name=text,
        kind=one_of("revolute", "prismatic"),
        axis=_VECTOR,
        mass=real(least=0.0),
        com=_VECTOR,
        inertia=_VECTOR,
        xyz=_VECTOR,
        rpy=_VECTOR,
        armature=real(least=0.0),
        damping=real(least=0.0),
        effort=real(least=0.0, finite=False),
    ),
    plain(GravityTerm, angle=_INDICES, acts_on=_INDICES),
    plain(System, name=text, links=several(made(Link), tuple), gravity=several(made(GravityTerm), tuple)),
    plain(
        Layout,
        name=text,
        position_names=several(text, tuple),
        driven=_INDICES,
        revolute=several(flag, tuple),
    ),
    Record(
        "RigidBody",
        RigidBody,
        {"model": made(RobotNumbers)},
        frozenset(),
        lambda body: body.__getstate__(),
        lambda found: RigidBody(found["model"].model()),
    ),
    plain(
        RobotNumbers,
        name=text,
        names=several(text),
        joints=several(one_of(*JOINTS)),
        parents=array("j", "i", least=0),
        axes=array("j 6"),
        placements=array("j 3 4"),
        inertias=array("l 13"),
        n_bodies=integer(1),
        gravity=array("6"),
        limits=mapping(array("...", finite=False)),
        frames=several(text),
        frame_numbers=array("f 3", "i", least=0),
        frame_placements=array("f 3 4"),
        frame_inertias=array("f 13"),
        configurations=mapping(array("...")),
    ),
    plain(FrameColumns, package=text, names=several(text), columns=several(array("n", "bifuOU", finite=False))),
    plain(Lever, link=integer(0), name=text, acts_on=_INDICES),
    bare(
        Links,
        _turns=array("j 1 1 1"),
        _parents=several(integer(-1)),
        _weight=array("1 1 3"),
        _fixed=array("j 1 3 3"),
        _cosine=array("j 1 3 3"),
        _sine=array("j 1 3 3"),
    ),
    estimator(InertiaForce, **_OF_ROBOT),
    estimator(InertiaForceGravity, **_OF_ROBOT, _gravity=made(GravityMap)),
    estimator(
        SineGravity,
        **_OF_ROBOT,
        outputs=nothing,
        _first=array("t", "i", least=0),
        _further=several(row(integer(0), integer(0))),
        _summed=array("t d"),
    ),
    estimator(
        LinkGravity,
        **_OF_ROBOT,
        _levers=several(made(Lever)),
        _links=made(Links),
        _columns=array("t", "i", least=0),
        _signs=array("t"),
    ),
    estimator(NominalDynamics, **_OF_ROBOT, _terms=several(text, tuple), _body=made(RigidBody)),
    _rigid_body_regressor(),
    estimator(
        AngleEncoder,
        **_OF_ROBOT,
        _angles=array("a", "i", least=0),
        _source=array("s", "i", least=0),
        _sines=array("a", "i", least=0),
        _cosines=array("a", "i", least=0),
        _of_others=array("s d"),
    ),
]

# --- scikit-learn's ----------------------------------------------------------------------------------------------

_COLUMN, _OPTIONAL = array("d"), array("d") | nothing
# What a map makes of a row takes memory.
_WIDTH = integer(0, 10**6)
_COUNT = real(least=0.0) | array("d", "if", least=0.0)
_POSITIVE = array("d", above=0.0) | nothing
_LISTS = several(array("...", "OUbif", finite=False))
_CATEGORIES = {
    **_INPUTS,
    "categories_": _LISTS,
    "_infrequent_enabled": flag,
    "_infrequent_indices": several(array("...", "i") | nothing),
    "_default_to_infrequent_mappings": several(array("...", "i") | nothing),
}


def _sk(kind: type, **attributes: Any) -> Record:
    return estimator(kind, f"sklearn.{kind.__name__}", **{**_INPUTS, **attributes})


_SPLINE = Record(
    "scipy.BSpline",
    BSpline,
    {
        "t": array("t"),
        "c": array("..."),
        "k": integer(0),
        "extrapolate": flag | one_of("periodic"),
        "axis": integer(0),
    },
    frozenset(),
    lambda spline: {name: getattr(spline, name) for name in ("t", "c", "k", "extrapolate", "axis")},
    lambda found: BSpline(**found),
)


def _random_state(found: dict[str, Any]) -> np.random.RandomState:
    state = np.random.RandomState()
    state.set_state(("MT19937", found["key"], found["position"], found["has_normal"], found["normal"]))
    return state


_RANDOM_STATE = Record(
    "numpy.RandomState",
    np.random.RandomState,
    {"key": array("624", "u"), "position": integer(0), "has_normal": integer(0), "normal": real()},
    frozenset(),
    lambda own: dict(zip(("key", "position", "has_normal", "normal"), own.get_state(legacy=True)[1:], strict=True)),
    _random_state,
)

_SCIKIT_LEARN = [
    _SPLINE,
    _RANDOM_STATE,
    _sk(pipeline.Pipeline),
    _sk(pipeline.FeatureUnion),
    _sk(
        compose.ColumnTransformer,
        _columns=several(anything),
        _transformer_to_input_indices=anything,
        _remainder=anything,
        sparse_output_=flag,
        transformers_=several(anything),
        output_indices_=anything,
    ),
    bare(
        compose.make_column_selector,
        "sklearn.make_column_selector",
        pattern=text | nothing,
        dtype_include=anything,
        dtype_exclude=anything,
    ),
    _sk(
        preprocessing.StandardScaler,
        n_samples_seen_=_COUNT,
        mean_=_OPTIONAL,
        var_=array("d", least=0.0) | nothing,
        scale_=_POSITIVE,
    ),
    _sk(
        preprocessing.MinMaxScaler,
        n_samples_seen_=_COUNT,
        scale_=_COLUMN,
        min_=_COLUMN,
        data_min_=_COLUMN,
        data_max_=_COLUMN,
        data_range_=_COLUMN,
    ),
    _sk(preprocessing.MaxAbsScaler, n_samples_seen_=_COUNT, max_abs_=_COLUMN, scale_=array("d", above=0.0)),
    _sk(preprocessing.RobustScaler, center_=_OPTIONAL, scale_=_POSITIVE),
    _sk(preprocessing.Normalizer),
    _sk(
        preprocessing.QuantileTransformer,
        n_quantiles_=integer(1),
        references_=array("q"),
        quantiles_=array("q d"),
    ),
    _sk(preprocessing.PowerTransformer, lambdas_=array("d"), _scaler=made(preprocessing.StandardScaler)),
    _sk(
        preprocessing.PolynomialFeatures,
        _min_degree=_WIDTH,
        _max_degree=_WIDTH,
        n_output_features_=_WIDTH,
        _n_out_full=_WIDTH,
    ),
    _sk(preprocessing.SplineTransformer, bsplines_=several(made(BSpline)), n_features_out_=_WIDTH),
    _sk(preprocessing.FunctionTransformer),
    _sk(
        preprocessing.OneHotEncoder,
        **_CATEGORIES,
        _drop_idx_after_grouping=array("d", "iO") | nothing,
        drop_idx_=array("d", "iO") | nothing,
        _n_features_outs=several(integer(0)),
    ),
    _sk(preprocessing.OrdinalEncoder, **_CATEGORIES, _missing_indices=anything),
    _sk(
        decomposition.PCA,
        _fit_svd_solver=text,
        mean_=array("d"),
        noise_variance_=real(finite=False),
        n_samples_=integer(1),
        n_components_=integer(1),
        components_=array("k d"),
        explained_variance_=array("k", finite=False),
        explained_variance_ratio_=array("k", finite=False),
        singular_values_=array("k", finite=False),
    ),
    _sk(
        impute.SimpleImputer,
        statistics_=array("d", "fO", finite=False),
        indicator_=nothing,
        _fit_dtype=anything,
        _fill_dtype=anything,
    ),
    _sk(
        kernel_approximation.RBFSampler,
        random_weights_=array("d k"),
        random_offset_=array("k"),
        _gamma=real(least=0.0),
        _n_features_out=_WIDTH,
    ),
]

RECORDS: list[Record] = [*_OURS, *_SCIKIT_LEARN]
