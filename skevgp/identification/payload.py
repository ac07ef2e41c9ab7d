"""What a robot carries, by torques with it and a model without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from sklearn.utils import Bunch

from .weights import Known, Prior, Rows, identify

# Half of the width of an interval that holds 95 % of a normal distribution, in standard deviations.
_95 = 1.959963984540054


def payload_prior(prior: Prior, mass_scale: float, size: float) -> Prior:
    """The prior of the robot alone, and a body of ten parameters of which hardly anything is known.

    Parameters
    ----------
    prior : Prior
        Of the robot.
    mass_scale : float
        Standard deviation of the body's mass, kg; the prior mean is 0.
    size : float
        m: first moments have that times mass_scale, moments of inertia once more.

    Returns
    -------
    prior : Prior
        The body's parameters follow the weights; gains are last.
    """
    p, total = len(prior.scaled), len(prior.mean)
    robot = np.concatenate([np.arange(p), np.arange(p + 10, total + 10)])
    mean, covariance = np.zeros(total + 10), np.zeros((total + 10, total + 10))
    mean[robot] = prior.mean
    covariance[np.ix_(robot, robot)] = prior.covariance
    body = mass_scale * np.concatenate([[1.0], np.full(3, size), np.full(6, size**2)])
    covariance[range(p, p + 10), range(p, p + 10)] = body**2
    return replace(prior, mean=mean, covariance=covariance, scaled=np.append(prior.scaled, np.ones(10, dtype=bool)))


def find_payload(
    rows: Rows, link: int, prior: Prior, known: Known, residual: Callable[[np.ndarray], np.ndarray], rounds: int = 2
) -> Bunch:
    """The body that explains what a robot's torques have more than its model.

    Parameters
    ----------
    rows : Rows
        With the payload; features of the robot alone.
    link : int
        From 0, that it is fixed to.
    prior : Prior
        `payload_prior`.
    known : Known
        What rows without the payload said: weights and gains are found anew from both, for their product is what
        either knows.
    residual : callable
        Torques (n, o) of the model -> what its Gaussian processes add.
    rounds : int
        The residual depends on the load, and the load on the residual.

    Returns
    -------
    payload : Bunch
    """
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
