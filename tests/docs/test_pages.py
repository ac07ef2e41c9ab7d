"""The code of the site's pages runs as it stands, and prints what they say."""

import re
import subprocess
import sys
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

DOCS = Path(__file__).parents[2] / "docs"
sys.path.insert(0, str(DOCS / "_ext"))

import blocks  # noqa: E402
import comparison  # noqa: E402
import stories  # noqa: E402
import thumbnails  # noqa: E402

NOT_WRITTEN = {"_build", "generated", "tests"}
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if not NOT_WRITTEN & set(page.relative_to(DOCS).parts)]
# Of packages that only tests/clients has, which runs them.
OF_CLIENTS = {"bayesian_optimisation.md", "mapie.md"}
WITH_CODE = [page for page in PAGES if "```python" in page.read_text() and page.name not in OF_CLIENTS]
# Commands that install packages or run for long; those of the README are run by CI.
INSTALLS = ("pip ", "python3 -m venv ", "pytest ", "bash .ci/run", "python -m ")


def name_of(page):
    return page.relative_to(DOCS).as_posix()


@pytest.mark.long
@pytest.mark.parametrize("page", WITH_CODE, ids=name_of)
def test_page_runs_and_prints_what_it_says(page, tmp_path):
    with warnings.catch_warnings():  # a page may silence one
        for block, printed in blocks.run(page, tmp_path):
            assert not blocks.differences(printed, block.output or ""), f"{page.name}:{block.line}"
    plt.close("all")
    text = page.read_text()
    for picture in re.findall(r"generated/pictures/(?!front_)([\w.]+)", text):  # others are of docs/_ext/front.py
        assert (tmp_path / picture).stat().st_size > 5_000
    run_commands(text, tmp_path)


def run_commands(text, folder):
    """Of a shell, with the C programs that the page shows, in the folder where its Python has run."""
    for name, source in re.findall(r"```\{code-block\} c\n:caption: (\S+)\n\n(.*?)```", text, flags=re.DOTALL):
        (folder / name).write_text(source)
    for block in blocks.blocks_of(text):
        if block.language != "bash" or all(line.startswith(INSTALLS) for line in block.body.splitlines()):
            continue
        result = subprocess.run(["bash", "-euc", block.body], cwd=folder, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        assert not blocks.differences(result.stdout, block.output or "")


def test_all_code_is_run():
    """No fence has a language that nobody runs."""
    known = {"python", "bash", "text", "{code-block} c"}
    directives = re.compile(r"\{(toctree|include|list-table)\}")
    for page in PAGES:
        for block in blocks.blocks_of(page.read_text()):
            assert block.language in known or directives.match(block.language), f"{page.name}:{block.line}"
    assert len(WITH_CODE) > 15


def test_code_fits_its_column():
    """Lines of code, of what it prints, and of sketches: 72 characters are seen at a desk without scrolling."""
    found = []
    for page in [*PAGES, *(DOCS.parent / name for name in ("README.md", "REPRODUCTION.md"))]:
        text = re.sub(r"<!-- command: \w+ -->\n```bash\n.*?```", "", page.read_text(), flags=re.DOTALL)  # one line each
        for block in blocks.blocks_of(text):
            if not block.language.startswith("{") or block.language.startswith("{code-block}"):
                found += [f"{page.name}: {line}" for line in block.body.splitlines() if len(line) > 72]
    assert not found


def test_each_example_is_in_a_group_of_the_gallery():
    examples = sorted((DOCS.parent / "examples").glob("plot_*.py"))
    assert sorted(stories.ORDER) == [path.stem.removeprefix("plot_") for path in examples]
    assert list(thumbnails.PANELS) == stories.ORDER


def test_thumbnail_is_one_panel_without_small_words(tmp_path):
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3))
    left.plot([0, 1], [0, 1], label="a line")
    right.plot([0, 1], [1, 0], label="another")
    left.set_title("Left")
    right.legend()
    thumbnails.save(figure, thumbnails.Panel(1, "x", "y"), tmp_path / "made.png")
    assert right.get_legend() is not None
    assert left.get_visible()
    pixels = plt.imread(tmp_path / "made.png")
    assert pixels.shape[:2] == (thumbnails.HEIGHT * thumbnails.DPI, thumbnails.WIDTH * thumbnails.DPI)
    assert (pixels[..., :3].min(axis=2) < 0.5).mean() < 0.1  # lines on white
    plt.close(figure)


def test_each_source_file_that_a_page_names_is_there():
    named = [path for page in PAGES for path in re.findall(r"\{src\}`([^`]+)`", page.read_text())]
    assert len(named) > 30
    assert not [path for path in named if not (DOCS.parent / path).is_file()]


