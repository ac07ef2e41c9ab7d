"""scikit-optimize, as docs/howto/bayesian_optimisation.md has it."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("skopt")
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "bayesian_optimisation.md"
CODE = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_recipe_does_what_it_says():
    assert len(CODE) == 2
    names = {}
    for code, expected in CODE:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(code, names)
        assert float(said.getvalue()) == pytest.approx(float(expected), abs=0.015)
    # What the adapter returns are the derivatives of what it predicts (of data without noise but for 1e-9 or so).
    model, step = names["WithGradients"](), 1e-3
    X = np.random.RandomState(0).uniform(-1.0, 1.0, (20, 2))
    model.fit(X, np.sin(2.0 * X[:, 0]) + X[:, 1] ** 2 + 0.05 * X[:, 0] * X[:, 1])
    row = np.array([[0.3, 1.4]])
    mean, std, slope, std_slope = model.predict(row, return_std=True, return_mean_grad=True, return_std_grad=True)
    for column in range(2):
        (up, std_up), (down, std_down) = (
            model.predict(row + sign * step * np.eye(2)[[column]], return_std=True) for sign in (1.0, -1.0)
        )
        assert slope[column] == pytest.approx((up[0] - down[0]) / (2 * step), rel=1e-3, abs=1e-6)
        assert std_slope[column] == pytest.approx((std_up[0] - std_down[0]) / (2 * step), rel=1e-3, abs=1e-6)
    assert mean.shape == std.shape == (1,)
