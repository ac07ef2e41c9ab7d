"""How kernels are written down: scikit-learn's, and what the inference makes of them."""

from __future__ import annotations

from sklearn.gaussian_process import kernels as sk

from ..kernels import base, constant, cosine, dot_product, periodic, stationary
from ..kernels.parse import KernelSpec, Start, Starts
from .fields import Field, array, flag, integer, made, nothing, one_of, real, row, several
from .records import Record, bare, plain

_LENGTH = real(above=0.0) | array("d", above=0.0) | several(real(above=0.0)) | row(real(above=0.0))
_END = real(least=0.0, finite=False)
_LIST = Field(
    "a list of two numbers from 0",
    lambda v, sizes: type(v) is list and len(v) == 2 and all(_END.holds(e, {}) for e in v),
)
_PAIR = row(_END, _END) | _LIST
_BOUNDS = (
    one_of("fixed")
    | _PAIR
    | several(_PAIR)
    | several(_PAIR, tuple)
    | array("d 2", least=0.0, finite=False)
    | array("2", least=0.0, finite=False)
)
TREE, COVARIANCE = made(sk.Kernel), made(base.Covariance)
_ROWS = made(base.CentredSquares)
_PROFILES = (
    stationary.Exponential,
    stationary.Matern12,
    stationary.Matern32,
    stationary.Matern52,
    stationary.RationalQuadratic,
    periodic.ExpSineSquared,
)

_SK_KERNELS = [
    bare(sk.ConstantKernel, "sklearn.ConstantKernel", constant_value=_LENGTH, constant_value_bounds=_BOUNDS),
    bare(sk.WhiteKernel, "sklearn.WhiteKernel", noise_level=_LENGTH, noise_level_bounds=_BOUNDS),
    bare(sk.RBF, "sklearn.RBF", length_scale=_LENGTH, length_scale_bounds=_BOUNDS),
    bare(
        sk.Matern, "sklearn.Matern", length_scale=_LENGTH, length_scale_bounds=_BOUNDS, nu=real(above=0.0, finite=False)
    ),
    bare(
        sk.RationalQuadratic,
        "sklearn.RationalQuadratic",
        length_scale=_LENGTH,
        alpha=_LENGTH,
        length_scale_bounds=_BOUNDS,
        alpha_bounds=_BOUNDS,
    ),
    bare(
        sk.ExpSineSquared,
        "sklearn.ExpSineSquared",
        length_scale=_LENGTH,
        periodicity=_LENGTH,
        length_scale_bounds=_BOUNDS,
        periodicity_bounds=_BOUNDS,
    ),
    bare(sk.DotProduct, "sklearn.DotProduct", sigma_0=_LENGTH, sigma_0_bounds=_BOUNDS),
    bare(sk.Sum, "sklearn.Sum", k1=TREE, k2=TREE),
    bare(sk.Product, "sklearn.Product", k1=TREE, k2=TREE),
    bare(cosine.Cosine, length_scale=_LENGTH, length_scale_bounds=_BOUNDS),
]

_OURS = [
    plain(base.CentredSquares, centre=several(real(), tuple)),
    plain(base.Sum, parts=several(COVARIANCE, tuple)),
    plain(base.Product, parts=several(COVARIANCE, tuple)),
    plain(constant.Constant, "Constant"),
    plain(dot_product.DotProduct, "DotProduct"),
    plain(cosine.Wave, n_columns=integer(1), isotropic=flag, rows=_ROWS),
    *(plain(profile, f"profiles.{profile.__name__}") for profile in _PROFILES),
    plain(stationary.Matern, "profiles.Matern", nu=real(above=0.0, finite=False)),
    plain(
        stationary.Stationary,
        profile=made(*_PROFILES, stationary.Matern),
        n_columns=integer(1),
        isotropic=flag,
        rows=_ROWS,
    ),
    plain(stationary.SquaredExponential, n_columns=integer(1), isotropic=flag, rows=_ROWS),
    plain(
        Start,
        value=array("n", above=0.0) | nothing,
        bounds=array("n 2", least=0.0, finite=False) | nothing,
        fixed=flag | array("n", "b"),
    ),
    plain(Starts, hyperparameters=made(Start), signal=made(Start), noise=made(Start)),
    plain(KernelSpec, covariance=COVARIANCE, starts=made(Starts), tree=TREE, signal=TREE, given=TREE | nothing),
]

RECORDS: list[Record] = [*_SK_KERNELS, *_OURS]