# What the prose says was measured, and the line of the results that it is from.
FIGURES = [
    ("guide/parameters.md", "[1.8 times as long]", "parameters_cost", r"40 \| 0\.00 \| 2\.\d+ \| 1\.80"),
    ("guide/parameters.md", "3.8 times as long", "parameters_cost", r"4 \| 0\.100 \| 1\.\d+ \| 3\.81"),
    (
        "guide/parameters.md",
        "in 95 % and 94 % of 100",
        "parameters_misfit",
        r"line \| 100 \| orth.* 0\.950",
    ),
    (
        "guide/parameters.md",
        "in 95 % and 94 % of 100",
        "parameters_misfit",
        r"decay \| 100 \| orth.* 0\.940",
    ),
    (
        "guide/parameters.md",
        "they cover it in 91 %",
        "parameters_misfit",
        r"decay \| 30 \| orth.* 0\.910",
    ),
    ("guide/control.md", "take 23 µs by `compile()`", "latency", r"compiled: row, mean and std \| 23 "),
    ("guide/control.md", "49 µs by `predict`", "latency", r"predict: row, mean and std \| 49 "),
    ("guide/control.md", "`compile()` takes 28 µs", "latency", r"cartpole with features: row, mean and std \| 28 "),
    ("guide/control.md", "50 rows take 133 µs", "latency", r"compiled: horizon, mean and std \| 133 "),
    ("guide/control.md", "7.94 µs by CasADi and 5.73 µs in C", "casadi_latency", r"none \| 100 \| 7\.94 .* 5\.73 "),
    (
        "guide/solvers.md",
        "it had 99.8 % of the possible gain in 50 s",
        "many_rows",
        r"default \| 7 \| 50 \| .* 99\.76 %",
    ),
    ("guide/solvers.md", "99.0 % in 79 s, and 97.3 % in 24 s", "many_rows", r"adam 40 \| 20000 \| 79 \| .* 99\.02 %"),
    ("guide/solvers.md", "On 18 of 20 sets", "auto_inducing", r"18 of 20"),
    ("guide/noise.md", "0.55 of", "calibration", r"iiwa14 noise 0\.0 \| 4 \| 0\.549 → 0\.950"),
    ("which_model.md", "boosting has 7.5 times", "real_arms", r"gradient boosting \| 7\.49 \| 3\.21 \| 29\.0"),
    ("which_model.md", "Gaussian process 4.2 times", "real_arms", r"\| GP \| 4\.23 \| 11\.3 \| 3\.07"),
    ("which_model.md", "a Gaussian process without physics | 4.23 | 11.3 | 3.07", "real_arms", r"\| GP \| 4\.23"),
    ("which_model.md", "| `InverseDynamics` | **0.57** | 1.07 | 0.31", "real_arms", r"\| EVGP \| 0\.569 \| 1\.07"),
    ("which_model.md", "3.00 ± 0.24 kg (95 %)", "payload", r"14harm50sec \| 0\.1 \| 3\.000 ± 0\.242"),
    ("comparison.md", "`model.compile()` | 23 |", "latency", r"compiled: row, mean and std \| 23 "),
    ("comparison.md", "`predict` | 49 |", "latency", r"predict: row, mean and std \| 49 "),
    (
        "comparison.md",
        "| 1,000,000 | 72.0 | 59 | 5.86 | 3.20 | 8.14 |",
        "scaling",
        r"1000000 \| 72\.0 \| 59\.3 \| 5\.86 \| 3\.20",
    ),
    ("benchmarks.md", "GPflow's last bound in 4.0 s", "against_peers", r"skevgp \| none \| 14940 .* 3\.97 \| 8\.66"),
    ("benchmarks.md", "took GPflow 34.4 s", "against_peers", r"GPflow SGPR \| none \| 14940 \| 256 \| 34\.4 "),
    ("benchmarks.md", "these are 23.6 and 75 s", "against_peers", r"skevgp \| none \| 36000 .* 23\.6 \| 3\.18"),
    (
        "benchmarks.md",
        "96 % of the 95 % intervals",
        "identification",
        r"none \| 50 \| 52\.6 \| 0\.963[^\n]*\n[^\n]*0\.956",
    ),
    (
        "benchmarks.md",
        "is 0.022 of the variance with the URDF, and 0.63 without",
        "machines_acrobot",
        r"RES \| 0\.002\d* \| 0\.630[^|]*\|(.|\n)*IF, nominal, friction \| 0\.002\d* \| 0\.022",
    ),
    ("benchmarks.md", "1.3 to 1.6 times as long", "evaluation_cost", r"iiwa14 \| 23250 \| 350 \| 14 \| 1 .* 1\.28"),
    ("which_model.md", "needs 385 points for 800 rows", "auto_inducing", r"sines-8 \| 800 .* 385 "),
    ("which_model.md", "a point for each of 800 rows", "auto_inducing", r"acrobot \| 800 .* 800 \| 800 "),
    (
        "howto/inducing_points.md",
        "a fiftieth of the error",
        "results_table",
        r"cartpole \| EVGP-IFG .* 0\.0273 .* 0\.00056",
    ),
]


@pytest.mark.parametrize(("page", "words", "report", "line"), FIGURES)
def test_figures_of_the_prose_are_those_of_the_results(page, words, report, line):
    assert words in re.sub(r"\s+", " ", (DOCS / page).read_text())
    assert re.search(line, (comparison.RESULTS / f"{report}.md").read_text())


# --- the tools themselves -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("printed", "said", "same"),
    [
        ("a 1.00\n", "a  1.01", True),
        ("a 1.00", "a 1.2", False),
        ("b 1.00", "a 1.00", False),
        ("1", "1 2", False),
        ("[0.1 0.2]", "[0.2 0.2]", True),  # of one digit, up to that digit
        ("[0.1 0.4]", "[0.1 0.2]", False),
        ("-824 nats", "-828 nats", True),
        ("True", "False", False),
        ("", "something", False),
        ("1e-09", "2e-09", False),
    ],
)
def test_numbers_are_compared_up_to_their_digits(printed, said, same):
    assert (blocks.differences(printed, said) == []) == same
