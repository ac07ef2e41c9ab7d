"""The contract's own parts: sums side by side, prepared rows, sums and products of covariances."""

import numpy as np
import pytest

from skevgp.kernels.base import CentredSquares, Product, Sum, Sums, as_they_are, no_columns
from skevgp.kernels.constant import Constant
from skevgp.kernels.dot_product import DotProduct
from skevgp.kernels.stationary import Matern32, SquaredExponential, Stationary

from .cases import X, Z

CENTRE = np.array([3.0, -2.0])
RBF, MATERN = SquaredExponential(2), Stationary(Matern32(), 2, isotropic=True)


def test_sums_add_side_by_side():
    total = Sums((np.ones(2), Sums((1.0, np.zeros(3)))))
    total += Sums((np.ones(2), Sums((2.0, np.ones(3)))))
    assert total[1][0] == 3.0
    np.testing.assert_array_equal(total[0], [2.0, 2.0])
    np.testing.assert_array_equal(total[1][1], [1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("covariance", "preparations"),
    [
        (Sum((RBF, MATERN)), (CentredSquares(),)),
        (Sum((RBF, Product((DotProduct(), MATERN)))), (CentredSquares(), as_they_are)),
        (Product((DotProduct(), Sum((RBF, DotProduct())), Constant())), (as_they_are, CentredSquares(), no_columns)),
    ],
)
def test_sums_share_prepared_rows(covariance, preparations):
    assert covariance.preparations == preparations
    centred = covariance.centred(CENTRE)
    assert {CentredSquares((3.0, -2.0))} | set(preparations) - {CentredSquares()} == set(centred.preparations)
    # What the cache of blocks counts: each of them once.
    prepared = centred.prepare(X) if len(preparations) > 1 else (centred.prepare(X),)
    assert sum(each.nbytes for each in prepared) == X.nbytes * (as_they_are in preparations) + 5 * 40 * 8


@pytest.mark.parametrize(
    "covariance",
    [
        Sum((RBF, Product((DotProduct(), MATERN)), Constant())),
        Product((Sum((DotProduct(), RBF)), Sum((RBF, DotProduct(), Constant())))),
        Product((Sum((Constant(), Constant())), Constant())),
    ],
)
@pytest.mark.parametrize("centre", [None, CENTRE])
def test_sums_and_products_are_those_of_the_parts(covariance, centre):
    hyperparameters = np.linspace(0.6, 1.6, covariance.n_hyperparameters)
    if centre is not None:
        covariance = covariance.centred(centre)

    def alone(one, own):
        """One part's values, by its own prepared rows."""
        if not isinstance(one, Sum | Product):
            at, prepared = one.at(own, Z), one.prepare(X)
            return at.matrix(), at.cross(prepared), np.broadcast_to(at.diagonal(prepared), 40)
        ends = np.cumsum([part.n_hyperparameters for part in one.parts])[:-1]
        values = [alone(*part) for part in zip(one.parts, np.split(own, ends), strict=True)]
        combine = np.sum if isinstance(one, Sum) else np.prod
        return tuple(combine(np.array(same), axis=0) for same in zip(*values, strict=True))

    at, prepared = covariance.at(hyperparameters, Z), covariance.prepare(X)
    found = at.matrix(), at.cross(prepared), np.broadcast_to(at.diagonal(prepared), 40)
    for actual, expected in zip(found, alone(covariance, hyperparameters), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-13)
