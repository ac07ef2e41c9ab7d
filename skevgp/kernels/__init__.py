"""Covariance functions: scikit-learn's kernels, and a user's own."""

# Each family registers its kernels where it is defined.
from . import constant, cosine, dot_product, function, periodic, stationary  # noqa: F401
from .base import known_kernels
from .cosine import Cosine
from .function import FunctionKernel

__all__ = ["Cosine", "FunctionKernel"]

__doc__ = f"{__doc__}\n\nThe argument ``kernel`` of the regressors takes {known_kernels()}.\n"
