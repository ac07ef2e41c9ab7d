"""MAPIE makes intervals with a guarantee from our mean, and from our std, as docs/howto/mapie.md has it."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

from skevgp import EVGPRegressor

pytest.importorskip("mapie")


def test_the_page_prints_what_it_says():
    page = Path(__file__).parents[2] / "docs" / "howto" / "mapie.md"
    ((code, expected),) = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", page.read_text(), flags=re.DOTALL)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(code, {})
    pairs = [re.findall(r": ([\d.]+), ([\d.]+)", text) for text in (said.getvalue(), expected)]
    ours, theirs = (np.array(found, dtype=float) for found in pairs)
    np.testing.assert_allclose(ours, theirs, rtol=0.05)
    (model, mapie), (model_far, mapie_far) = theirs.reshape(2, 2, 2)[:, :, 0]
    assert abs(mapie - 0.8) < 0.5 * abs(model - 0.8)
    assert abs(mapie_far - 0.99) < 0.5 * abs(model_far - 0.99)


def test_conformal_intervals_hold(data):
    from mapie.regression import CrossConformalRegressor

    X, y = data
    model = CrossConformalRegressor(EVGPRegressor(n_inducing=20, random_state=0), confidence_level=0.9, cv=5)
    mean, intervals = model.fit_conformalize(X[:200], y[:200]).predict_interval(X[200:])
    low, high = intervals[:, :, 0].T
    assert ((low < mean) & (mean < high)).all()
    assert 0.82 <= np.mean((low <= y[200:]) & (y[200:] <= high)) <= 0.98
    assert np.median(high - low) < 0.5


def test_intervals_in_units_of_our_std_are_wide_where_it_is(data):
    from mapie.conformity_scores import StdConformityScore
    from mapie.regression import CrossConformalRegressor

    X, y = data
    model = CrossConformalRegressor(
        EVGPRegressor(n_inducing=20, random_state=0), confidence_level=0.9, conformity_score=StdConformityScore(), cv=5
    )
    inside_and_far = np.array([[0.0, 0.0], [6.0, 6.0]])
    _, intervals = model.fit_conformalize(X, y).predict_interval(inside_and_far)
    near, far = np.ptp(intervals[:, :, 0], axis=1)
    assert 0.25 < near < 0.5
    assert far > 3.0 * near
