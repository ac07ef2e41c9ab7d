"""From scikit-learn kernels to covariances that a fit can differentiate, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from sklearn.base import clone
from sklearn.gaussian_process import kernels as sk

from .base import READERS, Covariance, Product, Sum, known_kernels
from .function import FunctionKernel

# Limits of values whose squares neither vanish nor overflow.
SMALLEST, LARGEST = 1e-100, 1e100


@dataclass(frozen=True)
class Start:
    """Start, bounds and fixed entries of a positive parameter; None is chosen from the data."""

    value: np.ndarray | None = None  # (n,)
    bounds: np.ndarray | None = None  # (n, 2)
    fixed: bool | np.ndarray = False  # of all, or (n,)


@dataclass(frozen=True)
class Starts:
    """Starts of the hyperparameters of k̃, of s² and of σ²; the latter two are the same for all outputs."""

    hyperparameters: Start
    signal: Start
    noise: Start


@dataclass(frozen=True)
class KernelSpec:
    """A user's kernel, read: k = s² k̃ (+ noise)."""

    covariance: Covariance  # k̃
    starts: Starts  # σ² is that of a WhiteKernel in the outermost sum
    tree: sk.Kernel  # s² k̃
    signal: sk.Kernel  # the ConstantKernel in the tree that is s²
    given: sk.Kernel | None = None  # the user's kernel, if it was one
    stays: bool = False  # whether nothing is learned, so that the fitted kernel is exactly the tree

    def with_noise(self, noise_variance: float, fixed: bool = False) -> KernelSpec:
        """Return the same kernel with a start of the noise, which may be fixed."""
        value = np.array([float(noise_variance)])
        noise = Start(value, np.array([[value[0], value[0]]]), np.ones(1, dtype=bool)) if fixed else Start(value)
        return replace(self, starts=replace(self.starts, noise=noise))

    def as_given(self) -> KernelSpec:
        """Return the same kernel without learning; values that the user did not give are 1."""
        starts = self.starts
        shape, signal = starts.hyperparameters, starts.signal
        if shape.value is None:
            shape = Start(np.ones(self.covariance.n_hyperparameters))
        starts = Starts(shape, Start(np.ones(1)) if signal.value is None else signal, starts.noise)
        return replace(self, starts=starts, stays=True)

    def to_sklearn(
        self, hyperparameters: np.ndarray, hyper_bounds: np.ndarray, signal: float, signal_bounds: np.ndarray
    ) -> sk.Kernel:
        """Return the fitted s² k̃ as a scikit-learn kernel of the user's form, with the user's bounds."""
        if self.stays:
            return clone(self.tree)
        rows = iter(np.column_stack([hyperparameters, hyper_bounds]))

        def fitted(kernel: sk.Kernel) -> sk.Kernel:
            if isinstance(kernel, sk.KernelOperator):
                return type(kernel)(fitted(kernel.k1), fitted(kernel.k2))
            if kernel is self.signal:
                return _fitted(kernel, iter([(signal, *signal_bounds[0])]), self.starts.signal.bounds is None)
            return _fitted(kernel, rows, self.starts.hyperparameters.bounds is None)

        return fitted(self.tree)

    @property
    def order(self) -> np.ndarray:
        """Indices with theta = ``np.log(numbers[order])`` for numbers (hyperparameters of k̃, s²)."""
        return self._order_in(self.tree)

    @property
    def adds_signal(self) -> bool:
        """Whether s² is not one of the constants in the user's kernel."""
        return self.given is None or all(part is not self.signal for part in _simple_kernels(self.given))

    @property
    def given_order(self) -> np.ndarray:
        """Indices as `order`, for theta of the user's kernel in (hyperparameters of k̃, s², σ²)."""
        return self._order_in(self.tree if self.given is None else self.given)

    def at_bounds(self, hyperparameters: np.ndarray, signal: float, noise: float) -> list[str]:
        """List the warnings of GaussianProcessRegressor on parameters of the user's kernel that are at their bounds."""
        if self.given is None:
            return []
        theta = np.log(np.append(hyperparameters, [signal, noise]))[self._order_in(self.given)]
        at_bound = iter(np.isclose(self.given.bounds, theta[:, np.newaxis]))
        return [
            f"The optimal value found for dimension {dimension} of parameter {parameter.name} is close to the "
            f"specified {side} bound {parameter.bounds[dimension, column]}. {change} the bound and calling fit again "
            "may find a better value."
            for parameter in self.given.hyperparameters
            if not parameter.fixed
            for dimension, at in zip(range(parameter.n_elements), at_bound, strict=False)
            for column, (side, change) in enumerate((("lower", "Decreasing"), ("upper", "Increasing")))
            if at[column]
        ]

    def _order_in(self, tree: sk.Kernel) -> np.ndarray:
        """Return indices of a tree's theta in (hyperparameters of k̃, s², σ²)."""
        n_hyper = self.covariance.n_hyperparameters
        following, order = iter(range(n_hyper)), list[int]()
        for kernel in _simple_kernels(tree):
            for hyperparameter in kernel.hyperparameters:
                if kernel is self.signal or type(kernel) is sk.WhiteKernel:
                    indices = [n_hyper if kernel is self.signal else n_hyper + 1]
                else:
                    indices = list(islice(following, hyperparameter.n_elements))
                order += [] if hyperparameter.fixed else indices
        return np.array(order, dtype=int)


