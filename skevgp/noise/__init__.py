"""Noise models for ``noise=`` of the regressors."""

from typing import Any

from .base import Noise
from .gaussian import Gaussian
from .student_t import StudentT

__all__ = ["Gaussian", "StudentT"]

# Noise models by their names for ``noise=``.
NOISES: dict[str, type[Noise]] = {"gaussian": Gaussian, "student-t": StudentT}


def as_noise(noise: Any) -> Noise:
    """Return the noise model for ``noise=``, with checked options; ValueError or TypeError if it is not valid."""
    if isinstance(noise, str) and noise in NOISES:
        return NOISES[noise]()
    kinds = tuple(NOISES.values())
    if not isinstance(noise, kinds):
        names = ", ".join(f'"{name}"' for name in NOISES)
        objects = ", ".join(f"skevgp.noise.{kind.__name__}(...)" for kind in kinds)
        raise ValueError(f"noise must be one of {names}, {objects}; got {noise!r}.")
    noise.check()
    return noise
