import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import gamma

from skevgp.noise import student_t as mixture
from skevgp.noise.student_t import StudentTScales

DISTANCES = np.array([0.0, 0.5, 4.0, 25.0, 35.0, 40.0, 400.0, 1e6])


@pytest.mark.parametrize("o", [1, 3])
def test_evidence_is_the_integral_over_the_scale(o, monkeypatch):
    monkeypatch.setattr(mixture, "_SHARE", 0.1)
    nu, width = mixture._NU, mixture._WIDTH
    prior = gamma(0.5 * nu, scale=2.0 / (width**2 * nu))
    for d, evidence in zip(DISTANCES[:-1], StudentTScales(o, DISTANCES[:-1]).evidence, strict=True):
        rate = 0.5 * (width**2 * nu + d)
        tail, _ = quad(lambda t, d=d: prior.pdf(t) * t ** (0.5 * o) * np.exp(-0.5 * t * d), 0.0, 60.0 / rate, limit=200)
        assert evidence == pytest.approx(np.log(0.9 * np.exp(-0.5 * d) + 0.1 * tail), rel=1e-6)


@pytest.mark.parametrize("o", [1, 3])
def test_evidence_gradient_is_expected_scale(o):
    step = 1e-5 * (1.0 + DISTANCES)
    above, below = (StudentTScales(o, DISTANCES + sign * step).evidence for sign in (1.0, -1.0))
    np.testing.assert_allclose((above - below) / step, -StudentTScales(o, DISTANCES).mean, rtol=1e-4)


def test_any_other_doubts_make_the_bound_lower():
    """What the bound has of rows at one distance, with the q that is best at another."""
    for o in (1, 3):
        best = StudentTScales(o, DISTANCES)
        for other in DISTANCES:
            q = StudentTScales(o, np.full(len(DISTANCES), other))
            terms = -0.5 * (q.mean * DISTANCES + o * q.log_variance)
            assert (terms <= best.evidence + 1e-9 * np.abs(best.evidence)).all()
        own = -0.5 * (best.mean * DISTANCES + o * best.log_variance)
        np.testing.assert_allclose(own, best.evidence, rtol=1e-10)


def test_ordinary_rows_count_and_outliers_do_not():
    mean = StudentTScales(1, np.array([4.0, 16.0, 49.0, 400.0, 1e10])).mean
    np.testing.assert_allclose(mean[:2], 1.0, atol=0.01)
    assert (np.diff(mean) <= 0.0).all()
    assert mean[2] < 0.5
    assert mean[3] < 0.01
    assert mean[4] == pytest.approx(5.0 / 1e10, rel=1e-3)
