"""Files around the package agree with `pyproject.toml`, and name what exists."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import skevgp

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RECIPE = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
# Packages with another name at conda-forge.
CONDA_NAMES = {"pin": "pinocchio", "matplotlib": "matplotlib-base", "dask": "dask-core"}


def bounds(requirements):
    """The lower bound of each package, which is named as conda-forge names it."""
    found = (re.fullmatch(r"([\w-]+)(?:\[.*\])? ?>=([\d.]+)", each) for each in requirements)
    return {CONDA_NAMES.get(match[1], match[1]): match[2] for match in found}


def test_all_files_have_the_version_of_the_package():
    assert RECIPE["context"]["version"] == CITATION["version"] == skevgp.__version__


def test_recipe_has_the_dependencies_of_the_package():
    python, *needed = RECIPE["requirements"]["run"]
    assert python == "python >=${{ python_min }}"
    assert PROJECT["requires-python"] == f">={RECIPE['context']['python_min']}"
    assert bounds(needed) == bounds(PROJECT["dependencies"])


def test_recipe_has_the_bounds_of_the_extras():
    extras = PROJECT["optional-dependencies"]
    known = bounds(needed for name in ("physics", "plot", "dask", "casadi", "control") for needed in extras[name])
    constraints = bounds(RECIPE["requirements"]["run_constraints"])
    assert constraints == {name: known[name] for name in constraints}


def test_recipe_says_what_the_package_is():
    assert RECIPE["about"]["summary"] == PROJECT["description"]
    assert RECIPE["about"]["license"] == CITATION["license"] == PROJECT["license"]
    tested = RECIPE["tests"][1]["files"]["source"]
    assert not [path for path in tested if not (ROOT / path).exists()]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflow_runs_what_exists(path):
    jobs = yaml.safe_load(path.read_text())["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    named = [word for command in commands for word in re.findall(r"(?<=\s)(?:tests|\.ci)/[\w/.]+", command)]
    assert named
    assert not [word for word in named if not (ROOT / word).exists()]
