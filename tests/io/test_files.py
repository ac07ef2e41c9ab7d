import json
import os
import pickle
import sys
import zipfile

import joblib
import numpy as np
import pytest
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import Ridge
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

import skevgp.io.files
from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.exceptions import InconsistentVersionWarning
from skevgp.features import NominalDynamics
from skevgp.io import load, save
from skevgp.kernels import FunctionKernel
from skevgp.solvers import LBFGS

from .corruption import members_of, zipped
from .models import CASES, ROWS, STATES, X_NEW, X, Y, evgp, fitted, new_rows, predictions

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
cases = pytest.mark.parametrize("name", CASES)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.skevgp"


def again(model, path):
    save(model, path)
    return load(path)


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


# --- the model is the model --------------------------------------------------------------------------------------


@cases
def test_predictions_are_the_same_to_the_bit(name, path):
    model, rows = fitted(name), new_rows(name)
    loaded = again(model, path)
    assert_same(predictions(loaded, rows), predictions(model, rows))
    assert type(loaded) is type(model)
    assert sorted(set(vars(loaded)) ^ set(vars(model)) - {"_training_data"}) == []


@cases
def test_a_loaded_model_can_be_saved_and_cloned(name, path):
    loaded = again(fitted(name), path)
    first = path.read_bytes()
    save(loaded, path)
    assert path.read_bytes() == first
    clone(loaded)


@pytest.mark.parametrize("name", [name for name, (model, *_) in CASES.items() if isinstance(model, EVGPRegressor)])
def test_a_loaded_model_goes_on_as_the_model_does(name, path):
    original, rows = fitted(name), new_rows(name)
    loaded, original = again(original, path), pickle.loads(pickle.dumps(original))
    targets = np.random.RandomState(5).randn(*np.shape(original.predict(rows)))
    for model in (original, loaded):
        model.partial_fit(rows, targets)
    assert_same(predictions(loaded, rows), predictions(original, rows))


@pytest.mark.parametrize("name", ["plain", "outputs", "unions", "scalers", "kernel-sum", "exact", "sines", "nominal"])
def test_controllers_get_the_same(name, path):
    model, rows = fitted(name), new_rows(name)
    loaded = again(model, path)
    assert_same([loaded.jacobian(rows)], [model.jacobian(rows)])
    both = loaded.compile(), model.compile()
    assert_same(*(one.predict(rows, return_std=True) for one in both))
    assert_same(loaded.value_and_jacobian(rows), model.value_and_jacobian(rows))


def test_what_is_told_of_a_fit_is_there(path):
    model = fitted("unions")
    loaded = again(model, path)
    assert repr(loaded.kernel_) == repr(model.kernel_)
    assert_same([loaded.coef_, loaded.coef_std_, loaded.coef_names_], [model.coef_, model.coef_std_, model.coef_names_])
    assert loaded.lower_bound_ == pytest.approx(model.lower_bound_, rel=1e-12)
    assert repr(loaded) == repr(model)


def test_random_states_go_on_where_they_were(path):
    model = clone(CASES["plain"][0]).set_params(random_state=np.random.RandomState(3)).fit(X, Y[:, 0])
    loaded = again(model, path)
    np.testing.assert_array_equal(loaded.random_state.uniform(size=9), model.random_state.uniform(size=9))


@pytest.mark.parametrize(
    "model", [EVGPRegressor(), EGPRegressor(), make_pipeline(StandardScaler(), EGPRegressor())], ids=str
)
def test_an_unfitted_model_is_not_saved(path, model):
    if isinstance(model, Pipeline):
        model[0].fit(X)
    with pytest.raises(NotFittedError):
        save(model, path)
    assert not path.exists()


def test_of_a_search_what_is_inside_is_advised(path):
    search = GridSearchCV(CASES["plain"][0], {"n_inducing": [5]}, cv=2).fit(X, Y[:, 0])
    with pytest.raises(ValueError, match=r"GridSearchCV.*Save its best_estimator_, or"):
        save(search, path)


# --- robots ------------------------------------------------------------------------------------------------------


