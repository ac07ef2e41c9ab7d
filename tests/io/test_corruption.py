"""Files that somebody has damaged; `tests/long/corrupt_files.py` does the same thousands of times."""

import json
import tracemalloc

import numpy as np
import pytest

from skevgp.io import load, save

from ..long.corrupt_files import run
from .corruption import CORRUPTIONS, members_of, with_many_parts, zipped
from .models import fitted

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.mark.parametrize("models", [("unions",), ("words-in-a-pipeline",), ("nominal", "inverse-dynamics")], ids=str)
def test_damaged_files_are_refused_or_harmless(models):
    counts, defects, _ = run(120, seed=7, models=models)
    assert not defects
    assert sum(count for (_, found), count in counts.items() if found == "refused") > 60
    assert len({kind for kind, _ in counts}) == len(set(CORRUPTIONS))


def edited(data, change):
    """A file whose JSON somebody has changed: ``change`` gets the objects by the names of their classes."""
    members = dict(members_of(data))
    content = json.loads(members["model.json"])
    by_class = {}
    for own in content["objects"]:
        by_class.setdefault(own["class"], own["fields"])
    change(by_class)
    members["model.json"] = json.dumps(content).encode()
    return zipped(members.items())


@pytest.mark.parametrize(
    ("kind", "field", "value", "message"),
    [
        ("EVGPRegressor", "noise_variance_", -1.0, "of at least 0.*it is -1.0"),
        ("EVGPRegressor", "n_features_in_", 10**30, "no such file has"),
        ("EVGPRegressor", "n_features_in_", 3, "3 features"),
        ("EVGPRegressor", "n_inducing", -3, "n_inducing"),
        ("EVGPRegressor", "n_jobs", 10**6, "n_jobs must be an integer from -1024 to 1024"),
        ("EVGPRegressor", "_predictor", None, "must be a Predictor; it is None"),
        ("EVGPRegressor", "__class__", "x", r"has no \['__class__'\]"),
        ("Predictor", "noise", {"array": 0}, r"Predictor\.|shape"),
        ("Predictor", "shared", 1, "must be True or False"),
        ("PredictorGroup", "points", {"object": 0}, r"must be an array \(m, d\)"),
        ("PredictorGroup", "outputs", {"slice": [0, 9, "x"]}, "a slice of integers"),
        ("SquaredExponential", "n_columns", True, "must be an integer"),
        ("CentredSquares", "centre", {"tuple": [{"float": "nan"}, 1.0]}, "finite"),
        ("sklearn.RBF", "length_scale", -1.0, "above 0"),
        ("sklearn.RBF", "length_scale_bounds", "free", "length_scale_bounds must be"),
        ("sklearn.RBF", "length_scale_bounds", {"tuple": [-1.0, 1.0]}, "length_scale_bounds must be"),
        ("sklearn.RBF", "length_scale_bounds", {"tuple": [1.0]}, "length_scale_bounds must be"),
        ("sklearn.RBF", "length_scale_bounds", [["a", {"object": 0}]], "length_scale_bounds must be"),
        ("sklearn.RBF", "length_scale_bounds", [[1.0, 2.0, 3.0]], "length_scale_bounds must be"),
        ("sklearn.Product", "k1", {"object": 10**6}, "refers to the object"),
    ],
)
def test_what_is_edited_is_named(tmp_path, kind, field, value, message):
    path = tmp_path / "model.skevgp"
    save(fitted("plain"), path)
    path.write_bytes(edited(path.read_bytes(), lambda fields: fields[kind].update({field: value})))
    with pytest.raises(ValueError, match=message):
        load(path)


def test_an_object_that_is_part_of_many_is_counted_each_time(tmp_path):
    path = tmp_path / "model.skevgp"
    save(fitted("plain"), path)
    path.write_bytes(with_many_parts(path.read_bytes(), np.random.RandomState(0)))
    with pytest.raises(ValueError, match="more than 10000000 parts"):
        load(path)


@pytest.mark.parametrize("name", ["plain", "nominal", "unions"])
def test_loading_takes_memory_in_proportion_to_the_file(tmp_path, name):
    path = tmp_path / "model.skevgp"
    save(fitted(name), path)
    load(path)
    tracemalloc.start()
    load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30 * path.stat().st_size
