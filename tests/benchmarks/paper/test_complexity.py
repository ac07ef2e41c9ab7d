"""The benchmark of the paper's Table 3, of complexities, in short mode."""

import csv
from dataclasses import fields

import numpy as np
import pytest

# Rows, points, outputs, layers, units.
SMALL, NETWORK = (50, 7, 3, 0, 0), (400, 0, 3, 2, 6)
D = 5


@pytest.fixture
def cell():
    from paper.complexity import Cell

    return Cell


@pytest.mark.parametrize(("sharing", "n_sets", "n_models"), [("all", 1, 1), ("kernel", 3, 1), ("none", 1, 3)])
def test_an_evaluation_has_the_gradient_of_all_parameters(cell, sharing, n_sets, n_models):
    """Of each model D lengthscales, signal and noise of each output, m D coordinates of each set of points."""
    from paper import complexity

    with complexity.bound(cell("bound", sharing, *SMALL)) as evaluate:
        results = evaluate()
    assert len(results) == n_models
    for value, gradient in results:
        assert np.isfinite(value)
        assert gradient.shape == (D + 2 * 3 // n_models + n_sets * 7 * D,)
        assert (gradient != 0.0).all()


def test_a_step_moves_all_parameters_of_the_papers_setting(cell):
    from paper import complexity

    with complexity.adam_step(cell("adam step", "", *SMALL)) as step:
        minimum = step()
        again = step()
    assert minimum.n_iter == again.n_iter == 1
    assert minimum.x.shape == (3 * (7 * D + 2 * 7 + 2) + D,)


def test_times_are_the_fastest_of_repeats_and_a_networks_are_per_step(cell, monkeypatch):
    from paper import complexity

    ticks = iter(np.cumsum([0.0, 3.0, 0.0, 1.0, 0.0, 2.0]))
    monkeypatch.setattr(complexity.time, "process_time", lambda: next(ticks))
    row = complexity.run(cell("network step", "", *NETWORK))
    assert (row["seconds"], row["seconds_median"], row["repeats"]) == (0.5, 1.0, 3)
    ticks = iter(range(0, 40, 2))
    assert complexity.run(cell("network step", "", *NETWORK, repeats=5))["repeats"] == 5
    assert row["n_bytes"] == ""


@pytest.mark.parametrize(
    ("what", "setting", "sizes", "n_parameters"),
    [
        ("model", "paper", SMALL, 3 * (7 * D + 2 * 7 + 2) + D),
        ("model", "skevgp", SMALL, 7 * D + 3 * (7 + 28 + 2) + D),
        ("network", "", NETWORK, 2 * (D * 6 + 6 * 6 + 6 * 3) + 6 + 6 + 3 + 3),
    ],
)
def test_models_are_weighed(cell, what, setting, sizes, n_parameters):
    from paper import complexity

    row = complexity.run(cell(what, setting, *sizes))
    assert row["n_parameters"] == n_parameters
    assert row["n_bytes"] > 8 * n_parameters
    assert row["seconds"] == ""
    more = complexity.run(cell(what, setting, 2 * sizes[0], *sizes[1:]))
    assert abs(more["n_bytes"] - row["n_bytes"]) < 100


def test_exponents_are_those_of_power_laws(cell):
    from paper.complexity_report import CURVES

    curve = next(own for own in CURVES if (own.what, own.setting, own.varied) == ("bound", "kernel", "n_inducing"))
    rows = [{name: str(value) for name, value in size.items()} for size in curve.cells()]
    for row, size in zip(rows, curve.cells(), strict=True):
        m = size["n_inducing"]
        row["seconds"] = str(3.0 * m**2.5 if m >= curve.above else 1.0)
    np.testing.assert_allclose(curve.exponent(rows), 2.5)


@pytest.mark.long
def test_what_is_there_is_not_measured_again_and_the_page_is_written(run_script, cell, tmp_path):
    from paper.complexity_report import QUICK

    cells = {tuple(size.values()): size for curve in QUICK for size in curve.cells()}
    names = [field.name for field in fields(cell) if field.compare]
    assert {tuple(own) for own in cells.values()} == {tuple(names)}
    output = tmp_path / "c.csv"
    with output.open("w", newline="") as file:
        writer = csv.DictWriter(
            file,
            names + ["seconds", "seconds_median", "repeats", "n_parameters", "n_bytes", "date", "versions", "machine"],
        )
        writer.writeheader()
        for size in list(cells.values())[1:]:
            m, n, o = size["n_inducing"], size["n_rows"], 1 if size["setting"] == "all" else size["n_outputs"]
            # The matrices take as long as 2 m rows.
            seconds = 1e-9 * o * (n * m**2 + 2 * m**3) + 1e-9 * size["n_layers"] * size["n_units"] ** 2
            given = {"seconds": seconds, "n_parameters": m + 1, "n_bytes": m * m + 1, "date": "today"}
            writer.writerow({**size, **given, "versions": "none", "machine": "none"})

    def run(*systems):
        return run_script("paper/complexity.py", "--quick", "--output", output, *systems)

    page = output.with_suffix(".md")
    assert "9 of 9 cells" in run("--systems", "network")
    assert "Where they differ" not in page.read_text()  # one cell is missing
    assert f"{len(cells) - 1} of {len(cells)} cells" in run()
    assert f"{len(cells)} of {len(cells)} cells" in run()
    page = page.read_text()
    assert "**A quick run**" in page
    assert "2.0 m to 2.0 m rows at m from 10 (shared points" in page
    assert "points per output, 16 rows | inducing points m | 3 |" in page
    assert "bytes differ by 0.0%" in page
    assert output.with_suffix(".png").stat().st_size > 10_000


def test_the_picture_has_four_panels_with_units(drawn, tmp_path):
    from paper.complexity_report import CURVES, PANELS, plot

    sizes = [size for curve in CURVES for size in curve.cells()]
    measured = {"seconds": "0.01", "n_bytes": "1e6", "n_parameters": "100"}
    rows = [{**{name: str(value) for name, value in size.items()}, **measured} for size in sizes]
    (figure,) = drawn(plot, CURVES, rows, tmp_path / "c.png")
    assert len(figure.axes) == 4
    for panel, (axes, (title, xlabel, ylabel, slopes)) in enumerate(zip(figure.axes, PANELS, strict=True)):
        assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == (title, xlabel, ylabel)
        shown = [curve for curve in CURVES if curve.panel == panel]
        # Each from its smallest size, pale, and from where its exponent begins.
        assert len(axes.lines) == 2 * len(shown) + len(slopes)
        for curve, pale, fitted in zip(shown, axes.lines[::2], axes.lines[1::2], strict=False):
            assert min(pale.get_xdata()) < min(fitted.get_xdata()) == curve.above
        for slope, text, line in zip(slopes, axes.texts, axes.lines[-len(slopes) :], strict=True):
            assert text.get_text() == f"slope {slope}"
            rise, run = (np.ptp(np.log(values)) for values in (line.get_ydata(), line.get_xdata()))
            assert rise / run == pytest.approx(slope)
        assert len(axes.get_legend().get_texts()) == len(shown) == len({curve.label for curve in shown}) <= 5
        assert axes.lines[0].get_ydata()[0] == pytest.approx(10.0 if ylabel == "milliseconds" else 1.0)
