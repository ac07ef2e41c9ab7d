import numpy as np
import pytest

from skevgp.data.rows import LocalSource, Moments, RawRows, moments_of_rows
from skevgp.fitting.units import (
    LeastSquares,
    Units,
    features_alone,
    may_hide_noise,
    noise_of_most_evidence,
    unit_of,
)
from skevgp.model.predictor import CoefficientPrior


def source_of(H, y, precision=None):
    return LocalSource.holding(RawRows(np.zeros((len(H), 1)), H, y, precision, precision))


def units_alone(H, y, prior, precision=None):
    source = source_of(H, y, precision)
    _, features, targets = source.sum(moments_of_rows)
    return Units.of(source, features, targets, LeastSquares.of(source, np.zeros(y.shape[1])), prior)


def prior_of(scale, shared=False):
    return CoefficientPrior(np.zeros_like(scale), scale, np.zeros_like(scale), shared=shared)


def weights_alone(H, r, scale):
    units = units_alone(H, r, prior_of(scale))
    w = units.prior.reference
    left_over = np.sqrt(np.mean((r - H @ (scale * w).T) ** 2, axis=0))
    np.testing.assert_allclose(units.target_unit, left_over, atol=1e-14)
    return w


@pytest.fixture(params=["one pass", "pieces"])
def pieces(request, monkeypatch):
    """Sums over rows in one piece, or in pieces of 7 rows."""
    if request.param == "pieces":
        monkeypatch.setattr("skevgp.data.rows.PASS_ROWS", 7)


@pytest.mark.parametrize("n", [1, 3, 200])
@pytest.mark.parametrize("per_output", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_few_rows_replace_all_rows_in_least_squares(n, per_output, weighted, pieces):
    rng = np.random.RandomState(0)
    (o, p), mean = (2, 4), np.array([3.0, -1.0])
    H, y = rng.randn(n, o, p) if per_output else rng.randn(n, p), rng.randn(n, o) + mean
    precision = rng.uniform(0.1, 10.0, n) if weighted else None
    rows = LeastSquares.of(source_of(H, y, precision), mean)
    assert rows.triangles.shape[1] <= p + (1 if per_output else o)
    beta = rng.randn(o, p)
    left_over = y - mean - np.einsum("nop,op->no", H if per_output else np.stack([H] * o, axis=1), beta)
    expected = np.average(left_over**2, axis=0, weights=precision) * (precision.sum() if weighted else n)
    np.testing.assert_allclose(np.sum(rows.left_over(beta) ** 2, axis=1), expected, rtol=1e-12)


@pytest.mark.parametrize("per_output", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_features_alone_are_ridge_regression(per_output, shared, pieces):
    """By normal equations: the noise is first negligible, and then the mean squared residual."""
    rng = np.random.RandomState(0)
    n, o, p = 200, 2, 4
    H = rng.randn(n, o, p) if per_output else rng.randn(n, p)
    y, precision = rng.randn(n, o) * [1.0, 5.0], rng.uniform(0.1, 10.0, n)
    scale = np.tile(rng.uniform(0.1, 1.0, p), (o, 1))
    features = (H if per_output else np.stack([H] * o, axis=1)).transpose(1, 0, 2) * scale[0]
    A, b = features * np.sqrt(precision)[:, np.newaxis], (y * np.sqrt(precision)[:, np.newaxis]).T
    w, left_over = np.zeros((o, p)), b
    for share in (1e-12, 1.0, 1.0) if shared else (1e-12, 1.0):
        by = 1.0 / (share * np.sum(left_over**2, axis=1) / precision.sum())
        products, wanted = np.einsum("o,onp,onq->opq", by, A, A), np.einsum("o,onp,on->op", by, A, b)
        if shared:
            products, wanted = (np.stack([values.sum(axis=0)] * o) for values in (products, wanted))
        w = np.linalg.solve(products + np.eye(p), wanted[:, :, np.newaxis])[:, :, 0]
        left_over = b - np.einsum("onp,op->on", A, w)
    units = units_alone(H, y, prior_of(scale, shared), precision)
    np.testing.assert_allclose(units.prior.reference, w, rtol=1e-9)
    np.testing.assert_allclose(units.target_unit, np.sqrt(np.sum(left_over**2, axis=1) / precision.sum()), rtol=1e-9)


def test_shortest_weights_of_more_features_than_rows_explain_all(pieces):
    rng = np.random.RandomState(0)
    H, y, scale = rng.randn(9, 20), rng.randn(9, 1), rng.uniform(0.1, 10.0, (1, 20))
    units = units_alone(H, y, prior_of(scale))
    np.testing.assert_allclose(units.prior.reference[0], np.linalg.pinv(H * scale) @ y[:, 0], rtol=1e-9)


@pytest.mark.parametrize("target", ["constant", "linear"])
def test_target_in_the_span_of_many_rows_of_features_leaves_rounding_errors(target):
    rng = np.random.RandomState(0)
    H = np.column_stack([np.ones(200_000), rng.randn(200_000, 3)])
    y = H @ [[123456.789], [0.0], [0.0], [0.0]] if target == "constant" else H @ rng.randn(4, 1)
    source = source_of(H, y)
    _, squares = features_alone(source, LeastSquares.of(source, np.zeros(1)), prior_of(np.full((1, 4), 1e8)), len(H))
    assert np.sqrt(squares[0] / len(H)) < 5e-16 * np.abs(y).max()


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
