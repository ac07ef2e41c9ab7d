"""Models as files: they predict the same, run no code, and are refused if they are not what was saved."""

import json
import pickle
import sys
import zipfile
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import skops.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.stats import randint
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, GroupKFold, RandomizedSearchCV
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.exceptions import InconsistentVersionWarning
from skevgp.features import NominalDynamics
from skevgp.io import TRUSTED_TYPES, load, save
from skevgp.kernels import FunctionKernel
from skevgp.metrics import neg_nlpd
from skevgp.solvers import LBFGS

from .saved_models import CASES, ROWS, STATES, X_NEW, X, Y, evgp, fitted, new_rows, predictions

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
# These continue with partial_fit, too.
CONTINUED = ["groups", "adam-object", "student-t", "input-noise", "shared-weights", "words", "nominal"]
# Others save what these do: a solver by its name instead of an object, no features instead of some, parameters
# ("friction"), a robot as numbers (test_load_without_urdf_file), a regressor of torques ("physics-alone").
_LONG = {"adam", "exact-plain", "auto-m", "factors", "nominal-of-a-model", "torques"}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.skevgp"


def again(model, path):
    save(model, path)
    return load(path)


@cache
def saved(name):
    """The bytes of one file; another has other names of arrays."""
    with TemporaryDirectory() as folder:
        save(fitted(name), Path(folder) / "model")
        return Path(folder, "model").read_bytes()


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


# --- the model is the model ---------------------------------------------------------------------------------------


def loaded_and_same(name, path):
    """A model from a file, after all that it predicts was compared."""
    model, rows = fitted(name), new_rows(name)
    path.write_bytes(saved(name))
    loaded = load(path)
    assert_same(predictions(loaded, rows), predictions(model, rows))
    assert type(loaded) is type(model)
    assert sorted(set(vars(loaded)) ^ set(vars(model))) == []
    assert compares_predictions(path)
    return loaded


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.long] * (name in _LONG)) for name in CASES if name not in CONTINUED],
)
def test_predictions_are_the_same_to_the_bit(name, path):
    loaded_and_same(name, path)


@pytest.mark.parametrize("name", CONTINUED)
def test_loaded_model_predicts_the_same_and_continues_partial_fit(name, path):
    loaded, rows = loaded_and_same(name, path), new_rows(name)
    original = pickle.loads(pickle.dumps(fitted(name)))
    targets = np.random.RandomState(5).randn(*np.shape(original.predict(rows)))
    for model in (original, loaded):
        model.partial_fit(rows, targets)
    assert_same(predictions(loaded, rows), predictions(original, rows))


_SEARCH = GridSearchCV(evgp(), {"n_inducing": [4, 6]}, cv=2)
_OF_SCIKIT_LEARN = {
    "search": _SEARCH,
    "search by name": clone(_SEARCH).set_params(scoring="r2", cv=GroupKFold(2)),
    "search by likelihood": GridSearchCV(
        make_pipeline(StandardScaler(), evgp()),
        {"evgpregressor__n_inducing": [4]},
        scoring={"nlpd": neg_nlpd, "error": "neg_mean_squared_error"},
        refit="nlpd",
        cv=2,
    ),
    "search in a residual": ResidualRegressor(_SEARCH),
    "target": TransformedTargetRegressor(evgp(), transformer=StandardScaler()),
    "outputs": MultiOutputRegressor(evgp()),
    "range": evgp(sharing=[range(2)]),
    "pipeline of one": make_pipeline(evgp()),
}


def test_unsavable_search_advises_best_estimator(path):
    search = RandomizedSearchCV(evgp(), {"n_inducing": randint(3, 6)}, n_iter=1, cv=2, random_state=0).fit(X, Y)
    with pytest.raises(ValueError, match=r"cannot be saved.*Save its best_estimator_"):
        save(search, path)
    save(search.best_estimator_, path)


