"""Covariance functions: scikit-learn's kernels, and a user's own."""

from .function_kernel import FunctionKernel

__all__ = ["FunctionKernel"]
