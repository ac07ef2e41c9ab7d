"""Every public docstring follows numpydoc."""

import inspect

import numpydoc.validate
import pytest
from numpydoc.docscrape import NumpyDocString

import skevgp
from skevgp import kernels

MODULES = [skevgp, kernels, *filter(inspect.ismodule, (getattr(skevgp, name) for name in skevgp.__all__))]
PUBLIC = {name: getattr(module, name) for module in MODULES for name in module.__all__}
CLASSES = [thing for thing in PUBLIC.values() if inspect.isclass(thing)]
FUNCTIONS = [thing for thing in PUBLIC.values() if inspect.isfunction(thing)]
# What scikit-learn injects is documented there; what several classes inherit is listed once.
METHODS = list(
    {
        method.__qualname__: method
        for owner in CLASSES
        for name, method in inspect.getmembers(owner, callable)
        if not name.startswith("_") and (getattr(method, "__module__", None) or "").startswith("skevgp")
    }.values()
)
IGNORED = {
    "ES01",  # a summary may say it all
    "SA01",  # not everything has a relative
    "RT02",  # what is returned has a name, as in scikit-learn
    "PR08",  # a formula, such as h(x), may begin a description
    "RT04",  # as PR08
}


@pytest.fixture(autouse=True)
def _no_sources(monkeypatch):
    """Numpydoc reads the source for comments that would excuse errors, and for line numbers: most of its time."""
    monkeypatch.setattr(numpydoc.validate, "extract_ignore_validation_comments", lambda *_: {}, raising=False)
    monkeypatch.setattr(numpydoc.validate.Validator, "source_file_def_line", 1, raising=False)


def qualified_name(thing):
    return thing.__qualname__


@pytest.mark.parametrize("thing", CLASSES + FUNCTIONS, ids=qualified_name)
def test_public_docstring_is_numpydocs(thing):
    assert not [error for error in errors_of(thing) if error[0] not in IGNORED]


@pytest.mark.parametrize("thing", METHODS, ids=qualified_name)
def test_methods_docstring_is_numpydocs(thing):
    """Its example may be that of its class."""
    assert not [error for error in errors_of(thing) if error[0] not in IGNORED | {"EX01"}]


def errors_of(thing):
    return numpydoc.validate.validate(f"{thing.__module__}.{thing.__qualname__}")["errors"]


@pytest.mark.parametrize("method", list(filter(inspect.ismethod, METHODS)), ids=qualified_name)
def test_class_method_returns_are_documented(method):
    """Which numpydoc leaves out."""
    returned = NumpyDocString(inspect.getdoc(method))["Returns"]
    assert returned
    assert all(value.desc for value in returned)


@pytest.mark.parametrize(
    "thing", [own for own in CLASSES if hasattr(own, "fit") or "Display" in own.__name__], ids=qualified_name
)
def test_attributes_are_documented(thing):
    assert NumpyDocString(inspect.getdoc(thing))["Attributes"]
