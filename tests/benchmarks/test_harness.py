"""What the benchmarks share: a CSV that survives interruptions and other versions, and options that are checked."""

import importlib
import os
import signal
import sys
import time
from dataclasses import dataclass, field

import pytest

PAPER = ("results_table", "learning_curves", "toy", "beta", "complexity")
SCRIPTS = (*(f"paper.{name}" for name in PAPER), "peers.against_gpr")


@dataclass(frozen=True)
class Cell:
    name: str
    limit: int = field(default=0, compare=False)


def row_of(cell):
    return {"name": cell.name, "value": len(cell.name)}


def interrupt(cell):
    """What a user or a scheduler does while a fit is running."""
    os.kill(os.getppid(), signal.SIGINT)
    time.sleep(3600)


@pytest.fixture
def harness(benchmarks):
    import harness

    return harness


@pytest.mark.parametrize("left", ['"b,', "b", "b,7"])
def test_half_a_line_is_no_row_and_the_next_rows_take_its_place(harness, tmp_path, left):
    path = tmp_path / "t.csv"
    first = {"name": 'a "quoted", one', "value": 1}
    harness.append([first], path)
    before = path.read_text()
    path.write_text(before + left)
    assert harness.read(path) == [{"name": 'a "quoted", one', "value": "1"}]
    harness.append([{"value": 2, "name": "c"}], path)  # in the order of the file's columns
    assert path.read_text() == before + "c,2\n"


def test_rows_of_other_columns_are_refused_and_the_file_stays(harness, tmp_path):
    path = tmp_path / "t.csv"
    harness.append([{"name": "a", "value": 1}], path)
    before = path.read_bytes()
    with pytest.raises(SystemExit, match="other columns"):
        harness.append([{"name": "a", "error": 1}], path)
    path.write_bytes(before.replace(b"name", b"title"))
    with pytest.raises(SystemExit, match="no columns.*name"):
        harness.run_missing([Cell("a")], row_of, path, 1, str)


def test_a_cell_asked_for_twice_runs_once(harness, tmp_path, capsys):
    path = tmp_path / "t.csv"
    assert harness.run_missing([Cell("a"), Cell("bb"), Cell("a", limit=3)], row_of, path, 1, str) == 0
    assert sorted(row["name"] for row in harness.read(path)) == ["a", "bb"]
    assert "0 of 2 cells" in capsys.readouterr().out


def dated_row_of(cell):
    return {"name": cell.name, "value": len(cell.name), "more": 7, "date": "2026-02-02"}


def test_what_is_older_than_a_day_is_measured_again_and_the_rest_stays(harness, tmp_path):
    path = tmp_path / "t.csv"
    old, new = ({"name": name, "value": 0, "date": date} for name, date in (("a", "2026-01-01"), ("bb", "2026-03-03")))
    harness.append([old, new], path)
    cells = [Cell("a"), Cell("bb"), Cell("ccc")]
    assert harness.run_missing(cells, dated_row_of, path, 1, str, since="2026-02-02") == 0
    rows = {row["name"]: row for row in harness.read(path)}
    assert {name: row["value"] for name, row in rows.items()} == {"a": "1", "bb": "0", "ccc": "3"}
    assert {name: row["more"] for name, row in rows.items()} == {"a": "7", "bb": "nan", "ccc": "7"}
    before = path.read_text()
    assert harness.run_missing(cells, dated_row_of, path, 1, str, since="2026-02-02") == 0
    assert path.read_text() == before


def test_rows_that_are_asked_for_again_are_measured_again(harness, tmp_path):
    path = tmp_path / "t.csv"
    harness.append([{"name": name, "value": 0, "date": "2026-03-03", "more": 0} for name in ("a", "bb")], path)
    cells = [Cell("a"), Cell("bb")]
    assert harness.run_missing(cells, dated_row_of, path, 1, str, again=lambda row: row["name"] == "bb") == 0
    assert {row["name"]: row["value"] for row in harness.read(path)} == {"a": "0", "bb": "2"}
    assert len(harness.read(path)) == 2


@pytest.fixture
def interruptible():
    """Also in the background of a shell, whose jobs ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_of_the_main_process_ends_the_fits(harness, tmp_path):
    with pytest.raises(SystemExit, match="Interrupted"):
        harness.run_missing([Cell("a"), Cell("b")], interrupt, tmp_path / "t.csv", 1, str)


def test_without_matplotlib_nothing_runs(harness, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit, match="pip install matplotlib"):
        harness.run_missing([Cell("a")], row_of, tmp_path / "t.csv", 1, str)


def test_with_nothing_to_say_a_page_stays(harness, tmp_path, capsys):
    page = tmp_path / "t.md"
    page.write_text("as it was")
    with pytest.raises(SystemExit, match="2 cells failed"):
        harness.write_report([], tmp_path / "t.csv", 2)
    assert page.read_text() == "as it was"
    assert "no page is written" in capsys.readouterr().out


@pytest.mark.parametrize(
    "wrong", [("--seeds", "0"), ("--jobs", "-1"), ("--output", "page.md"), ("--output", "."), ("--systems", "moon")]
)
def test_wrong_options_are_named(harness, wrong, capsys):
    parser = harness.argument_parser("", quick="few", seeds="seeds", systems=("sun", "earth"))
    with pytest.raises(SystemExit):
        parser.parse_args(wrong)
    assert f"argument {wrong[0]}: " in capsys.readouterr().err


@pytest.mark.parametrize("script", SCRIPTS)
def test_benchmarks_of_the_paper_have_the_same_options(harness, script, monkeypatch, capsys):
    module = importlib.import_module(script)
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit):
        module.main()
    said = capsys.readouterr().out
    for option in ("--quick", "--seeds", "--systems", "--jobs", "--output"):
        assert option in said, option


def test_pictures_have_the_palette_of_the_displays_and_the_width_of_a_page(harness, tmp_path):
    from PIL import Image

    from skevgp.plotting._style import PALETTE

    pyplot = harness.pyplot()
    assert harness.PALETTE == PALETTE
    assert tuple(pyplot.rcParams["axes.prop_cycle"].by_key()["color"]) == PALETTE
    figure, axes = pyplot.subplots(figsize=(harness.WIDTH, 1.0))
    assert not axes.spines["right"].get_visible()
    assert harness.WIDTH * figure.dpi == 880
    harness.save_picture(figure, tmp_path / "picture.png")
    with Image.open(tmp_path / "picture.png") as image:
        assert image.size == (1760, 220)


@pytest.mark.parametrize(
    ("which", "low", "high", "ticks"),
    [
        ("y", 0.009, 0.3, ["0.01", "0.02", "0.05", "0.1", "0.2"]),
        ("x", 90, 20_001, ["100", "1,000", "10,000"]),
        ("x", 300, 5000, ["500", "1,000", "2,000", "5,000"]),
    ],
)
def test_logarithmic_axes_have_plain_numbers_that_do_not_collide(harness, which, low, high, ticks):
    axes = harness.pyplot().subplots()[1]
    axes.set(**{f"{which}lim": (low, high)})
    harness.logarithmic(axes, which)
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    axes.figure.canvas.draw()
    shown = [tick.label1.get_text() for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    assert shown == ticks


def test_a_legend_has_each_label_once(harness):
    figure, grid = harness.pyplot().subplots(1, 2)
    for axes, labels in zip(grid, ("ab", "bc"), strict=True):
        for label in labels:
            axes.plot([0, 1], label=label)
    assert [text.get_text() for text in harness.legend(figure).get_texts()] == ["a", "b", "c"]
