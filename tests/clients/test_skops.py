"""skops writes a model card of a fitted model."""

import re

import pytest

from skevgp import EVGPRegressor

card = pytest.importorskip("skops.card")


def test_a_model_card_has_parameters_scores_and_the_model(data, tmp_path):
    X, y = data
    model = EVGPRegressor(n_inducing=17, random_state=0).fit(X, y)
    page = card.Card(model)
    page.add_metrics(r2=model.score(X, y), section="Model description/Evaluation Results")
    page.add(**{"Model description/Kernel": str(model.kernel_)})
    page.save(tmp_path / "README.md")
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    for row in (
        r"n_inducing *\| *17",
        r"r2 *\| *0\.9",
        r"RBF\(length_scale=",
        r"EVGPRegressor\(n_inducing=17, random_state=0\)",
    ):
        assert re.search(row, text), row