# "search by name" has more of a search.
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name == "search")) for name in _OF_SCIKIT_LEARN]
)
def test_search_and_meta_estimators_are_saved(name, path):
    groups = {"groups": np.arange(60) // 10} if name == "search by name" else {}
    model = clone(_OF_SCIKIT_LEARN[name]).fit(X, Y[:, :2], **groups)
    assert_same([again(model, path).predict(X_NEW)], [model.predict(X_NEW)])
    assert compares_predictions(path)


# --- robots ------------------------------------------------------------------------------------------------------


def test_load_without_urdf_file(path, tmp_path):
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


@pytest.mark.parametrize("name", ["inverse-dynamics", "words"])
def test_load_opens_only_file(name, path):
    path.write_bytes(saved(name))
    load(path)  # what is imported is imported now
    opened, watching = [], True

    def watch(event, arguments):
        if watching and event in ("open", "os.listdir", "subprocess.Popen", "socket.connect", "exec"):
            opened.append((event, str(arguments[0])))

    sys.addaudithook(watch)
    load(path)
    watching = False
    assert opened == [("open", str(path))]


def test_without_pinocchio_a_robot_gets_the_pip_command(path, monkeypatch):
    path.write_bytes(saved("nominal"))
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(ImportError, match="pip install pin "):
        load(path)


# --- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model", [EVGPRegressor(), EGPRegressor(), make_pipeline(StandardScaler(), EGPRegressor())], ids=str
)
def test_unfitted_model_is_not_saved(path, model):
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
def test_user_types_must_be_trusted(model, name, path):
    model = clone(model).fit(X, Y[:, 0])
    path.write_bytes(b"before")
    with pytest.raises(ValueError, match=rf"cannot be saved.*{name}.*trusted="):
        save(model, path)
    assert path.read_bytes() == b"before"
    assert list(path.parent.iterdir()) == [path]
    save(model, path, trusted=[name])
    with pytest.raises(ValueError, match=rf"model.skevgp' cannot be loaded.*{name}.*trusted="):
        load(path)
    assert_same([load(path, trusted=[name]).predict(X_NEW)], [model.predict(X_NEW)])


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_members(path, members, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def compares_predictions(path):
    """Whether the file holds rows with their predictions, without the time that loading it takes."""
    return json.loads(members_of(path)["schema.json"])["content"]["trial"]["__class__"] == "dict"


def content_of(path):
    return skops.io.load(path, trusted=TRUSTED_TYPES)


def write_content(path, content, **about):
    """A file of another content or of other versions."""
    versions = {**json.loads(members_of(path)["skevgp.json"]), **about}
    skops.io.dump(content, path)
    write_members(path, {**members_of(path), "skevgp.json": json.dumps(versions)})


def test_foreign_files_raise(path):
    path.write_bytes(saved("plain"))
    write_members(path, {**members_of(path), "more": bytes(2**25)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match=r"model.skevgp' .* bytes and unpacks to 33"):
        load(path)
    write_members(path, {"model.json": "{}"})
    with pytest.raises(ValueError, match=r"model.skevgp' .*of skevgp 0\.1, which this version does not read"):
        load(path)
    skops.io.dump(fitted("plain"), path)
    with pytest.raises(ValueError, match=r"model.skevgp' .*is not a file of skevgp\.io\.save"):
        load(path)
    path.write_text("no model")
    with pytest.raises(ValueError, match=r"model.skevgp' cannot be loaded: File is not a zip file\.$"):
        load(path)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("subprocess", "Popen"),
        ("builtins", "eval"),
        ("numpy", "memmap"),
        ("sklearn.utils", "Bunch"),
        ("skevgp.utils.files", "replacing"),
        ("skevgp.io", "save"),
        ("skevgp.data.threads", "BlockMap"),
    ],
)
def test_file_with_untrusted_type_raises(module, name, path):
    """What it names is not even imported."""
    path.write_bytes(saved("plain"))
    members = members_of(path)
    members["schema.json"] = (
        members["schema.json"]
        .replace(b'"EVGPRegressor"', f'"{name}"'.encode())
        .replace(b'"skevgp.estimators.evgp"', f'"{module}"'.encode())
    )
    write_members(path, members)
    with pytest.raises(ValueError, match=rf"model.skevgp' cannot be loaded: it holds {module}\.{name}, "):
        load(path)


def test_changed_predictions_raise(path):
    path.write_bytes(saved("plain"))
    content = content_of(path)
    content["trial"]["mean"] = content["trial"]["mean"] + 1.0
    write_content(path, content)
    with pytest.raises(ValueError, match=r"model.skevgp' .*predicts other values than when it was saved\.$"):
        load(path)
    write_content(path, content, skevgp="0.2.7", numpy="1.0")
    with pytest.raises(ValueError, match=r"saved with skevgp 0\.2\.7, scikit-learn .*, numpy 1\.0, .*here: skevgp"):
        load(path)