def test_a_robots_file_need_not_be_there(path, tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        """<robot name="arm"><link name="base"/><link name="a"><inertial><mass value="1"/>
        <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
        <joint name="q" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
        <origin xyz="0 0 1"/><limit effort="5" lower="-1" upper="1" velocity="1"/></joint></robot>"""
    )
    rows = ROWS[:, :3]
    model = evgp(NominalDynamics(urdf)).fit(rows, STATES[:, :2])
    save(model, path)
    urdf.unlink()
    loaded = load(path)
    np.testing.assert_array_equal(loaded.predict(rows), model.predict(rows))
    assert loaded.feature_map.robot == str(urdf)
    with pytest.raises(ValueError, match="There is no file"):
        clone(loaded).fit(rows, STATES[:, :2])


@pytest.mark.parametrize("name", ["nominal", "inverse-dynamics", "levers", "residual", "words"])
def test_nothing_but_the_file_is_opened(name, path):
    save(fitted(name), path)
    load(path)  # what is imported is imported now
    opened, watching = [], True

    def watch(event, arguments):
        if watching and event in ("open", "os.listdir", "subprocess.Popen", "socket.connect", "exec", "compile"):
            opened.append((event, str(arguments[0])))

    sys.addaudithook(watch)
    load(path)
    watching = False
    assert opened == [("open", str(path))]


def test_without_pinocchio_a_robot_gets_the_pip_command(path, monkeypatch):
    save(fitted("nominal"), path)
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(ImportError, match="pip install pin "):
        load(path)


def test_maps_of_named_systems_need_no_pinocchio(path, monkeypatch):
    save(fitted("sines"), path)
    expected = fitted("sines").predict(new_rows("sines"))
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    np.testing.assert_array_equal(load(path).predict(new_rows("sines")), expected)


def test_without_the_package_of_its_frames_a_model_gets_the_pip_command(path, monkeypatch):
    save(fitted("words"), path)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        load(path)


# --- what is refused ---------------------------------------------------------------------------------------------


class OwnMap(TransformerMixin, BaseEstimator):
    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self

    def transform(self, X):
        return X


class OwnScaler(StandardScaler):
    pass


def squared(X):
    return X**2


def kernel(X, Z, size=1.0):
    return size * (X @ Z.T) ** 2


@pytest.mark.parametrize(
    ("model", "where"),
    [
        (evgp(OwnMap()), r"model\.feature_map is a tests\.io\.test_files\.OwnMap"),
        (
            evgp(kernel_map=make_pipeline(StandardScaler(), OwnMap())),
            r"model\.kernel_map\.steps\[1\]\[1\] is a .*Map",
        ),
        (evgp(kernel_map=OwnScaler()), r"model\.kernel_map is a .*OwnScaler"),
        (evgp(FunctionTransformer(squared)), r"model\.feature_map\.func is the function 'squared'"),
        (evgp(FunctionTransformer(np.sin)), r"model\.feature_map\.func is the function"),
        (evgp(kernel=FunctionKernel(kernel)), r"model\.kernel is a skevgp\..*FunctionKernel"),
        (evgp(solver=LBFGS(callback=print)), r"model\.solver\.callback is the function 'print'"),
        (ResidualRegressor(Ridge()), r"model\.regressor is a sklearn\.linear_model\._ridge\.Ridge"),
    ],
    ids=lambda value: None if isinstance(value, str) else repr(value)[:40],
)
def test_code_and_foreign_classes_are_refused_by_name(model, where, path):
    model = model.fit(X, Y[:, 0])
    path.write_bytes(b"before")
    with pytest.raises(ValueError, match=where + r".*skops\.io\.dump.*pickle"):
        save(model, path)
    assert path.read_bytes() == b"before"
    assert os.listdir(path.parent) == [path.name]


def test_what_a_user_puts_on_an_estimator_is_refused(path):
    model = clone(CASES["plain"][0]).fit(X, Y[:, 0])
    model.note_ = "mine"
    with pytest.raises(ValueError, match=r"EVGPRegressor.*\['note_'\]"):
        save(model, path)


