import inspect
import re

import pytest

import skevgp
from skevgp import datasets, features, kernels, metrics, plotting

MODULES = (skevgp, datasets, features, kernels, metrics, plotting)
PUBLIC = {name: getattr(module, name) for module in MODULES for name in module.__all__}
CLASSES = [thing for thing in PUBLIC.values() if inspect.isclass(thing)]
FUNCTIONS = [thing for thing in PUBLIC.values() if inspect.isfunction(thing)]
# What scikit-learn injects is documented there.
METHODS = [
    method
    for owner in CLASSES
    for name, method in inspect.getmembers(owner, callable)
    if not name.startswith("_") and method.__module__.startswith("skevgp")
]
CALLABLES = FUNCTIONS + METHODS


def qualified_name(thing):
    return thing.__qualname__


def parameters_of(function):
    return [name for name in inspect.signature(function).parameters if name not in {"self", "cls"}]


def section(docstring, title):
    """The text of a numpydoc section, or None."""
    pattern = rf"^{title}\n-+\n(.*?)(?=^\S[^\n]*\n---+$|\Z)"
    found = re.search(pattern, docstring, re.DOTALL | re.MULTILINE)
    return found and found[1]


def documented(text):
    """Names at the left margin: ``a : type`` or ``a, b : type``."""
    heads = re.findall(r"^\**(\w+(?:, \w+)*)(?= : |$)", text, re.MULTILINE)
    return [name for head in heads for name in head.split(", ")]


def test_there_are_public_classes_functions_and_methods():
    assert {owner.__name__ for owner in CLASSES} >= {"EVGPRegressor", "InertiaForceGravity", "PosteriorDisplay"}
    assert {function.__name__ for function in FUNCTIONS} >= {"make_dynamics", "simulate", "prediction_error"}
    assert {method.__qualname__ for method in METHODS} >= {"EVGPRegressor.fit", "PosteriorDisplay.from_estimator"}


@pytest.mark.parametrize("thing", CLASSES + CALLABLES, ids=qualified_name)
def test_a_docstring_starts_with_a_sentence(thing):
    first = inspect.getdoc(thing).partition("\n\n")[0]
    assert re.match(r"[A-Z].*[.:]", first, re.DOTALL)


@pytest.mark.parametrize("thing", CLASSES + CALLABLES, ids=qualified_name)
def test_all_parameters_are_documented_in_order(thing):
    text = section(inspect.getdoc(thing), "Parameters")
    assert documented(text or "") == parameters_of(thing.__init__ if inspect.isclass(thing) else thing)


@pytest.mark.parametrize("thing", CALLABLES, ids=qualified_name)
def test_what_is_returned_is_documented(thing):
    assert section(inspect.getdoc(thing), "Returns")


@pytest.mark.parametrize("thing", CLASSES + FUNCTIONS, ids=qualified_name)
def test_there_is_an_example(thing):
    assert ">>> " in section(inspect.getdoc(thing), "Examples")


@pytest.mark.parametrize("thing", CLASSES, ids=qualified_name)
def test_attributes_are_documented(thing):
    assert documented(section(inspect.getdoc(thing), "Attributes"))


@pytest.mark.parametrize("thing", CLASSES + FUNCTIONS, ids=qualified_name)
def test_names_are_found_where_they_are_public(thing):
    assert any(getattr(module, thing.__name__, None) is thing for module in MODULES)


def test_a_section_ends_at_the_next_title():
    docstring = "Do.\n\nParameters\n----------\na, b : int\n    Two.\nc\n    One.\n\nReturns\n-------\nd : int\n"
    assert documented(section(docstring, "Parameters")) == ["a", "b", "c"]
    assert documented(section(docstring, "Returns")) == ["d"]
    assert section(docstring, "Examples") is None
