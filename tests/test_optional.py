import json
import subprocess
import sys
from pathlib import Path

import pytest

import skevgp
from skevgp.datasets import make_dynamics
from skevgp.utils.optional import require

ROOT = Path(skevgp.__file__).parents[1]
OPTIONAL = {"pinocchio", "example_robot_data", "matplotlib", "dask", "distributed", "casadi", "rosbags", "skops"}


def packages_loaded_by(code):
    """Names of the packages that a fresh interpreter has loaded after some code."""
    code += "\nimport json, sys\nprint(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    return set(json.loads(done.stdout))


def test_require_imports_package():
    assert require("matplotlib.colors", "Plotting") is sys.modules["matplotlib.colors"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pinocchio", r"Simulating needs the optional package 'pin'.*pip install pin .*pip install '\.\[physics\]'"),
        ("matplotlib", r"Simulating needs .* 'matplotlib'.*pip install matplotlib .*pip install '\.\[plot\]'"),
        ("rosbags", r"Simulating needs .* 'rosbags'.*pip install rosbags .*pip install '\.\[logs\]'"),
    ],
)
def test_missing_package_gets_the_pip_command(monkeypatch, name, message):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=message):
        require(name, "Simulating")


def test_unknown_system_is_told_before_the_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(ValueError, match="Unknown robot"):
        make_dynamics("robot")


def test_importing_the_package_loads_no_other():
    bare = packages_loaded_by("")
    loaded = packages_loaded_by("import skevgp") - bare
    assert "skevgp" in loaded
    assert not loaded & (OPTIONAL | {"sklearn", "scipy", "numpy", "autograd"})


@pytest.mark.long
@pytest.mark.parametrize(
    "code",
    [
        "from skevgp import EVGPRegressor",
        "from skevgp import datasets, features, metrics, plotting",
        "from skevgp.features import InertiaForceGravity\n"
        "InertiaForceGravity('acrobot').fit_transform([[0.0] * 5])\n"
        "InertiaForceGravity('acrobot').coef_prior(4)",
        "from skevgp.datasets import make_toy\nmake_toy()",
    ],
)
def test_optional_packages_are_loaded_only_where_they_are_used(code):
    loaded = packages_loaded_by(code)
    assert "sklearn" in loaded
    assert not loaded & OPTIONAL


def test_public_names_are_listed():
    assert dir(skevgp) == sorted(skevgp.__all__)
    assert {"EVGPRegressor", "datasets", "features", "metrics", "plotting", "__version__"} <= set(dir(skevgp))


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'skevgp' has no attribute 'EVGPClassifier'"):
        skevgp.EVGPClassifier  # noqa: B018


def test_unknown_name_cannot_be_imported():
    with pytest.raises(ImportError, match="cannot import name 'EVGPClassifier'"):
        from skevgp import EVGPClassifier  # noqa: F401
