"""Models as files: they predict the same, run no code, and are refused if they are not what was saved."""

import pickle
import sys
import zipfile
from contextlib import contextmanager

import numpy as np
import pytest
import skops.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.exceptions import InconsistentVersionWarning
from skevgp.features import NominalDynamics
from skevgp.io import TRUSTED_TYPES, load, save
from skevgp.kernels import FunctionKernel
from skevgp.solvers import LBFGS

from .saved_models import CASES, ROWS, STATES, X_NEW, X, Y, evgp, fitted, new_rows, predictions

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


# --- the model is the model ---------------------------------------------------------------------------------------


@cases
def test_predictions_are_the_same_to_the_bit(name, path):
    model, rows = fitted(name), new_rows(name)
    loaded = again(model, path)
    assert_same(predictions(loaded, rows), predictions(model, rows))
    assert type(loaded) is type(model)
    assert sorted(set(vars(loaded)) ^ set(vars(model))) == []


@cases
def test_a_loaded_model_can_be_saved_and_cloned(name, path):
    loaded = again(again(fitted(name), path), path)
    assert_same(predictions(loaded, new_rows(name)), predictions(fitted(name), new_rows(name)))
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


# --- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model", [EVGPRegressor(), EGPRegressor(), make_pipeline(StandardScaler(), EGPRegressor())], ids=str
)
def test_an_unfitted_model_is_not_saved(path, model):
    if isinstance(model, Pipeline):
        model[0].fit(X)
    with pytest.raises(NotFittedError):
        save(model, path)


class OwnMap(TransformerMixin, BaseEstimator):
    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self

    def transform(self, X):
        return X


def squared(X):
    return X**2


def kernel(X, Z, size=1.0):
    return size * (X @ Z.T) ** 2


OWN = [
    (evgp(OwnMap()), "tests.test_io.OwnMap"),
    (evgp(kernel_map=make_pipeline(StandardScaler(), OwnMap())), "tests.test_io.OwnMap"),
    (evgp(FunctionTransformer(squared)), "tests.test_io.squared"),
    (evgp(kernel=FunctionKernel(kernel)), "tests.test_io.kernel"),
    (evgp(solver=LBFGS(callback=print)), "builtins.print"),
]


@pytest.mark.parametrize(("model", "name"), OWN, ids=[str(number) for number in range(len(OWN))])
def test_types_of_users_have_to_be_trusted_by_name(model, name, path):
    model = clone(model).fit(X, Y)
    with pytest.raises(ValueError, match=rf"cannot be saved.*{name}.*trusted="):
        save(model, path)
    assert list(path.parent.iterdir()) == []
    save(model, path, trusted=[name])
    with pytest.raises(ValueError, match=rf"model.skevgp' is .*{name}.*trusted="):
        load(path)
    assert_same([load(path, trusted=[name]).predict(X_NEW)], [model.predict(X_NEW)])


def test_a_file_that_would_run_code_is_refused(path):
    """What it names is not even imported."""
    save(fitted("plain"), path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["schema.json"] = (
        members["schema.json"]
        .replace(b'"EVGPRegressor"', b'"Popen"')
        .replace(b'"skevgp.estimators.evgp"', b'"subprocess"')
    )
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(ValueError, match="subprocess.Popen"):
        load(path)


@pytest.mark.parametrize("name", CASES)
def test_skops_itself_needs_to_trust_no_others(name):
    file = skops.io.dumps(fitted(name))
    assert set(skops.io.get_untrusted_types(data=file)) <= set(TRUSTED_TYPES)
    loaded = skops.io.loads(file, trusted=TRUSTED_TYPES)
    assert_same(predictions(loaded, new_rows(name)), predictions(fitted(name), new_rows(name)))


def content_of(path):
    return skops.io.load(path, trusted=TRUSTED_TYPES)


def test_a_model_that_predicts_something_else_is_refused(path):
    save(fitted("plain"), path)
    content = content_of(path)
    content["trial"]["mean"] = content["trial"]["mean"] + 1.0
    skops.io.dump(content, path)
    with pytest.raises(ValueError, match=r"does not predict what it did when it was saved, with skevgp .*scikit-learn"):
        load(path)


def test_a_std_that_is_rounding_may_be_rounded_otherwise(path):
    rows = np.linspace(-1.0, 1.0, 30)[:, np.newaxis]
    model = EGPRegressor().fit(rows, 1e3 * rows[:, 0] ** 3)
    save(model, path)
    content = content_of(path)
    assert content["trial"]["std"].max() < 1e-3
    content["trial"]["std"] = 2.0 * content["trial"]["std"]
    skops.io.dump(content, path)
    np.testing.assert_array_equal(load(path).predict(rows), model.predict(rows))


@cases
def test_all_these_models_are_tried(name, path):
    save(fitted(name), path)
    assert content_of(path)["trial"] is not None


def test_another_version_of_scikit_learn_is_told_of_a_model_that_cannot_be_tried(path):
    save(fitted("plain"), path)
    content = content_of(path)
    content["made_with"]["scikit-learn"] = "0.1"
    skops.io.dump(content, path)
    load(path)
    skops.io.dump({**content, "trial": None}, path)
    with pytest.warns(InconsistentVersionWarning, match=r"was saved with scikit-learn 0\.1, and this is"):
        load(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"format": "skevgp", "version": 99}, "of version 99.*; update skevgp"),
        ({"format": "other", "version": 2}, "does not say that it is one"),
        ([1, 2], "does not say that it is one"),
        ({"format": "skevgp", "version": 2, "model": 3, "made_with": {}, "trial": None}, "int instead of a model"),
        ({"format": "skevgp", "version": 2}, "KeyError: 'model'"),
    ],
)
def test_other_contents_are_refused(content, message, path):
    skops.io.dump(content, path)
    with pytest.raises(ValueError, match=f"model.skevgp.*{message}"):
        load(path)


