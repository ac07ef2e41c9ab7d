"""SHAP explains what we predict, and what we are unsure of."""

import numpy as np
import pytest

from skevgp import EVGPRegressor

shap = pytest.importorskip("shap")


def test_what_columns_contribute_adds_up_to_predictions(data):
    X, y = data
    model = EVGPRegressor(n_inducing=20, random_state=0).fit(X, y)
    background, new = X[:100], X[100:110]
    found = shap.Explainer(model.predict, background)(new)
    np.testing.assert_allclose(found.values.sum(axis=1) + found.base_values, model.predict(new), atol=1e-8)
    # y is a sum of a function of each column, of which the second is a line.
    np.testing.assert_allclose(found.values[:, 1], 0.5 * (new[:, 1] - background[:, 1].mean()), atol=0.15)
    uncertain = shap.Explainer(lambda rows: model.predict(rows, return_std=True)[1], background)(np.array([[0.0, 9.0]]))
    assert uncertain.values[0, 1] > 5.0 * abs(uncertain.values[0, 0])
