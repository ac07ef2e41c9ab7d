"""The benchmark of tables: runs, resumes, reports, and fills the tables of the page on boosting."""

import numpy as np
import pytest
from sklearn.compose import make_column_transformer
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.linear_model import BayesianRidge
from sklearn.preprocessing import OneHotEncoder, StandardScaler
from threadpoolctl import threadpool_limits

from skevgp import EVGPRegressor
from skevgp.metrics import negative_log_predictive_density

from .conftest import read


@pytest.fixture
def tabular(benchmarks):
    import tabular

    return tabular


def test_the_pages_tables_are_those_of_the_results(tabular):
    rows = tabular.harness.read(tabular.harness.RESULTS / "tabular.csv")
    page = tabular.PAGE.read_text()
    assert page.count("<!-- table: ") == 4
    assert tabular.with_tables(page, rows) == page
    assert (tabular.harness.RESULTS / "tabular.md").read_text() == "\n\n".join(
        part.strip("\n") for part in tabular.report(rows)
    ) + "\n"


def test_a_table_is_put_in_the_place_of_the_last(tabular):
    rows = tabular.harness.read(tabular.harness.RESULTS / "tabular.csv")
    page = "A\n\n<!-- table: diabetes -->\n| yore |\n| --- |\n\nB\n"
    filled = tabular.with_tables(page, rows)
    assert "yore" not in filled
    assert "| diabetes | GPR |" in filled
    assert filled.startswith("A\n\n<!-- table: diabetes -->\n| set |")
    assert filled.endswith("|\n\nB\n")
    assert tabular.with_tables(filled, rows) == filled


@pytest.mark.long
def test_it_runs_and_resumes(tabular, tmp_path, capsys):
    output = tmp_path / "tabular.csv"
    arguments = ["--sets", "toy-200", "--seeds", "1", "--jobs", "1", "--output", str(output)]
    page = tabular.PAGE.read_text()
    tabular.main(arguments)
    rows = read(output)
    assert {row["model"] for row in rows} == set(tabular.MODELS)
    assert all(float(row["seconds"]) >= 0.0 < float(row["wall_seconds"]) for row in rows)
    assert "| toy-200 | EVGP, auto |" in output.with_suffix(".md").read_text()
    assert "Within 0.02 nats per row of GPR: 1 of 1." in capsys.readouterr().out
    tabular.main(arguments)
    assert read(output) == rows
    assert tabular.PAGE.read_text() == page


def test_a_row_holds_the_scores_of_a_model(tabular):
    data = tabular.standardised(tabular.SETS["diabetes"](0))
    np.testing.assert_allclose([data.X.mean(), data.X.std()], [0.0, 1.0], atol=1e-9)
    row = tabular.measured("BayesianRidge", data, 0)
    mean, std = BayesianRidge().fit(data.X, data.y).predict(data.X_test, return_std=True)
    assert row["nlpd"] == negative_log_predictive_density(data.y_test, mean, std)
    assert row["rmse"] == pytest.approx(np.sqrt(np.mean((mean - data.y_test) ** 2)))
    assert row["coverage"] == pytest.approx(np.mean(np.abs(mean - data.y_test) <= tabular.HALF_WIDTH * std))
    assert row["width"] == pytest.approx(2 * tabular.HALF_WIDTH * std.mean())


@pytest.mark.parametrize("folds", [True, False])
def test_trees_say_an_interval_and_a_std(tabular, folds):
    data = tabular.standardised(tabular.SETS["diabetes"](0))
    mean, std, low, high = tabular.boosted(data, 0, folds)[1]()
    assert len({*std}) == 1 if folds else len({*std}) > 10
    assert (std > 0.0).all()
    assert np.mean(mean) == pytest.approx(np.mean((low + high) / 2), abs=0.2)
    assert np.mean((low <= data.y_test) & (data.y_test <= high)) == pytest.approx(0.9 if folds else 0.65, abs=0.1)


@pytest.mark.parametrize("name", ["houses-2000", "boxes-2000", "friedman2-800"])
def test_made_sets_are_as_large_as_they_say_and_of_unit_variance(tabular, name):
    data = tabular.SETS[name](1)
    assert len(data.X) == int(name.rpartition("-")[2])
    assert len(data.X_test) == 1000
    assert data.y.std() == pytest.approx(1.0)
    assert (tabular.SETS[name](0).y[:10] != data.y[:10]).any()


def test_few_houses_are_cut_off_at_the_top(tabular):
    X, price = tabular.houses(3000, np.random.RandomState(0))
    assert X.shape == (3000, 8)
    assert price.max() == 5.0 > np.quantile(price, 0.99)


@pytest.mark.long
def test_trees_find_jumps_and_a_gaussian_process_can_be_told(tabular):
    """The numbers of the page on boosting."""
    data = tabular.SETS["houses-2000"](0)

    def rmse(mean):
        return np.sqrt(np.mean((data.y_test - mean) ** 2))

    def told(X):
        return np.column_stack([X[:, :6], X[:, 6] < 2.0, 6 * X[:, 6].astype(int) + X[:, 7].astype(int)])

    words = OneHotEncoder(handle_unknown="ignore", sparse_output=False)
    numbers = make_column_transformer((StandardScaler(), slice(0, 7)))
    with threadpool_limits(1):
        boost = HistGradientBoostingRegressor(random_state=0)
        before = rmse(boost.fit(data.X, data.y).predict(data.X_test))
        trees = boost.set_params(categorical_features=[7]).fit(told(data.X), data.y)
        model = EVGPRegressor(normalize_y=True, random_state=0)
        scaler = StandardScaler().fit(data.X)
        model.fit(scaler.transform(data.X), data.y)
        alone, known = model.predict(scaler.transform(data.X_test)), model.predict(scaler.transform(data.X))
        boost = HistGradientBoostingRegressor(random_state=0).fit(data.X, data.y - known)
        together = rmse(alone + boost.predict(data.X_test))
        model.set_params(feature_map=make_column_transformer((words, [7])), kernel_map=numbers)
        model.fit(told(data.X), data.y)
    assert before < together < rmse(alone)
    assert before > 0.32
    assert rmse(trees.predict(told(data.X_test))) == pytest.approx(0.24, abs=0.005)
    assert rmse(model.predict(told(data.X_test))) == pytest.approx(0.22, abs=0.005)


@pytest.mark.long
def test_nothing_is_lost_to_the_exact_model_on_the_sines(tabular):
    rows = tabular.harness.read(tabular.harness.RESULTS / "tabular.csv")
    data = tabular.standardised(tabular.SETS["sines-800"](0))
    (exact,) = (own for own in rows if (own["name"], own["seed"], own["model"]) == ("sines-800", "0", "GPR"))
    model = EVGPRegressor(n_inducing="auto", normalize_y=True, random_state=0).fit(data.X, data.y)
    found = negative_log_predictive_density(data.y_test, *model.predict(data.X_test, return_std=True))
    assert found < float(exact["nlpd"]) + tabular.ENOUGH
