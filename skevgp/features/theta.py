"""Priors of the parameters θ of feature maps h(x; θ), such as a length or a Stribeck velocity.

A feature map with parameters has three methods and an attribute:

- ``theta_prior()`` returns a dict of names and priors;
- ``set_theta(theta)`` sets the values that ``transform`` uses, and stores them as ``theta_``;
- ``theta_jacobian(X)`` returns ∂h/∂θ of each row, (n, n_h, n_theta) or (n, n_outputs, n_h, n_theta).

The regressors find θ together with the other parameters of the model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from ..utils.validation import check_real

# Largest |z| of a value: further out, the probability of a bounded prior rounds to 0 or 1.
_FARTHEST = 6.0


class Prior(ABC):
    """The prior of a parameter, as a function of a coordinate z that is standard normal a priori."""

    def value(self, z: float) -> float:
        """Return the value of the parameter at a coordinate.

        Parameters
        ----------
        z : float
            Coordinate, which is 0 at the median and ±1 at one standard deviation of a normal variable.

        Returns
        -------
        value : float
            Value, in units of the parameter.
        """
        return self._value(z)

    def slope(self, z: float) -> float:
        """Return the derivative of the value in the coordinate.

        Parameters
        ----------
        z : float
            Coordinate.

        Returns
        -------
        slope : float
            Derivative, above 0.
        """
        return self._slope(z)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value.

        Parameters
        ----------
        value : float
            Value, in units of the parameter.

        Returns
        -------
        z : float
            Coordinate, the inverse of `value`.
        """
        return self._coordinate(value)

    @abstractmethod
    def _value(self, z: float) -> float: ...

    @abstractmethod
    def _slope(self, z: float) -> float: ...

    @abstractmethod
    def _coordinate(self, value: float) -> float: ...


@dataclass(frozen=True)
class Normal(Prior):
    """Normal prior of a parameter.

    Parameters
    ----------
    mean : float
        Mean, in units of the parameter.
    std : float
        Standard deviation, above 0.

    Raises
    ------
    ValueError, TypeError
        If a number is out of its range.

    Examples
    --------
    >>> from skevgp.features import Normal
    >>> Normal(0.0, 0.1)
    Normal(mean=0.0, std=0.1)
    """

    mean: float
    std: float

    def __post_init__(self) -> None:
        check_real(self.mean, "mean")
        check_real(self.std, "std", minimum=0.0, strict=True)

    def _value(self, z: float) -> float:
        return self.mean + self.std * z

    def _slope(self, z: float) -> float:
        return self.std

    def _coordinate(self, value: float) -> float:
        return (value - self.mean) / self.std


@dataclass(frozen=True)
class LogNormal(Prior):
    """Log-normal prior of a positive parameter.

    Parameters
    ----------
    median : float
        Median, in units of the parameter, above 0.
    sigma : float
        Standard deviation of the logarithm, above 0. A small value is about the relative uncertainty.

    Raises
    ------
    ValueError, TypeError
        If a number is out of its range.

    Examples
    --------
    A length of 0.5 m that is known to 20 %:

    >>> from skevgp.features import LogNormal
    >>> LogNormal(0.5, 0.2)
    LogNormal(median=0.5, sigma=0.2)
    """

    median: float
    sigma: float

    def __post_init__(self) -> None:
        check_real(self.median, "median", minimum=0.0, strict=True)
        check_real(self.sigma, "sigma", minimum=0.0, strict=True)

    def _value(self, z: float) -> float:
        return float(self.median * np.exp(self.sigma * z))

    def _slope(self, z: float) -> float:
        return self.sigma * self._value(z)

    def _coordinate(self, value: float) -> float:
        return float(np.log(value / self.median)) / self.sigma


@dataclass(frozen=True)
class Uniform(Prior):
    """Uniform prior of a parameter between two bounds.

    Parameters
    ----------
    low, high : float
        Bounds, in units of the parameter. The parameter stays between them.

    Raises
    ------
    ValueError, TypeError
        If a number is not finite, or ``low`` is not below ``high``.

    Examples
    --------
    >>> from skevgp.features import Uniform
    >>> Uniform(0.0, 0.05)
    Uniform(low=0.0, high=0.05)
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        check_real(self.low, "low")
        check_real(self.high, "high")
        if not self.low < self.high:
            raise ValueError(f"low={self.low!r} must be below high={self.high!r}.")

    def _value(self, z: float) -> float:
        # θ = low + (high - low) Φ(z): uniform if z is standard normal.
        return float(self.low + (self.high - self.low) * ndtr(np.clip(z, -_FARTHEST, _FARTHEST)))

    def _slope(self, z: float) -> float:
        z = np.clip(z, -_FARTHEST, _FARTHEST)
        return float((self.high - self.low) * np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi))

    def _coordinate(self, value: float) -> float:
        return float(np.clip(ndtri((value - self.low) / (self.high - self.low)), -_FARTHEST, _FARTHEST))


def is_positive(prior: Prior) -> bool:
    """Whether a prior keeps its parameter above 0."""
    return prior.value(-_FARTHEST) > 0.0


def check_prior(prior: object, name: str) -> None:
    """Raise a TypeError if a parameter has no prior."""
    if not isinstance(prior, Prior):
        raise TypeError(
            f"The parameter {name!r} has no prior: give it Normal(mean, std), LogNormal(median, sigma) or "
            f"Uniform(low, high) of skevgp.features; got {prior!r}."
        )
