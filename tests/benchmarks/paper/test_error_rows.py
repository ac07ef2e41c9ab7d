"""The benchmark of which test rows make an Error."""

import numpy as np
import pytest
from sklearn.utils import Bunch

from ..conftest import read

# The pendulum's q, dq/dt, u: a grid of training rows on which the angle goes to 4.
TRAIN = np.stack(np.meshgrid(np.linspace(-4.0, 4.0, 9), np.linspace(-1.0, 1.0, 5), [0.0, 1.0]), axis=-1).reshape(-1, 3)


def test_a_row_is_beyond_or_has_turned_or_neither():
    from paper.error_rows import BEYOND, LONELY, OTHERS, TURNED, WORST, kinds_of

    test = np.array([[5.0, 0.0, 0.0], [0.0, 1.1, 1.0], [-3.2, 0.0, 0.0], [4.0, 1.0, 1.0], [3.1, -1.0, 0.5], [0, 0, 1]])
    test = np.vstack([test, np.tile(TRAIN[0], (94, 1))])
    errors = np.zeros(100)
    errors[5] = 1.0
    kinds = {kind: set(np.flatnonzero(mask[:6])) for kind, mask in kinds_of("pendulum", TRAIN, test, errors).items()}
    # The grid's corner, of which the other rows are copies, has turned.
    assert kinds == {BEYOND: {0, 1}, TURNED: {2, 3}, OTHERS: {4, 5}, WORST: {5}, LONELY: kinds[LONELY]}
    # What lies between and beyond grid points; (4, 1, 1) and (0, 0, 1) are points of it.
    assert {0, 1, 2, 4} <= kinds[LONELY]


def test_a_training_rows_copy_is_not_lonely():
    from paper.error_rows import LONELY, kinds_of

    test = np.vstack([TRAIN[:81], TRAIN[:9] + [0.3, 0.1, 0.0]])
    lonely = kinds_of("pendulum", TRAIN, test, np.ones(90))[LONELY]
    assert np.array_equal(np.flatnonzero(lonely), np.arange(81, 90))


def test_shares_of_rows_and_errors_are_of_all_rows():
    from paper.error_rows import BEYOND, KINDS, OTHERS, TURNED, Cell, described

    inputs = np.vstack([TRAIN, [[9.0, 0.0, 0.0]] * 10])
    target = np.zeros((100, 2))
    mean = np.full((100, 2), [0.3, 0.4])
    mean[90:] *= 9.0
    cell = Cell("pendulum", 0, 0.0, "full")
    rows = described(cell, Bunch(data=TRAIN), Bunch(data=inputs, target=target), mean, np.full((100, 2), 0.35))
    by_kind = {row["kind"]: row for row in rows}
    assert tuple(by_kind) == KINDS
    assert by_kind[BEYOND]["of_rows"] == pytest.approx(0.1)
    assert by_kind[BEYOND]["of_error"] == pytest.approx(0.5)
    assert by_kind[BEYOND]["error"] == pytest.approx(4.5)
    assert by_kind[BEYOND]["cr3"] == 0.0
    # 0.3 is within 0.35, 0.4 is not.
    assert by_kind[OTHERS]["cr1"] == pytest.approx(0.5)
    assert by_kind[TURNED]["of_rows"] == pytest.approx(0.2)  # of nine angles two are beyond π
    assert sum(by_kind[kind]["of_error"] for kind in (BEYOND, TURNED, OTHERS)) == pytest.approx(1.0)


@pytest.mark.long
def test_the_script_fits_once_and_writes_its_page(run_script, tmp_path):
    output = tmp_path / "rows.csv"
    options = ("--quick", "--systems", "pendulum", "--jobs", 1, "--output", output)
    assert "[1/1]" in run_script("paper/error_rows.py", *options)
    assert "1 of 1 cells" in run_script("paper/error_rows.py", *options)
    rows = read(output)
    assert len(rows) == 5
    assert sum(float(row["of_rows"]) for row in rows[:3]) == pytest.approx(1.0)
    page = output.with_suffix(".md").read_text()
    for row in rows:
        assert f"| pendulum | {row['kind']} | {float(row['of_rows']):.1%} | {float(row['of_error']):.0%} |" in page
