"""What predictions of any fitted model are: finite, a distribution, the same for rows together or alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skevgp import BayesianMLPRegressor, ResidualRegressor

from .cases import assert_near, columns_of, data, fewer, fixed_cases, learned_cases, size_of

pytestmark = [
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
    pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning"),
]


def assert_a_distribution(model, case):
    """Finite; std >= 0, whose square is the diagonal of a covariance without negative eigenvalues."""
    size = size_of(model, case)
    for include_noise in (True, False):
        mean, std = model.predict(case.X_new, return_std=True, include_noise=include_noise)
        joint_mean, cov = model.predict(case.X_new, return_cov=True, include_noise=include_noise)
        for values in (mean, std, cov):
            assert np.isfinite(values).all()
        assert (std > 0.0).all() if include_noise else (std >= 0.0).all()
        assert_near(joint_mean, mean, size)
        cov = cov.reshape(len(mean), len(mean), -1)
        assert_near(np.einsum("iio->io", cov), columns_of(std) ** 2, size**2)
        assert_near(cov, cov.swapaxes(0, 1), size**2, 1e-12)
        _, all_of_it = model.predict(case.X_new, return_cov="joint", include_noise=include_noise)
        for matrix in (*np.moveaxis(cov, 2, 0), all_of_it):
            assert np.linalg.eigvalsh(matrix).min() >= -1e-8 * size**2
        together = all_of_it.reshape(*columns_of(mean).shape, *columns_of(mean).shape)
        assert_near(np.einsum("iojo->ijo", together), cov, size**2)


@given(fixed_cases())
def test_predictions_are_distributions(case):
    assert_a_distribution(case.fitted(), case)


@given(learned_cases())
def test_learned_models_predict_distributions(case):
    assert_a_distribution(case.fitted(), case)


@given(fixed_cases(), st.data())
def test_rows_are_predicted_alone_as_together(case, draws):
    model = case.fitted()
    size = size_of(model, case)
    chosen = draws.draw(st.lists(st.integers(0, len(case.X_new) - 1), min_size=1, max_size=8))
    mean, std = model.predict(case.X_new, return_std=True)
    some_mean, some_std = model.predict(case.X_new[chosen], return_std=True)
    assert_near(some_mean, mean[chosen], size, 1e-9)
    assert_near(some_std**2, std[chosen] ** 2, size**2, 1e-9)
    both = (case.X_new, case.X_new[chosen])
    cov, some_cov = (model.predict(rows, return_cov=True, include_noise=False)[1] for rows in both)
    assert_near(some_cov, cov[np.ix_(chosen, chosen)], size**2, 1e-9)


@given(fixed_cases(), st.integers(1, 3))
def test_samples_are_finite_and_repeat(case, n_samples):
    model = case.fitted()
    samples = model.sample_y(case.X_new, n_samples, random_state=1)
    assert samples.shape == (*model.predict(case.X_new).shape, n_samples)
    assert np.isfinite(samples).all()
    np.testing.assert_array_equal(samples, model.sample_y(case.X_new, n_samples, random_state=1))


@fewer(2)
@given(data(), st.booleans())
def test_other_regressors_predict_finite_numbers(rows, residual):
    X, Y, X_new = rows
    model = BayesianMLPRegressor((4,), max_iter=2, random_state=0)
    if residual:
        X = np.hstack([X, np.zeros((len(X), Y.shape[1]))])
        X_new = np.hstack([X_new, np.zeros((len(X_new), Y.shape[1]))])
        model = ResidualRegressor(model)
    model.fit(X, Y)
    mean, std = model.predict(X_new, return_std=True)
    assert np.isfinite(mean).all()
    assert np.isfinite(std).all()
    assert (std > 0.0).all()
