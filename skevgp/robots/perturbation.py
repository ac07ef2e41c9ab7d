"""Inaccurate models of robots, for experiments."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.utils import check_random_state

from ..utils.validation import check_real
from .loading import Robot, known_robot, load_robot


def perturb_robot(robot: Robot, scale: float = 0.2, *, random_state: int | np.random.RandomState | None = None) -> Any:
    """Copy a robot's model with random errors of masses, centres of mass, inertias and armatures.

    Each mass, each coordinate of a centre of mass, each inertia and each armature is multiplied by an independent
    factor ``1 + scale * U(-1, 1)``. All moments of inertia of a link have the same factor, so that the link stays
    physical. Joints, damping and limits do not change.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model
        Robot as in `load_robot`. A model is not changed.
    scale : float, default=0.2
        Largest relative error, in [0, 1).
    random_state : int, RandomState instance or None, default=None
        Seed of the factors.

    Returns
    -------
    model : pinocchio.Model
        The perturbed copy, with the name of the original.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    ValueError, TypeError
        If ``scale`` is not a number in [0, 1), `load_robot` does not accept the robot, or the mass matrix of the
        perturbed robot is not positive definite.

    Warns
    -----
    RobotModelWarning
        If the model of the robot is unphysical, as in `load_robot`.

    See Also
    --------
    skevgp.features.NominalDynamics : Features from such a model.

    Examples
    --------
    >>> from skevgp.datasets import load_robot, perturb_robot
    >>> wrong = perturb_robot("acrobot", scale=0.2, random_state=0)
    >>> [round(link.mass, 3) for link in wrong.inertias[1:]]
    [1.02, 0.975]
    >>> [link.mass for link in load_robot("acrobot").inertias[1:]]
    [1.0, 1.0]
    """
    if check_real(scale, "scale", minimum=0.0) >= 1.0:
        raise ValueError(f"scale must be in [0, 1), so that masses stay positive; got {scale!r}.")
    rng = check_random_state(random_state)
    model = load_robot(robot).copy()
    factors = 1.0 + scale * rng.uniform(-1.0, 1.0, (model.nv, 6))
    for index, (mass, x, y, z, inertia, _) in enumerate(factors, start=1):
        link = model.inertias[index]
        link.mass, link.lever, link.inertia = mass * link.mass, link.lever * [x, y, z], inertia * link.inertia
    model.armature = model.armature * factors[:, 5]
    return known_robot(model)  # the same check without a second warning
