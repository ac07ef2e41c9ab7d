"""What can be said of the built pages without a browser: links, headings, pictures."""

import re
from functools import cache
from html.parser import HTMLParser
from itertools import pairwise
from urllib.parse import unquote, urlsplit

import pytest
from sklearn.base import BaseEstimator

import skevgp
from skevgp.utils.doc_links import page_of

from .conftest import SITE

PAGES = sorted(path.relative_to(SITE).as_posix() for path in SITE.rglob("*.html") if "_static" not in path.parts)
# Not of ours: sources as viewcode shows them, and Sphinx's own lists.
WRITTEN = [page for page in PAGES if not page.startswith("_modules") and page not in ("genindex.html", "search.html")]
VOID = {"img", "br", "hr", "input", "link", "meta", "source", "wbr", "area", "col", "embed", "track", "base"}


class Page(HTMLParser):
    """Links, anchors, headings and pictures of a page; the latter two of its article only."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors, self.headings, self.pictures = [], set(), [], []
        self._inside = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if "id" in given:
            self.anchors.add(given["id"])
        self.links += [given[name] for name in ("href", "src") if given.get(name)]
        if any(outer == "article" for outer, _ in self._inside):
            if tag in ("h1", "h2", "h3", "h4", "h5", "h6"):
                self.headings.append(int(tag[1]))
            classes = " ".join(classes for _, classes in self._inside)
            # A thumbnail stands in a link beside the title of its story, which would be read twice.
            if tag == "img" and "sphx-glr-thumb" not in classes:
                self.pictures.append((given.get("src"), given.get("alt")))
        if tag not in VOID:
            self._inside.append((tag, given.get("class") or ""))

    def handle_endtag(self, tag):
        while tag not in VOID and self._inside and self._inside.pop()[0] != tag:
            pass


@cache
def parsed(page):
    return Page((SITE / page).read_text(encoding="utf-8"))


def broken(page):
    for link in parsed(page).links:
        parts = urlsplit(link)
        if parts.scheme or parts.netloc or link.startswith("data:"):
            continue
        target = (SITE / page).parent / unquote(parts.path) if parts.path else SITE / page
        if not target.exists():
            yield link
        elif parts.fragment and target.suffix == ".html" and not page.startswith("_modules"):  # viewcode guesses them
            inside = parsed(target.resolve().relative_to(SITE.resolve()).as_posix())
            if unquote(parts.fragment) not in inside.anchors:
                yield link


def test_the_site_has_its_pages(site):
    assert {
        "index.html",
        "start.html",
        "guide/model.html",
        "howto/save_and_load.html",
        "auto_examples/plot_rollout.html",
    } <= {*PAGES}
    assert {"generated/api/skevgp.EVGPRegressor.html", "generated/results/against_peers.html"} <= {*PAGES}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(site, page):
    assert not list(broken(page))


@pytest.mark.parametrize("page", WRITTEN)
def test_nothing_is_loaded_from_elsewhere(site, page):
    """So that the site can be read without a network."""
    text = (SITE / page).read_text(encoding="utf-8")
    loaded = [part.partition('"')[0] for part in text.split('src="')[1:]]
    assert not [link for link in loaded if link.startswith(("http", "//"))]


@pytest.mark.parametrize("page", WRITTEN)
def test_headings_follow_each_other(site, page):
    levels = parsed(page).headings
    assert levels[:1] == [1]
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))


@pytest.mark.parametrize("page", WRITTEN)
def test_pictures_say_what_they_show(site, page):
    pictures = parsed(page).pictures
    assert all(alt and len(alt) > 5 and not alt.endswith((".png", ".svg")) for _, alt in pictures), pictures


@pytest.mark.parametrize("page", WRITTEN)
def test_no_link_is_left_as_it_is_written(site, page):
    text = (SITE / page).read_text(encoding="utf-8")
    assert not [role for role in ("{doc}", "{src}", "{download}") if role in text]


@pytest.mark.parametrize("page", sorted((SITE / "auto_examples").glob("plot_*.html")), ids=lambda page: page.stem)
def test_a_story_shows_its_own_pictures(site, page):
    """No others' are left open when its code runs; one that it saves itself comes beside the one that it shows."""
    shown = {source for source, _ in parsed(page.relative_to(SITE).as_posix()).pictures if "sphx_glr" in source}
    assert 1 <= len(shown) <= 2


@pytest.mark.parametrize("page", sorted((SITE / "generated" / "results").glob("*.html")), ids=lambda page: page.stem)
def test_results_begin_with_a_sentence_and_their_picture(site, page):
    article = page.read_text(encoding="utf-8").partition("</h1>")[2].partition("</article>")[0]
    first = re.findall(r"<(p|img|table|h2)\b", article)
    assert first[0] == "p"
    if "img" in first:
        assert "table" not in first[: first.index("img")]


def test_displays_of_estimators_link_to_pages_that_are_there(site):
    kinds = [getattr(module, name) for module in (skevgp, skevgp.features) for name in module.__all__]
    pages = [page_of(kind) for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseEstimator)]
    assert len(pages) > 12
    assert not [page for page in pages if not (site / page).is_file()]


def test_titles_differ(site):
    texts = [(SITE / page).read_text(encoding="utf-8") for page in WRITTEN]
    titles = [text.partition("<title>")[2].partition("</title>")[0] for text in texts]
    assert len(titles) == len({*titles})


def test_a_broken_link_a_missing_heading_and_a_mute_picture_would_be_seen():
    page = Page('<article><h1 id="a">A</h1><br /><h3>B</h3><a href="#b">c</a><img src="d.png"></article><img>')
    assert page.links == ["#b", "d.png"]
    assert page.anchors == {"a"}
    assert page.headings == [1, 3]
    assert page.pictures == [("d.png", None)]
