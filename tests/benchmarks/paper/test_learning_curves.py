"""The benchmark of the paper's Figure 6 in short mode."""

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import prediction_error, std_norm

from ..conftest import read


@pytest.fixture
def run(run_script, tmp_path):
    """Tiny fits of the pendulum's EVGP."""

    def run(*arguments):
        options = ("--quick", "--systems", "pendulum", "--max-iter", 2, "--jobs", 1, "--models", "EVGP-IFG")
        options += ("--output", tmp_path / "curves.csv")
        return run_script("paper/learning_curves.py", *options, *arguments)

    return run


def made_up(**errors):
    """Rows of EVGP-IFG, or another model, on the pendulum: for each number of rows the Errors of its runs."""
    return [
        {
            **{"system": "pendulum", "model": model.replace("_", "-"), "setting": "skevgp", "seed": str(seed)},
            **{"n_rows": str(n_rows), "error_mean": str(error), "error_median": str(error / 10)},
            **{"size": "full", "max_iter": "", "converged": "True"},
            **{"date": "2026-01-01", "versions": "skevgp", "machine": "x86_64"},
        }
        for model, sizes in errors.items()
        for n_rows, runs in sizes.items()
        for seed, error in enumerate(runs)
    ]


@pytest.mark.long
def test_it_runs_and_resumes(run, tmp_path):
    table, page, picture = (tmp_path / f"curves.{suffix}" for suffix in ("csv", "md", "png"))
    assert "[2/2] pendulum EVGP-IFG skevgp 12 0 quick: Error" in run()
    before = table.read_text()
    assert "2 of 4 cells" in run("--seeds", 2)
    assert table.read_text().startswith(before)

    test = make_dynamics("pendulum", 12, random_state=1000)
    rows = read(table)
    assert [(row["seed"], row["n_trajectories"], row["n_rows"]) for row in rows] == [
        *(("0", "4", "400"), ("0", "12", "1200"), ("1", "4", "400"), ("1", "12", "1200"))
    ]
    for row in rows:
        train = make_dynamics("pendulum", 12, random_state=int(row["seed"]))
        X, y = train.data[: int(row["n_rows"])], train.target[: int(row["n_rows"])]
        features = InertiaForceGravity("pendulum")
        model = EVGPRegressor(features, n_inducing=10, max_iter=2, random_state=int(row["seed"]))
        with pytest.warns(ConvergenceWarning, match="max_iter"):
            model.fit(X, y, groups=train.groups[: len(X)])
        mean, std = model.predict(test.data, return_std=True)
        assert float(row["error_mean"]) == pytest.approx(prediction_error(test.target, mean), rel=1e-6)
        assert float(row["std_norm"]) == pytest.approx(std_norm(std), rel=1e-6)
        assert (row["max_iter"], row["converged"]) == ("2", "False")
    assert "epochs: 4 of pendulum EVGP-IFG skevgp after 2 iterations." in page.read_text()
    assert "0 of 2 cells" in run("--limited")  # of the first run
    assert len(read(table)) == 4
    assert picture.stat().st_size > 10_000


def test_the_nominal_arm_is_shown_once():
    from paper.learning_curves import MODELS, SYSTEMS, wanted

    shown = [(system, model) for system in SYSTEMS for model in MODELS if wanted(system, model, "skevgp-nominal")]
    assert shown == [("iiwa14", "EVGP-IFG")]
    assert all(wanted(system, model, "skevgp") for system in SYSTEMS for model in MODELS)


def test_sizes_end_with_the_papers():
    from paper.learning_curves import N_TRAJECTORIES

    assert {system: sizes[-1] for system, sizes in N_TRAJECTORIES.items()} == {
        **{"pendulum": 48, "cartpole": 48, "acrobot": 93, "iiwa14": 465}
    }
    assert all(np.all(np.diff(sizes) > 0) for sizes in N_TRAJECTORIES.values())


