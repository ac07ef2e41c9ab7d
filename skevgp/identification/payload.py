"""The payload of a robot, from torques with it and a model without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from sklearn.utils import Bunch

from .weights import Known, Prior, Rows, identify, with_others

# Half width of the 95 % interval of a normal distribution, in standard deviations.
_95 = 1.959963984540054


def payload_prior(prior: Prior, mass_scale: float, size: float) -> Prior:
    """Add a body with ten nearly unknown parameters to the prior of a robot, between its weights and its gains."""
    # The mass has mean 0 and standard deviation mass_scale (kg). First moments have size (m) times that, and moments of
    # inertia size² times that.
    body = mass_scale * np.concatenate([[1.0], np.full(3, size), np.full(6, size**2)])
    return with_others(prior, body**2, scaled=True)


def find_payload(
    rows: Rows, link: int, prior: Prior, known: Known, residual: Callable[[np.ndarray], np.ndarray], rounds: int = 2
) -> Bunch:
    """Identify the body on a link (from 0) from rows with the payload, given rows without it as ``known``."""
    # Weights and gains are identified again from both logs, because each log determines their product only. residual
    # returns the Gaussian processes' part of torques (n, o) of the model. It depends on the load, and the load depends
    # on it, so that there are several rounds.
    body = rows.features[:, :, 10 * link : 10 * link + 10]
    carried = replace(rows, features=np.concatenate([rows.features, body], axis=2))
    nothing = np.zeros((*known.targets.shape, 10))
    known = known._replace(features=np.concatenate([known.features, nothing], axis=2))
    weights = identify(carried, prior, known=known)
    for _ in range(rounds):
        missed = residual(weights.predict(carried.features))
        weights = identify(replace(carried, targets=rows.targets - missed), prior, start=weights, known=known)
    p = weights.n_weights
    of = slice(p - 10, p)
    return _described(weights.mean[of], weights.covariance[of, of])


def _described(parameters: np.ndarray, covariance: np.ndarray) -> Bunch:
    mass, std = float(parameters[0]), float(np.sqrt(covariance[0, 0]))
    com, com_std = np.full(3, np.nan), np.full(3, np.inf)
    if mass > 0.0:
        com = parameters[1:4] / mass
        slopes = np.column_stack([-com / mass, np.eye(3) / mass])  # of the quotient, to first order
        com_std = np.sqrt(np.diag(slopes @ covariance[:4, :4] @ slopes.T))
    return Bunch(
        mass=mass,
        mass_std=std,
        mass_interval=(mass - _95 * std, mass + _95 * std),
        com=com,
        com_std=com_std,
        parameters=parameters,
        covariance=covariance,
    )