def test_classes_of_another_version_raise(path, monkeypatch):
    path.write_bytes(saved("plain"))
    content = content_of(path)
    monkeypatch.setattr("skevgp.io.TRUSTED_TYPES", [name for name in TRUSTED_TYPES if "Fitted" not in name])
    write_content(path, content, skevgp="0.2.0")
    with pytest.raises(ValueError, match=r"holds skevgp\.\S*Fitted.* does not have\. Fit .* skevgp 0\.2\.0"):
        load(path)


def test_other_sklearn_version_warns(path):
    path.write_bytes(saved("plain"))
    content, other = content_of(path), {"scikit-learn": "0.1"}
    write_content(path, content, **other)
    load(path)
    write_content(path, {**content, "trial": None}, **other)
    with pytest.warns(InconsistentVersionWarning, match=r"was saved with skevgp .*, scikit-learn 0\.1, .*here: "):
        load(path)


@pytest.mark.parametrize(
    ("content", "about", "message"),
    [
        (None, {"format": 99, "skevgp": "7.0"}, "format 99 of skevgp 7.0, .* reads 2"),
        (None, {"format": "2"}, "is not a file of skevgp.io.save"),
        ([1, 2], {}, "is not a file of skevgp.io.save"),
        ({"model": 3, "trial": None}, {}, "int instead of a model"),
        ({"model": EVGPRegressor(), "trial": None}, {}, "NotFittedError"),
        ({"model": StandardScaler().fit(X), "trial": {}}, {}, "KeyError: 'rows'"),
    ],
)
def test_invalid_content_raises(content, about, message, path):
    path.write_bytes(saved("plain"))
    write_content(path, content, **about)
    with pytest.raises(ValueError, match=f"model.skevgp' cannot be loaded: .*{message}"):
        load(path)


@contextmanager
def errors_that_name(text):
    try:
        yield
    except ValueError as error:
        if text not in str(error):
            raise


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_file_raises_or_predicts_same(path, draws):
    model, rows = fitted("plain"), new_rows("plain")
    data = bytearray(saved("plain"))
    place = st.integers(0, len(data) - 1)
    if draws.draw(st.booleans()):
        del data[draws.draw(place) :]
    else:
        for _ in range(draws.draw(st.integers(1, 4))):
            data[draws.draw(place)] ^= 1 << draws.draw(st.integers(0, 7))
    path.write_bytes(data)
    expected, std = model.predict(rows, return_std=True)
    with errors_that_name("model.skevgp' cannot be loaded: "):
        # What is not used to predict may differ.
        np.testing.assert_allclose(load(path).predict(rows), expected, atol=0.05 * std.max())


# --- all or nothing -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["plain", "student-t", "kernel", "auto-m"])
def test_file_has_no_training_data(name, path):
    """A sparse model's files do not grow with the rows, except by one weight for each doubted one."""
    model, inputs, targets, _ = CASES[name]
    sizes = []
    for repeats in (1, 40):
        some = clone(model).set_params(sharing="all", max_iter=1)
        some.fit(np.tile(inputs, (repeats, 1)), np.tile(targets.T, repeats).T)
        save(some, path)
        assert path.stat().st_size < 60_000
        weights = getattr(some, "weights_", np.empty(0)).nbytes
        sizes.append([size - weights for size in (path.stat().st_size, len(pickle.dumps(some)))])
    few, many = np.array(sizes)
    assert (many < 1.2 * few + 2000).all(), sizes


def test_without_skops_there_is_the_pip_command(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "skops.io", None)
    with pytest.raises(ImportError, match="pip install skops"):
        save(fitted("plain"), path)
    monkeypatch.undo()
    save(fitted("plain"), path)
    monkeypatch.setitem(sys.modules, "skops.io", None)
    with pytest.raises(ImportError, match=r"pip install skops .*\.\[io\]"):
        load(path)


def test_trusted_types_exist():
    """Except those that only some versions of their packages have."""
    some = {"scipy._lib", "scipy.interpolate._bsplines", "sklearn.compose._column_transformer"}
    for name in TRUSTED_TYPES:
        module, _, own = name.rpartition(".")
        assert module.startswith(tuple(some)) or getattr(import_module(module), own) is not None
