"""Covariances in CasADi: k̃(X_m, x) and k̃(x, x) of one symbolic row x.

Distances that a root is taken of are kept from 0, so that no derivative, of any order that a solver asks for, is NaN
where x is an inducing point.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from math import factorial
from operator import add, mul
from typing import Any

import numpy as np

from ..utils.casadi import casadi
from . import profiles
from .constant import Constant
from .cosine import Wave
from .covariances import Covariance, Product, Sum
from .dot_product import DotProduct
from .stationary import Stationary

# Added to r² under a root: too little to change a value, enough to leave second derivatives their digits at r = 0.
_NEAR = 1e-18
# The least r² of exp(-r), which the former would change.
_COINCIDENT = 1e-60
# Of ν - ½: sums of so many terms.
_MOST_TERMS = 20


def cross_and_diagonal(kernel: Covariance, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
    """k̃(X_m, x) of shape (m, 1), and k̃(x, x).

    Parameters
    ----------
    kernel : Covariance
    hyperparameters : ndarray of shape (n_hyper,)
        Positive.
    points : ndarray of shape (m, d)
    x : casadi.MX of shape (d, 1)

    Returns
    -------
    cross, diagonal : casadi.MX or number

    Raises
    ------
    ValueError
        If a part of the kernel has no expression in CasADi; the message names it and lists those that do.
    """
    if isinstance(kernel, Sum | Product):
        ends = np.cumsum([part.n_hyperparameters for part in kernel.parts])[:-1]
        parts = [
            cross_and_diagonal(part, own, points, x)
            for part, own in zip(kernel.parts, np.split(hyperparameters, ends), strict=True)
        ]
        combine = add if isinstance(kernel, Sum) else mul
        cross, diagonal = (reduce(combine, each) for each in zip(*parts, strict=True))
        return cross, diagonal
    for kind, expression in _EXPRESSIONS.items():
        if isinstance(kernel, kind):
            return expression(kernel, hyperparameters, points, x)
    raise ValueError(f"The kernel {kernel!r} cannot be written in CasADi. {WORKING}")


def _constant(kernel: Constant, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
    ca = casadi()
    value = float(hyperparameters[0])
    return ca.DM.ones(len(points)) * value, value


def _dot_product(kernel: DotProduct, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
    ca = casadi()
    bias = float(hyperparameters[0]) ** 2
    return ca.mtimes(ca.DM(points), x) + bias, ca.sumsqr(x) + bias


def _wave(kernel: Wave, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
    ca = casadi()
    frequencies, centre = np.broadcast_to(2.0 * np.pi / hyperparameters, kernel.n_columns), _centre(kernel, points)
    return ca.cos(ca.DM((points - centre) @ frequencies) - ca.dot(ca.DM(frequencies), x - ca.DM(centre))), 1.0


def _stationary(kernel: Stationary, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, Any]:
    own, lengths = np.split(hyperparameters, [kernel.profile.n_parameters])
    lengths, centre = np.broadcast_to(lengths, kernel.n_columns), _centre(kernel, points)
    profile = _profile(kernel.profile)
    distance = _from_product if isinstance(kernel.profile, _WITHOUT_ROOT) else _from_differences
    return profile(distance((points - centre) / lengths, x, centre, lengths), own), 1.0


def _centre(kernel: Any, points: np.ndarray) -> np.ndarray:
    """What is subtracted, so that large coordinates cost no digits."""
    return np.array(kernel.rows.centre or np.zeros(points.shape[1]))


def _from_product(scaled: np.ndarray, x: Any, centre: np.ndarray, lengths: np.ndarray) -> Any:
    """r² of all points by one product, as predictions have it: linear in [x, x²], and its derivatives are small."""
    ca = casadi()
    offset, by = x - ca.DM(centre), lengths**-2.0
    factor = np.hstack([-2.0 * scaled / lengths, np.broadcast_to(by, scaled.shape)])
    return ca.mtimes(ca.DM(factor), ca.vertcat(offset, offset**2)) + ca.DM((scaled**2).sum(axis=1))


def _from_differences(scaled: np.ndarray, x: Any, centre: np.ndarray, lengths: np.ndarray) -> Any:
    """r² of all points, to the last digit where it is small."""
    ca = casadi()
    offset = (x - ca.DM(centre)) / ca.DM(np.array(lengths))
    return ca.sum2((ca.DM(scaled) - ca.repmat(offset.T, len(scaled), 1)) ** 2)


# --- profiles φ, of r² and of their own hyperparameters ------------------------------------------------------------

_Profile = Callable[[Any, np.ndarray], Any]


def _profile(profile: Any) -> _Profile:
    if isinstance(profile, profiles.Matern):
        return _half_integer(profile.nu)
    return _PROFILES[type(profile)]


def _exponential(squared: Any, own: np.ndarray) -> Any:
    ca = casadi()
    return ca.exp(-0.5 * squared)


def _rational_quadratic(squared: Any, own: np.ndarray) -> Any:
    ca = casadi()
    alpha = float(own[0])
    return ca.exp(-alpha * ca.log1p(squared / (2.0 * alpha)))


def _exp_sine_squared(squared: Any, own: np.ndarray) -> Any:
    ca = casadi()
    return ca.exp(-2.0 / float(own[0]) ** 2 * ca.sin(np.pi * ca.sqrt(squared + _NEAR)) ** 2)


def _matern12(squared: Any, own: np.ndarray) -> Any:
    ca = casadi()
    return ca.exp(-ca.sqrt(ca.fmax(squared, _COINCIDENT)))


def _matern32(squared: Any, own: np.ndarray) -> Any:
    ca = casadi()
    t = ca.sqrt(3.0 * (squared + _NEAR))
    return (1.0 + t) * ca.exp(-t)


def _matern52(squared: Any, own: np.ndarray) -> Any:
    ca = casadi()
    t2 = 5.0 * (squared + _NEAR)
    t = ca.sqrt(t2)
    return (1.0 + t + t2 / 3.0) * ca.exp(-t)


def _half_integer(nu: float) -> _Profile:
    """A Matérn covariance that is exp(-t) times a polynomial (Rasmussen & Williams 2006, eq. 4.16)."""
    n = int(nu - 0.5)
    if n != nu - 0.5 or n > _MOST_TERMS:
        raise ValueError(
            f"The kernel Matern(nu={nu:g}) cannot be written in CasADi, which has no Bessel functions: nu must be 0.5, "
            f"1.5, ... up to {_MOST_TERMS + 0.5:g}, or inf. {WORKING}"
        )
    first = factorial(n) / factorial(2 * n)
    coefficients = [first * factorial(n + i) / (factorial(i) * factorial(n - i)) * 2.0 ** (n - i) for i in range(n + 1)]

    def value(squared: Any, own: np.ndarray) -> Any:
        ca = casadi()
        t = ca.sqrt(2.0 * nu * (squared + _NEAR))
        return reduce(lambda total, coefficient: total * t + coefficient, coefficients) * ca.exp(-t)

    return value


_WITHOUT_ROOT = (profiles.Exponential, profiles.RationalQuadratic)
_PROFILES: dict[type, _Profile] = {
    profiles.Exponential: _exponential,
    profiles.RationalQuadratic: _rational_quadratic,
    profiles.ExpSineSquared: _exp_sine_squared,
    profiles.Matern12: _matern12,
    profiles.Matern32: _matern32,
    profiles.Matern52: _matern52,
}
_EXPRESSIONS: dict[type, Callable[[Any, np.ndarray, np.ndarray, Any], tuple[Any, Any]]] = {
    Constant: _constant,
    DotProduct: _dot_product,
    Wave: _wave,
    Stationary: _stationary,
}
# For people.
WORKING = (
    "These can be exported: RBF, Matern (nu of a half-integer), RationalQuadratic, ExpSineSquared, DotProduct, Cosine, "
    "ConstantKernel, sums and products of these."
)
