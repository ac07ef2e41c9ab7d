"""What skops has to trust to load fitted models."""

from __future__ import annotations

from . import of_maps, of_models

# Of predictors, which files of `save` make anew.
_MADE_ANEW = (
    "operator.itemgetter",
    "skevgp.model.statistics.Whitening",
    "skevgp.kernels.constant.ConstantAt",
    "skevgp.kernels.cosine.WaveAt",
    "skevgp.kernels.base.ProductAt",
    "skevgp.kernels.base.SumAt",
    "skevgp.kernels.base._Part",
    "skevgp.kernels.base._all_of_it",
    "skevgp.kernels.dot_product.DotProductAt",
    "skevgp.kernels.stationary.SquaredExponentialAt",
    "skevgp.kernels.stationary.StationaryAt",
)
# In some versions of scikit-learn and SciPy: inside ColumnTransformer, SplineTransformer and SimpleImputer.
_OF_SCIKIT_LEARN = (
    "numpy.dtype",
    "numpy.number",
    "scipy._lib.array_api_compat.numpy._aliases.asarray",
    "scipy.interpolate._bsplines._BSpline",
    "sklearn.compose._column_transformer._RemainderColsList",
)

TRUSTED_TYPES: list[str] = sorted(
    {
        *(f"{record.kind.__module__}.{record.kind.__qualname__}" for record in (*of_models.RECORDS, *of_maps.RECORDS)),
        *_MADE_ANEW,
        *_OF_SCIKIT_LEARN,
    }
)
"""Names of the types that ``skops.io.load(path, trusted=TRUSTED_TYPES)`` has to trust for a fitted model of skevgp: its
own, and those of scikit-learn, SciPy and NumPy that it is made of. None of them runs what a file says. Functions of
yours, such as that of a `skevgp.kernels.FunctionKernel`, and maps of yours are not among them:
``skops.io.get_untrusted_types(file=path)`` lists these.
"""
