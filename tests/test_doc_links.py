"""The HTML display of an estimator links to its page, if the package says where its documentation is."""

import email

import pytest
from sklearn.base import BaseEstimator
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import skevgp
from skevgp import EVGPRegressor, InverseDynamics, features
from skevgp.utils import doc_links

ESTIMATORS = [
    (f"{module.__name__}.{name}", kind)
    for module in (skevgp, features)
    for name in module.__all__
    if isinstance(kind := getattr(module, name), type) and issubclass(kind, BaseEstimator)
]
SITE = "https://docs.example/stable"


@pytest.fixture
def package(monkeypatch):
    """Let the package name an address."""

    def named(headers):
        doc_links.site_address.cache_clear()
        monkeypatch.setattr(doc_links, "metadata", lambda _: email.message_from_string(headers))

    yield named
    doc_links.site_address.cache_clear()


@pytest.fixture
def site(package):
    package(f"Project-URL: Source, https://code.example\nProject-URL: Documentation, {SITE}/\n")


def test_there_are_estimators():
    assert len(ESTIMATORS) > 12


@pytest.mark.parametrize(("name", "kind"), ESTIMATORS, ids=[name for name, _ in ESTIMATORS])
def test_estimator_links_to_its_page(site, name, kind):
    assert doc_links.page_of(kind) == f"generated/api/{name}.html"
    bare = kind.__new__(kind)  # some need arguments
    assert bare._get_doc_link() == f"{SITE}/generated/api/{name}.html"


def test_display_has_the_link(site):
    html = make_pipeline(StandardScaler(), EVGPRegressor())._repr_html_()
    assert f'href="{SITE}/generated/api/skevgp.EVGPRegressor.html"' in html
    assert "scikit-learn.org" in html  # of the scaler


def test_without_an_address_there_is_no_link(package):
    package("Name: skevgp\n")
    assert EVGPRegressor()._get_doc_link() == ""
    assert "generated/api" not in EVGPRegressor()._repr_html_()


def test_package_that_is_not_installed_has_no_address(package, monkeypatch):
    def missing(_):
        raise doc_links.PackageNotFoundError

    package("")
    monkeypatch.setattr(doc_links, "metadata", missing)
    assert InverseDynamics()._get_doc_link() == ""


def test_other_classes_have_no_page(site):
    class Own(EVGPRegressor):
        pass

    assert Own()._get_doc_link() == ""
    Own.__module__ = "skevgp.estimators.evgp"
    assert Own()._get_doc_link() == ""