def test_the_page_tells_means_and_ranges_and_checks_the_claims():
    from paper.learning_curves_report import paragraphs

    rows = made_up(
        VGP={100: [4.0, 4.0], 400: [1.0, 1.0]},
        RES_VGP={100: [4.0, 4.0], 400: [3.8, 3.8]},
        RES_DBNN={100: [9.0, 9.0], 400: [0.5]},
        EVGP_IF={100: [1.0, 3.0], 400: [0.25, 0.25]},
        EVGP_IFG={100: [1.0, 1.0], 400: [0.375, 0.125]},
    )
    page = "\n".join(paragraphs(rows))
    assert "| EVGP-IF | 2.00 (1.00 to 3.00, 2) | 0.250 (0.250 to 0.250, 2) |" in page
    assert "| RES-DBNN | 9.00 (9.00 to 9.00, 2) | 0.500 |" in page
    assert "| RES-DBNN | 0.900 | 0.0500 |" in page  # medians
    # Rows to reach 1.0: VGP 400, RES-VGP never, ...
    assert "| pendulum | 1.00 | 400 | — | 400 | 400 | 100 |" in page
    assert "EVGP-IFG (100), EVGP-IF (400)" in page  # of equals the first
    # From 4 to 1 over two doublings: a half each.
    assert "| pendulum | 0.50 | *0.97* | 0.24 | 0.35 | 0.50 |" in page
    assert "| pendulum | RES-DBNN | 8.00 (× 9.00) | 0.250 (× 2.00) | yes | yes |" in page
    assert "| pendulum | EVGP-IF | 1.00 (× 2.00) | 0.00 (× 1.00) | yes | yes |" in page
    assert "asks that all runs agree" in page  # of claims.md, whose verdicts are stricter
    assert "rows inside the training range" in page
    assert "Not so: nowhere." in page
    assert "0 of 19 fits did not end by themselves." in page
    assert "Ended by a limit" not in page
    worse = "\n".join(paragraphs(made_up(EVGP_IF={100: [1.0], 400: [0.5]}, EVGP_IFG={100: [0.5], 400: [1.5]})))
    assert "Not so: pendulum with 400 rows (1.50 against 0.500)." in worse
    assert "| pendulum | EVGP-IF | 0.500 (× 2.00) | -1.00 (× 0.333) | reversed | reversed |" in worse
    never = "\n".join(paragraphs(made_up(EVGP_IF={100: [0.5], 400: [0.5]}, EVGP_IFG={100: [1.0], 400: [0.25]})))
    assert "| pendulum | EVGP-IF | -0.500 (× 0.500) | 0.250 (× 2.00) | — | — |" in never


def test_a_page_of_few_rows_says_what_it_can(tmp_path):
    from paper.learning_curves_report import paragraphs, plot

    page = "\n".join(paragraphs(made_up(VGP={100: [4.0]})))
    assert "| VGP | 4.00 |" in page
    assert "EVGP needs fewer" not in page
    assert "| EVGP-IF |  |  |" in "\n".join(paragraphs(made_up(EVGP_IF={100: [1.0]}, EVGP_IFG={400: [2.0]})))
    nominal = [{**row, "system": "iiwa14", "setting": "skevgp-nominal"} for row in made_up(EVGP_IFG={100: [1.0]})]
    assert "| EVGP-IFG, nominal | 1.00 |" in "\n".join(paragraphs(nominal))
    plot(nominal, tmp_path / "nominal.png")


def test_each_panel_draws_medians_quartiles_limits_and_the_papers_points(drawn, tmp_path):
    from matplotlib.colors import to_hex

    from paper.learning_curves_report import COLOURS, plot

    rows = made_up(VGP={100: [4.0, 1.0, 1.0], 400: [1.0]}, EVGP_IFG={100: [1.0], 400: [0.5]})
    rows += [{**row, "system": "acrobot"} for row in rows if row["n_rows"] == "100"]
    rows[0]["converged"] = "False"
    (figure,) = drawn(plot, rows, tmp_path / "curves.png")
    assert [axes.get_title() for axes in figure.axes] == [
        "pendulum (3 runs; VGP fewer at 400; EVGP-IFG fewer at 100, 400)",
        "acrobot (3 runs; EVGP-IFG fewer at 100)",
    ]
    for axes in figure.axes:
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("training rows", "test Error (SI units)")
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    pendulum = figure.axes[0]
    lines = {line.get_label(): line for line in pendulum.lines}
    assert {"VGP", "EVGP-IFG"} < set(lines)
    np.testing.assert_array_equal(lines["VGP"].get_ydata(), [1.0, 1.0])  # medians
    assert lines["EVGP-IFG"].get_color() == COLOURS["EVGP-IFG"]
    (first, _), (_, last) = pendulum.collections[0].get_segments()[0]
    assert (first, last) == (pytest.approx(100, rel=0.05), 2.5)  # the third quartile of 4, 1, 1
    stars = {line.get_color(): line.get_ydata()[0] for line in pendulum.lines if line.get_marker() == "*"}
    assert stars == {COLOURS["VGP"]: 0.343, COLOURS["EVGP-IFG"]: 0.005}
    hollow = [
        line for line in pendulum.lines if to_hex(line.get_markerfacecolor()) == "#ffffff" and len(line.get_xdata())
    ]
    assert [(line.get_color(), line.get_ydata().tolist()) for line in hollow] == [(COLOURS["VGP"], [1.0])]
    said = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"VGP", "EVGP-IFG", "in the paper, with all rows", "a fit ended by its limit of iterations"} == said
    assert "bars from first to third quartile" in figure.legends[0].get_title().get_text()


def test_each_setting_has_a_picture(drawn, tmp_path):
    from paper.learning_curves_report import plot

    rows = made_up(EVGP_IFG={100: [1.0, 2.0], 400: [0.5, 0.5]})
    paper = [{**row, "setting": "paper"} for row in rows if row["seed"] == "0"]
    figures = drawn(plot, rows + paper, tmp_path / "curves.png")
    texts = [{text.get_text() for text in figure.legends[0].get_texts()} for figure in figures]
    assert texts == [{"EVGP-IFG", "in the paper, with all rows"}] * 2
    assert [figure.axes[0].get_title() for figure in figures] == ["pendulum (2 runs)", "pendulum (1 run)"]
    assert {path.name for path in tmp_path.iterdir()} == {"curves.png", "curves_paper.png"}
