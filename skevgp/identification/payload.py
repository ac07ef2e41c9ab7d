"""The payload of a robot, from a log with it and a model without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from sklearn.utils import Bunch

from .weights import Known, Prior, Rows, identify, with_others

# Half width of the 95 % interval of a normal distribution, in standard deviations.
_95 = 1.959963984540054


def payload_prior(prior: Prior, n_effects: int, mass_scale: float, size: float) -> Prior:
    """Add effects of moves, and a body with ten parameters with a wide prior, to the prior of a robot."""
    # The mass has mean 0 and standard deviation mass_scale (kg). First moments have size (m) times that, and moments of
    # inertia size² times that.
    body = mass_scale * np.concatenate([[1.0], np.full(3, size), np.full(6, size**2)])
    return with_others(with_others(prior, np.ones(n_effects)), body**2, scaled=True)


def find_payload(
    rows: Rows,
    link: int,
    prior: Prior,
    known: Known,
    torque: np.ndarray,
    residual: Callable[[np.ndarray], np.ndarray],
    effects: Callable[[np.ndarray], np.ndarray],
    rounds: int = 2,
) -> Bunch:
    """Identify the payload on a link (from 0) from rows with it, given the condensed rows without it, known."""
    # Weights and gains are identified again from both logs, because each log determines only their product. Given a
    # torque without effects of moves, residual returns the part of the Gaussian processes in it (n, o), and effects the
    # columns (n, o, k) of a move's effects. Both depend on the load, and the estimate of the load depends on them. So
    # there are several rounds, which start with the torque (n, o) without the load. Each move and output has its own
    # effects, with weights N(0, I).
    body = rows.features[:, :, 10 * link : 10 * link + 10]
    moves, (n, n_outputs, _) = [rows.groups == move for move in np.unique(rows.groups)], rows.features.shape

    def with_load(torque: np.ndarray) -> Rows:
        own = effects(torque)
        columns = np.zeros((n, n_outputs, len(moves), n_outputs, own.shape[2]))
        for number, move in enumerate(moves):
            columns[move, :, number] = np.eye(n_outputs)[:, :, np.newaxis] * own[move][:, :, np.newaxis]
        features = np.concatenate([rows.features, columns.reshape(n, n_outputs, -1), body], axis=2)
        return replace(rows, features=features)

    carried = with_load(torque)
    others = carried.features.shape[2] - rows.features.shape[2]
    nothing = np.zeros((*known.targets.shape, others))
    known = known._replace(features=np.concatenate([known.features, nothing], axis=2))
    weights = identify(carried, prior, known=known)
    for _ in range(rounds):
        alike = carried.features.copy()
        alike[:, :, rows.features.shape[2] : -10] = 0.0
        torque = weights.predict(alike)
        carried = replace(with_load(torque), targets=rows.targets - residual(torque))
        weights = identify(carried, prior, start=weights, known=known)
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
