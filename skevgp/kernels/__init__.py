"""Covariance functions: scikit-learn's kernels, and a user's own."""

from .cosine import Cosine
from .function import FunctionKernel
from .parse import WORKING

__all__ = ["Cosine", "FunctionKernel"]

__doc__ = f"{__doc__}\n\nThe argument ``kernel`` of the regressors takes {WORKING}.\n"
