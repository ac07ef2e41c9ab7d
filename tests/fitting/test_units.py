import numpy as np
import pytest
import scipy.linalg

from skevgp.data.rows import LocalSource, Moments, RawRows
from skevgp.fitting.units import features_alone, may_hide_noise, noise_of_most_evidence, unit_of
from skevgp.model.predictor import CoefficientPrior


def weights_alone(H, r, scale):
    source = LocalSource.holding(RawRows(np.zeros((len(H), 1)), H, r))
    w, left_over = features_alone(
        source, np.zeros(len(scale)), CoefficientPrior(np.zeros_like(scale), scale, np.zeros_like(scale))
    )
    np.testing.assert_allclose(left_over, np.sqrt(np.mean((r - H @ (scale * w).T) ** 2, axis=0)), atol=1e-14)
    return w


def test_features_alone_are_least_squares_under_a_wide_prior():
    rng = np.random.RandomState(0)
    H, b = rng.randn(200, 3), np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]])
    r = H @ b.T + 1e-3 * rng.randn(200, 2)
    w = weights_alone(H, r, np.full((2, 3), 100.0))
    np.testing.assert_allclose(100.0 * w.T, np.linalg.lstsq(H, r, rcond=None)[0], atol=1e-8)


def powers_far_from_zero(n):
    """1, x and x² of x about 1e8, a feature that is always 0, and what a line through these x is."""
    x = 1e8 + np.random.RandomState(0).randn(n)
    return np.column_stack([np.ones(n), x, np.zeros(n), x**2]), x - 1e8


@pytest.mark.parametrize("scale", [1.0, 1e8])
def test_powers_of_a_column_far_from_zero_explain_what_the_column_does(scale):
    H, line = powers_far_from_zero(100)
    y = np.column_stack([line, 2.0 - line])
    w = weights_alone(H, y, np.full((2, 4), scale))
    # Beside the 1e-8 that a target of 1 keeps of a weight of 1 on a feature of 1e8.
    assert np.abs(y - H @ (scale * w).T).max() <= 1e-6
    assert np.abs(w[:, 2]).max() <= 1e-12


def test_decomposition_that_does_not_converge_is_tried_by_another_method(monkeypatch):
    rng = np.random.RandomState(0)
    H = rng.randn(60, 3)
    H = np.column_stack([H, H[:, 0] + 1e-9 * rng.randn(60)])
    r, scale = H @ np.ones((4, 1)) + rng.randn(60, 1), np.ones((1, 4))
    expected = weights_alone(H, r, scale)
    tried = []

    def by_halves_never(matrix, full_matrices, lapack_driver="gesdd"):
        tried.append(lapack_driver)
        if lapack_driver == "gesdd":
            raise np.linalg.LinAlgError("SVD did not converge")
        return scipy.linalg.svd(matrix, full_matrices=full_matrices, lapack_driver=lapack_driver)

    monkeypatch.setattr("skevgp.fitting.units.svd", by_halves_never)
    np.testing.assert_allclose(weights_alone(H, r, scale), expected, atol=1e-6)
    assert set(tried) == {"gesdd", "gesvd"}


@pytest.mark.parametrize(
    ("left_over", "targets", "from_features", "unit", "constant"),
    [
        (1e-20, [-1e5, 1e5], 0.0, 1e-9, False),  # features explain what varies
        (1e-20, [1e5, 1e5], 0.0, 1.0, True),
        (1e-20, [1e20, 1e20], 0.0, 1e6, True),
        (1e-9, [1e5, 1e5], 0.0, 1.0, True),
        (2e-9, [1e5, 1e5], 0.0, 2e-9, False),  # a prior mean that is not 0, and a weight that cannot move
        (1e-17, [0.0, 0.0], 5.0, 1.0, True),
        (1e-12, [0.0, 0.0], 5.0, 1e-12, False),
    ],
)
def test_unit_is_above_the_rounding_of_the_target_and_1_of_a_constant(
    left_over, targets, from_features, unit, constant
):
    moments = Moments.of(np.array(targets)[:, np.newaxis])
    found, is_constant = unit_of(np.array([left_over]), moments, np.array([from_features]))
    assert found[0] == pytest.approx(unit)
    assert is_constant[0] == constant


def test_features_may_hide_the_noise_where_they_are_many_or_weights_far_from_their_prior():
    def prior(p, reference):
        return CoefficientPrior(np.zeros((1, p)), np.ones((1, p)), np.full((1, p), reference))

    assert not may_hide_noise(prior(4, 1.0), 9)
    assert may_hide_noise(prior(5, 1.0), 9)
    assert may_hide_noise(prior(1, 4.0), 9)
    assert not may_hide_noise(prior(0, 0.0), 9)


def evidence_of(asked, peaks, plateau=0.0):
    """Of two outputs, highest at their peaks; flat below, but for rounding."""

    def evidence(noise):
        asked.append(noise)
        return np.where(noise < 1e-3 * peaks, plateau + 1e-12 * np.sin(noise), -(np.log10(noise / peaks) ** 2))

    return evidence


@pytest.mark.parametrize("shared", [False, True])
def test_likeliest_noise_is_found_beyond_where_the_evidence_is_flat(shared):
    peaks, asked = np.array([3e-2, 3e-2 if shared else 5.0]), []
    least, highest = np.full(2, 1e-14), np.full(2, 1e2)
    value, noise = noise_of_most_evidence(evidence_of(asked, peaks, -20.0), least, highest, shared)
    # To an eighth of a decade.
    assert (np.abs(np.log10(noise / peaks)) < 0.126).all()
    assert value > -2 * 0.126**2
    assert all(((tried >= least) & (tried <= highest)).all() for tried in asked)
    assert len(asked) < 30
