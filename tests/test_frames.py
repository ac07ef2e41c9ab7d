import sys
from importlib import import_module

import numpy as np
import pandas as pd
import polars as pl
import pytest

from skevgp.utils.frames import FrameColumns

COLUMNS = {"a": [1.0, 2.0], "word": ["hot", "cold"]}


def table_of_pyarrow(columns):
    return import_module("pyarrow").table(columns)


@pytest.mark.parametrize(
    "frame_of", [pd.DataFrame, pl.DataFrame, pytest.param(table_of_pyarrow, marks=pytest.mark.long)]
)
def test_frame_comes_back(frame_of):
    frame = frame_of(COLUMNS)
    again = FrameColumns.of(frame).frame()
    assert type(again) is type(frame)
    for name, values in COLUMNS.items():
        assert np.asarray(again[name]).tolist() == values


@pytest.mark.parametrize("value", [None, "a", np.eye(2), [[1.0]], {"a": [1.0]}])
def test_array_is_no_frame(value):
    assert FrameColumns.of(value) is None


def test_without_its_package_a_frame_gets_the_pip_command(monkeypatch):
    columns = FrameColumns.of(pd.DataFrame(COLUMNS))
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        columns.frame()


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (FrameColumns("os", [], []), "no data frames of 'os'"),
        (FrameColumns("pandas", ["a"], []), "with 1 columns"),
        (FrameColumns("pandas", ["a", "b"], [np.zeros(2), np.zeros(3)]), "differ in length"),
    ],
)
def test_columns_that_do_not_fit_raise(columns, message):
    with pytest.raises(ValueError, match=message):
        columns.frame()