def _simple_kernels(tree: Any) -> Iterator[Any]:
    """Yield the leaves of a tree from left to right, in the order of theta."""
    if isinstance(tree, sk.KernelOperator):
        yield from _simple_kernels(tree.k1)
        yield from _simple_kernels(tree.k2)
    else:
        yield tree


def _fitted(kernel: sk.Kernel, rows: Iterator[Any], set_bounds: bool) -> sk.Kernel:
    """Copy a simple kernel with values (and bounds) from the next rows (value, lower, upper)."""
    fitted = clone(kernel)
    for hyperparameter in kernel.hyperparameters:
        numbers = np.array(list(islice(rows, hyperparameter.n_elements)))
        values, bounds = numbers[:, 0], numbers[:, 1:]
        # Fixed parameters keep all their digits.
        if not hyperparameter.fixed:
            is_scalar = len(values) == 1
            fitted.set_params(**{hyperparameter.name: float(values[0]) if is_scalar else values})
            if set_bounds:
                fitted.set_params(
                    **{f"{hyperparameter.name}_bounds": tuple(bounds[0].tolist()) if is_scalar else bounds}
                )
    return fitted


def parse_kernel(kernel: sk.Kernel | Callable[..., Any] | None, n_columns: int) -> KernelSpec:
    """Read a scikit-learn kernel or a function of inputs (n, n_columns); None is an RBF with starts from the data."""
    signal = sk.ConstantKernel()
    if kernel is None:
        shape = sk.RBF(np.ones(n_columns) if n_columns > 1 else 1.0)
        return KernelSpec(READERS[sk.RBF](shape, n_columns), Starts(Start(), Start(), Start()), signal * shape, signal)
    if callable(kernel) and not isinstance(kernel, sk.Kernel | type):
        kernel = FunctionKernel(kernel)
    if not isinstance(kernel, sk.Kernel):
        raise TypeError(
            "kernel must be a kernel of sklearn.gaussian_process.kernels, a function k(X, Z) in autograd.numpy, or "
            f"None; got {kernel!r}. These work: {known_kernels()}."
        )
    # Raises TypeError if it is no kernel, and ValueError if a part is not supported or a value or bound is out of
    # range. A copy, because the same kernel object may be in a tree twice.
    given = clone(kernel)
    tree, noise = _without_noise(given)
    if tree is None or len(noise) > 1:
        said = "it has no other term" if tree is None else f"there are {len(noise)}"
        raise ValueError(f"kernel={kernel!r} may have one WhiteKernel, in a sum with another term; {said}.")
    constant = _outermost_constant(tree)
    signal_start = Start()
    if constant is None:
        tree = signal * tree
    else:
        signal, signal_start = constant, _starts(constant)
    starts: list[Start] = []
    covariance = _covariance(tree, signal, n_columns, starts)
    assert covariance is not None
    return KernelSpec(
        covariance,
        Starts(_joined(starts), signal_start, _starts(noise[0]) if noise else Start()),
        tree,
        signal,
        given,
    )


