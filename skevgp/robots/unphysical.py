"""Links whose inertia no body can have, and whether a robot moves by the laws of mechanics all the same."""

from __future__ import annotations

from collections.abc import Container
from typing import Any

import numpy as np

from ..utils.optional import require

# Files round moments of inertia. A violation below this share of the largest one is due to that.
_ROUNDED = 5e-3
# Rounding of sums in double precision, as a share of all masses times the squared size of the robot.
_ROUNDING = 1e-12
# Eigenvalues of a mass matrix below minus this share of the largest one are negative.
_NEGATIVE = 1e-12
_N_CONFIGURATIONS = 300
_UNLIMITED = np.pi  # rad or m, where a joint has no limits
_MOST_NAMED = 3
_MEND = (
    "Correct <inertia> of the link; or estimate it from torques, by InverseDynamics(robot, consistent=True).fit(X, y) "
    "and its write_urdf(path), which writes inertias that bodies can have."
)


def check_bodies(model: Any, called: str, links: list[list[str]], possible_links: Container[str] = ()) -> list[str]:
    """What is wrong with the inertias of a model's links.

    A body has a mass of 0 or above. Its moments of inertia about the centre of mass are 0 or above, and none is larger
    than the sum of the other two. A mass matrix can only have a negative eigenvalue if a moment is negative. In this
    case, mass matrices of many configurations within the joints' limits are computed.

    Parameters
    ----------
    model : pinocchio.Model
        With one position and one velocity per joint, and finite numbers.
    called : str
        With which messages begin.
    links : list of list of str
        Names of the links that move with each joint, as far as they are known.
    possible_links : container of str, default=()
        Names of the links whose inertia is physical up to the rounding of its digits. Bodies made of such links cause
        no warning.

    Returns
    -------
    warnings : list of str
        A sentence or none.

    Raises
    ------
    ValueError
        If a moment of inertia is negative and a mass matrix has a negative eigenvalue. Moments that a file rounded to
        below 0 are no exception.
    """
    bodies = list(model.inertias)[1:]
    moments = np.array([np.linalg.eigvalsh(body.inertia) for body in bodies])
    masses = np.array([body.mass for body in bodies])
    of_sums = _ROUNDING * masses.sum() * _size(model) ** 2
    negative = moments[:, 0] < -of_sums
    q = _configuration_of_negative_mass(model) if negative.any() else None
    lacking = moments[:, 0] + moments[:, 1] - moments[:, 2]  # below 0 too if a moment is
    without_mass = (masses == 0.0) & (moments != 0.0).any(axis=1)
    rounded = [bool(names) and all(name in possible_links for name in names) for names in links]
    impossible = (lacking < -np.maximum(_ROUNDED * np.abs(moments).max(axis=1), of_sums)) & ~np.array(rounded)
    impossible |= without_mass
    wrong = np.flatnonzero(impossible if q is None else impossible | negative).tolist()
    told = [_sentence(model.names[1 + joint], links[joint], masses[joint], moments[joint]) for joint in wrong]
    more = [f"{len(told) - _MOST_NAMED} more links are like it"] if len(told) > _MOST_NAMED else []
    reason = "; ".join(told[:_MOST_NAMED] + more)
    if q is not None:
        raise ValueError(
            f"{called} has a mass matrix that is not positive definite, at q = {np.round(q, 3).tolist()}: a joint that "
            f"is pushed would move the other way. No body can have the inertia of a link: {reason}. {_ALLOWED} Correct "
            "<inertia> of the link."
        )
    if not told:
        return []
    found = ""
    if negative.any():
        found = f" (No mass matrix has a negative eigenvalue in {_N_CONFIGURATIONS} configurations that were tried.)"
    return [f"{called} has a link whose inertia no body can have: {reason}. {_ALLOWED} {_MEND}{found}"]


_ALLOWED = (
    "Each must be 0 or above, no larger than the sum of the other two (triangle inequality), and 0 without a mass."
)


def _sentence(joint: str, links: list[str], mass: float, moments: np.ndarray) -> str:
    link = f"that of the joint {joint!r}"
    if links:
        link = f"{links[0]!r} of the joint {joint!r}"
    if links[1:]:
        link += f", with what is fixed to it ({', '.join(map(repr, links[1:4]))}{', ...' if links[4:] else ''}),"
    return f"{link} has {mass:.3g} kg and moments (eigenvalues) of {', '.join(f'{m:.3g}' for m in moments)} kg m²"


def _size(model: Any) -> float:
    """How far a centre of mass or a joint may be from the base at most, or one part of it from another."""
    placements = sum(np.linalg.norm(place.translation) for place in list(model.jointPlacements)[1:])
    return float(placements + max(np.linalg.norm(body.lever) for body in list(model.inertias)[1:]))


def _configuration_of_negative_mass(model: Any) -> np.ndarray | None:
    """Where the mass matrix has a negative eigenvalue, if that is found."""
    pin, data = require("pinocchio", "Rigid-body dynamics"), model.createData()
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    known = (lower < upper) & (np.abs([lower, upper]) < 1e6).all(axis=0)
    lower, upper = np.where(known, lower, -_UNLIMITED), np.where(known, upper, _UNLIMITED)
    share = np.random.RandomState(0).uniform(size=(_N_CONFIGURATIONS - 1, model.nq))
    for q in [np.clip(np.zeros(model.nq), lower, upper), *(lower + share * (upper - lower))]:
        upper_half = np.triu(pin.crba(model, data, q))
        eigenvalues = np.linalg.eigvalsh(upper_half, UPLO="U")
        if eigenvalues[0] < -_NEGATIVE * np.abs(eigenvalues).max():
            return q
    return None
