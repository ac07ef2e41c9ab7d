"""Models of the noise, for ``noise=`` of the regressors."""

from typing import Any

from .gaussian import Gaussian
from .student_t import StudentT

__all__ = ["Gaussian", "StudentT"]

# What the strings of ``noise=`` stand for.
NOISES: dict[str, type[Gaussian] | type[StudentT]] = {"gaussian": Gaussian, "student-t": StudentT}


def as_noise(noise: Any) -> Gaussian | StudentT:
    """Return the model of the noise that ``noise=`` names or is, with its options checked.

    Raises
    ------
    ValueError, TypeError
        If it is none, or an option is out of range.
    """
    if isinstance(noise, str) and noise in NOISES:
        return NOISES[noise]()
    kinds = tuple(NOISES.values())
    if not isinstance(noise, kinds):
        names = ", ".join(f'"{name}"' for name in NOISES)
        objects = ", ".join(f"skevgp.noise.{kind.__name__}(...)" for kind in kinds)
        raise ValueError(f"noise must be one of {names}, {objects}; got {noise!r}.")
    noise.check()
    return noise