def _without_noise(kernel: Any) -> tuple[Any, list[Any]]:
    """Split off the WhiteKernels of the outermost sum; the rest is None if there is nothing else."""
    if isinstance(kernel, sk.WhiteKernel):
        return None, [kernel]
    if type(kernel) is not sk.Sum:
        return kernel, []
    (first, noise), (second, more_noise) = _without_noise(kernel.k1), _without_noise(kernel.k2)
    if first is None or second is None:
        return (second if first is None else first), noise + more_noise
    return sk.Sum(first, second), noise + more_noise


def _outermost_constant(kernel: Any) -> Any:
    """Find the ConstantKernel that multiplies everything else within the fewest products; None if there is none."""
    level = [kernel]
    while level := [part for product in level if type(product) is sk.Product for part in (product.k1, product.k2)]:
        for part in level:
            if type(part) is sk.ConstantKernel:
                return part
    return None


def _covariance(kernel: Any, signal: Any, n_columns: int, starts: list[Start]) -> Covariance | None:
    """Return the covariance of (part of) a tree, None for s²; appends the starts of its hyperparameters."""
    if kernel is signal:
        return None
    if type(kernel) in (sk.Sum, sk.Product):
        kind = Sum if type(kernel) is sk.Sum else Product
        operands = _operands(kernel, type(kernel))
        parts = [part for operand in operands if (part := _covariance(operand, signal, n_columns, starts)) is not None]
        return kind(tuple(parts)) if len(parts) > 1 else parts[0]
    if type(kernel) not in READERS:
        raise ValueError(
            f"kernel: {type(kernel).__name__} does not work in this place, as {kernel!r}. These work: "
            f"{known_kernels()}."
        )
    covariance = READERS[type(kernel)](kernel, n_columns)
    starts.append(_starts(kernel))
    return covariance


def _operands(kernel: Any, operator: Any) -> Iterator[Any]:
    """Yield the operands of nested sums (or products) from left to right."""
    if type(kernel) is operator:
        yield from _operands(kernel.k1, operator)
        yield from _operands(kernel.k2, operator)
    else:
        yield kernel


def _starts(kernel: sk.Kernel) -> Start:
    """Return checked values and bounds of a simple kernel's hyperparameters."""
    values = kernel.get_params()
    return _joined([_start(hyperparameter, values[hyperparameter.name]) for hyperparameter in kernel.hyperparameters])


def _start(hyperparameter: sk.Hyperparameter, value: Any) -> Start:
    """Return the checked value and bounds of a hyperparameter."""
    value = np.atleast_1d(np.asarray(value, dtype=float))
    if not ((value >= SMALLEST) & (value <= LARGEST)).all():
        raise ValueError(f"kernel: {hyperparameter.name} must be between {SMALLEST:g} and {LARGEST:g}; got {value}.")
    if hyperparameter.fixed:
        return Start(value, np.column_stack([value, value]), np.ones(len(value), dtype=bool))
    try:
        bounds = np.broadcast_to(np.atleast_2d(hyperparameter.bounds), (len(value), 2)).astype(float)
    except ValueError as error:
        raise ValueError(
            f"kernel: {hyperparameter.name}_bounds must be 'fixed' or pairs of numbers; got {hyperparameter.bounds!r}."
        ) from error
    if not ((bounds[:, 0] > 0.0) & (bounds[:, 0] <= bounds[:, 1])).all():
        raise ValueError(
            f"kernel: {hyperparameter.name}_bounds must be above 0, the lower ones first; got {bounds.tolist()}."
        )
    return Start(value, bounds, np.zeros(len(value), dtype=bool))


def _joined(starts: list[Start]) -> Start:
    """Concatenate several starts."""
    return Start(
        np.concatenate([np.empty(0), *(start.value for start in starts)]),
        np.concatenate([np.empty((0, 2)), *(start.bounds for start in starts)]),
        np.concatenate([np.empty(0, dtype=bool), *(start.fixed for start in starts)]),
    )