def test_not_a_model(path):
    with pytest.raises(TypeError, match="not an estimator instance"):
        save({"a": 1}, path)


def test_a_model_that_could_not_be_read_is_not_saved(path):
    model = clone(CASES["plain"][0]).fit(X, Y[:, 0])
    model.coef_ = np.array([np.nan])
    with pytest.raises(ValueError, match=r"cannot be saved.*EVGPRegressor\.coef_ must be"):
        save(model, path)
    assert os.listdir(path.parent) == []


# --- all or nothing ----------------------------------------------------------------------------------------------


class FullDisk:
    """A file that takes so many bytes."""

    def __init__(self, file, size):
        self._file, self._left = file, size

    def write(self, data):
        self._left -= len(data)
        if self._left < 0:
            raise OSError(28, "No space left on device")
        return self._file.write(data)

    def __getattr__(self, name):
        return getattr(self._file, name)


@pytest.mark.parametrize("size", [0, 1000, 15_000])
def test_a_full_disk_leaves_the_old_file(path, monkeypatch, size):
    save(fitted("plain"), path)
    before, write = path.read_bytes(), skevgp.io.files.write
    monkeypatch.setattr(skevgp.io.files, "write", lambda file, *parts: write(FullDisk(file, size), *parts))
    with pytest.raises(OSError, match="No space left"):
        save(fitted("outputs"), path)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_a_new_file_takes_the_place_of_the_old_one(path):
    save(fitted("outputs"), path)
    os.chmod(path, 0o640)
    save(fitted("plain"), path)
    assert path.stat().st_mode & 0o777 == 0o640
    assert_same([load(path).predict(X_NEW)], [fitted("plain").predict(X_NEW)])


def test_a_link_stays_a_link(path, tmp_path):
    link = tmp_path / "latest.skevgp"
    save(fitted("plain"), path)
    link.symlink_to(path)
    save(fitted("outputs"), link)
    assert link.is_symlink()
    assert load(path).predict(X_NEW).shape == (7, 3)


def test_paths_are_strings_too(path):
    save(fitted("plain"), str(path))
    load(str(path))
    with pytest.raises(FileNotFoundError):
        load(path.with_name("other"))


# --- what is in a file -------------------------------------------------------------------------------------------


def test_numpy_and_zip_programs_read_it(path):
    save(fitted("plain"), path)
    with np.load(path, allow_pickle=False) as arrays:
        assert any(np.array_equal(arrays[name], fitted("plain").inducing_points_) for name in arrays if name.isdigit())
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None


@pytest.mark.parametrize("name", ["plain", "student-t", "unions", "sines"])
def test_there_are_no_training_data_in_a_file(name, path, tmp_path):
    """A sparse model's files do not grow with the rows, but for one weight each of doubted ones."""
    model, inputs, targets, _ = CASES[name]
    sizes = []
    for repeats in (2, 60):
        some = clone(model).set_params(sharing="all").fit(np.tile(inputs, (repeats, 1)), np.tile(targets.T, repeats).T)
        save(some, path)
        joblib.dump(some, tmp_path / "model.joblib")
        weights = getattr(some, "weights_", np.empty(0)).nbytes
        own = [path.stat().st_size, len(pickle.dumps(some)), (tmp_path / "model.joblib").stat().st_size]
        sizes.append([size - weights for size in own])
    few, many = np.array(sizes)
    assert (many < 1.2 * few + 2000).all(), sizes


def changed(data, **parts):
    members = dict(members_of(data))
    members["model.json"] = json.dumps({**json.loads(members["model.json"]), **parts}).encode()
    return zipped(members.items())


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"version": 2}, r"it is of version 2, and this skevgp .* reads files up to version 1: update skevgp"),
        ({"version": 0}, "other parts"),
        ({"version": "1"}, "does not say that it is one"),
        ({"format": "other"}, "does not say that it is one"),
        ({"more": 1}, "other parts"),
        ({"made_with": []}, "what it was made with"),
        ({"objects": {}}, "objects are no list"),
        (
            {"objects": [{"class": "os.system", "fields": {}}]},
            "is of the class 'os.system', which skevgp.io does not know",
        ),
        ({"model": 3}, "a int in place of a model"),
        ({"model": {"object": 0}}, "in place of a model"),
        ({"trial": 3}, "trial"),
    ],
)
def test_errors_say_what_is_wrong(path, parts, message):
    save(fitted("plain"), path)
    path.write_bytes(changed(path.read_bytes(), **parts))
    with pytest.raises(ValueError, match=message) as caught:
        load(path)
    assert repr(str(path)) in str(caught.value)