def test_files_of_version_0_1_and_compressed_ones_are_refused_by_name(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model.json", "{}")
    with pytest.raises(ValueError, match="of skevgp 0.1, which this version does not read"):
        load(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("schema.json", "0" * 1000)
    with pytest.raises(ValueError, match="compressed"):
        load(path)


@contextmanager
def suppress_value_errors_that_name(name):
    try:
        yield
    except ValueError as error:
        if name not in str(error):
            raise


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_file_is_a_value_error_or_predicts_the_same(path, draws):
    save(fitted("plain"), path)
    data = bytearray(path.read_bytes())
    if draws.draw(st.booleans()):
        del data[draws.draw(st.integers(0, len(data) - 1)) :]
    else:
        for _ in range(draws.draw(st.integers(1, 4))):
            data[draws.draw(st.integers(0, len(data) - 1))] ^= 1 << draws.draw(st.integers(0, 7))
    path.write_bytes(data)
    expected, std = fitted("plain").predict(new_rows("plain"), return_std=True)
    with suppress_value_errors_that_name("model.skevgp"):
        # What is not used to predict may differ.
        np.testing.assert_allclose(load(path).predict(new_rows("plain")), expected, atol=0.05 * std.max())


# --- all or nothing -----------------------------------------------------------------------------------------------


def test_a_failure_leaves_the_old_file(path, monkeypatch):
    save(fitted("plain"), path)
    before = path.read_bytes()

    def full(content, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(skops.io, "dump", full)
    with pytest.raises(OSError, match="No space left"):
        save(fitted("outputs"), path)
    assert path.read_bytes() == before
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_a_new_file_replaces_the_old_one_and_a_link_stays_a_link(path, tmp_path):
    link = tmp_path / "latest.skevgp"
    save(fitted("plain"), path)
    path.chmod(0o640)
    link.symlink_to(path)
    save(fitted("outputs"), str(link))
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640
    assert load(str(path)).predict(X_NEW).shape == (7, 3)
    with pytest.raises(FileNotFoundError):
        load(path.with_name("other"))


@pytest.mark.parametrize("name", ["plain", "student-t", "kernel", "auto-m"])
def test_there_are_no_training_data_in_a_file(name, path):
    """A sparse model's files do not grow with the rows, except by one weight for each doubted one."""
    model, inputs, targets, _ = CASES[name]
    sizes = []
    for repeats in (2, 60):
        some = clone(model).set_params(sharing="all").fit(np.tile(inputs, (repeats, 1)), np.tile(targets.T, repeats).T)
        save(some, path)
        weights = getattr(some, "weights_", np.empty(0)).nbytes
        sizes.append([size - weights for size in (path.stat().st_size, len(pickle.dumps(some)))])
    few, many = np.array(sizes)
    assert (many < 1.2 * few + 2000).all(), sizes


def test_without_skops_there_is_the_pip_command(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "skops.io", None)
    with pytest.raises(ImportError, match="pip install skops"):
        save(fitted("plain"), path)