def test_a_model_that_predicts_something_else_is_refused(path):
    save(fitted("plain"), path)
    members = dict(members_of(path.read_bytes()))
    (number,) = (name for name in members if name != "model.json" and _is_mean(members[name]))
    members[number] = members[number][:-8] + np.float64(2.0).tobytes()
    path.write_bytes(zipped(members.items()))
    with pytest.raises(ValueError, match=r"does not predict what it did when it was saved, with skevgp .*scikit-learn"):
        load(path)


def test_a_std_that_is_rounding_may_be_rounded_otherwise(path):
    """Where there is no noise, it is one thousandth of a thousandth of what y is; the mean counts."""
    rows = np.linspace(-1.0, 1.0, 30)[:, np.newaxis]
    model = EGPRegressor().fit(rows, 1e3 * rows[:, 0] ** 3)
    save(model, path)
    members = dict(members_of(path.read_bytes()))
    _, std = model.predict(rows[:4], return_std=True)
    assert std.max() < 1e-3
    numbers = [
        name for name in members if name != "model.json" and np.array_equal(np.frombuffer(members[name][128:]), std)
    ]
    assert numbers
    for name in numbers:
        members[name] = members[name][:128] + (2.0 * std).tobytes()
    path.write_bytes(zipped(members.items()))
    np.testing.assert_array_equal(load(path).predict(rows), model.predict(rows))


def test_weights_of_rows_that_do_not_count_are_kept(path):
    rows = np.random.RandomState(0).randn(30, 2)
    model = EVGPRegressor(n_inducing=5, noise="student-t", max_iter=5, tol=1e6)
    model.fit(rows, rows[:, 0], sample_weight=np.r_[0.0, np.ones(29)])
    save(model, path)
    assert np.isnan(model.weights_[0])
    np.testing.assert_array_equal(load(path).weights_, model.weights_)


def test_limits_of_the_kernel_are_those_of_the_fit(path):
    """The widest of them too."""
    rows = np.random.RandomState(0).uniform(-2, 2, (40, 1))
    model = EVGPRegressor(n_inducing=10, random_state=0).fit(rows, rows[:, 0] ** 3)
    save(model, path)
    again = load(path)
    np.testing.assert_array_equal(again.kernel_.bounds, model.kernel_.bounds)
    table, own = (one._fitted.learned[0].table for one in (again, model))
    np.testing.assert_array_equal(table["signal"].value_limits(), own["signal"].value_limits())


def _is_mean(content):
    values = np.frombuffer(content[128:])
    mean = fitted("plain")._posterior.predictor.groups[0].mean
    return content.startswith(b"\x93NUMPY") and np.array_equal(values, mean.ravel())


def test_another_version_of_scikit_learn_is_told_of_a_model_that_cannot_be_tried(path):
    save(fitted("plain"), path)
    data, made_with = path.read_bytes(), {"scikit-learn": "0.1"}
    path.write_bytes(changed(data, made_with=made_with))
    load(path)
    path.write_bytes(changed(data, made_with=made_with, trial=None))
    with pytest.warns(InconsistentVersionWarning, match=r"was saved with scikit-learn 0\.1, and this is"):
        load(path)


@cases
def test_all_these_models_can_be_tried(name, path):
    save(fitted(name), path)
    assert json.loads(dict(members_of(path.read_bytes()))["model.json"])["trial"] is not None


def test_a_file_is_small_and_the_same_each_time(path):
    save(fitted("plain"), path)
    first = path.read_bytes()
    save(fitted("plain"), path)
    assert path.read_bytes() == first
    assert len(first) < 30_000
