"""The pages as they are seen: one of each type, at the width of a desk and of a phone."""

from pathlib import Path

import pytest

selenium = pytest.importorskip("selenium", reason="the extra 'docs-test' is not installed")

from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

# Page, its title, whether it has formulas, and whether it has pictures.
TYPES = {
    "index.html": ("skevgp", True, True),
    "start.html": ("Start in five minutes", False, True),
    "guide/index.html": ("User guide", True, False),
    "guide/model.html": ("The model and its bound", True, False),
    "howto/logs.html": ("Read a log", False, True),
    "real_arms.html": ("Real arms", False, False),
    "which_model.html": ("Which model", False, False),
    "comparison.html": ("How skevgp compares", False, False),
    "questions.html": ("Questions", False, False),
    "auto_examples/index.html": ("Gallery", False, True),
    "auto_examples/plot_sparse_gp.html": ("A sparse Gaussian process in scikit-learn", False, True),
    "generated/api.html": ("API reference", True, False),
    "generated/api/skevgp.EVGPRegressor.html": ("EVGPRegressor", True, True),
    "benchmarks.html": ("Benchmarks", False, False),
    "generated/results/results_table.html": ("The results: Table 4 of the paper, and ours", False, True),
    "generated/source/skevgp-metrics.py.html": ("skevgp/metrics.py", False, False),
    "reproduction.html": ("The paper, reproduced", False, True),
    "tests.html": ("How it is tested", True, False),
    "changelog.html": ("Changelog", False, False),
}
each_page = pytest.mark.parametrize("page", TYPES)
SEEN = """return [...document.querySelectorAll('article img')].filter(i => i.getClientRects().length)
    .map(i => { i.loading = 'eager'; return [i.src, i.complete && i.naturalWidth > 0] })"""


def opened(browser, address, page, theme="light"):
    # The theme is chosen before the page's own scripts run. After a first page, the next one may not see it at once.
    choice = {"source": f"localStorage.setItem('mode', '{theme}'); localStorage.setItem('theme', '{theme}')"}
    script = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", choice)
    browser.get_log("browser")
    browser.get(f"{address}/{page}")
    browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)
    return WebDriverWait(browser, 30)


def complaints(browser):
    """Warnings and errors of the console; the theme also tells there what it does."""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] in ("WARNING", "SEVERE")]


def cut_off(browser):
    """What reaches beyond the page to the right, and cannot be scrolled."""
    return browser.execute_script(
        """const limit = document.documentElement.clientWidth + 1, scrolls = e => {
             for (; e && e.tagName != 'ARTICLE'; e = e.parentElement)
               if (/auto|scroll/.test(getComputedStyle(e).overflowX)) return true;
             return false };
           return [...document.querySelectorAll('article :is(p, h1, h2, li, dt, img, code, a)')]
             .filter(e => e.getClientRects().length && e.getBoundingClientRect().right > limit && !scrolls(e))
             .map(e => e.tagName + ' ' + e.textContent.slice(0, 60))"""
    )


def check_formulas(browser, wait):
    wait.until(lambda d: d.find_elements(By.CSS_SELECTOR, "article mjx-container mjx-math"))
    first = browser.find_element(By.CSS_SELECTOR, "article mjx-container")
    assert min(first.size["width"], first.size["height"]) > 5
    loaded = "return [...document.fonts].some(font => /MJX/.test(font.family) && font.status == 'loaded')"
    wait.until(lambda d: d.execute_script(loaded))
    assert not browser.find_elements(By.CSS_SELECTOR, "mjx-merror")
    assert "\\(" not in browser.find_element(By.TAG_NAME, "article").text


@pytest.mark.parametrize("theme", ["light", "dark"])
@each_page
def test_a_page_is_seen_as_it_should_be(browser, address, page, theme):
    title, formulas, pictures = TYPES[page]
    wait = opened(browser, address, page, theme)
    wait.until(lambda d: d.execute_script("return document.readyState") == "complete")
    heading = browser.find_element(By.CSS_SELECTOR, "article h1")
    assert heading.is_displayed()
    assert heading.text.strip("#¶ \n") == title
    assert "skevgp" in browser.title
    assert bool(browser.execute_script("return document.querySelectorAll('article .math').length")) == formulas
    if formulas:
        check_formulas(browser, wait)
    shown = browser.execute_script(SEEN)
    assert bool(shown) == pictures
    wait.until(lambda d: all(loaded for _, loaded in d.execute_script(SEEN)), str(shown))
    assert browser.execute_script("return document.documentElement.dataset.theme") == theme
    needed, given = browser.execute_script(
        "const page = document.documentElement; return [page.scrollWidth, page.clientWidth]"
    )
    assert needed <= given
    assert not cut_off(browser)
    assert not complaints(browser)


def test_text_and_its_ground_differ_in_the_dark(browser, address):
    opened(browser, address, "guide/model.html", "dark")
    colour = "const s = getComputedStyle(document.querySelector(arguments[0])); return [s.color, s.backgroundColor]"
    text, _ = browser.execute_script(colour, "article p")
    _, ground = browser.execute_script(colour, "body")
    light = [sum(map(float, each.split("(")[1].rstrip(")").split(",")[:3])) for each in (text, ground)]
    assert light[0] - light[1] > 300.0


WITH_CODE = ["index.html", "start.html", "questions.html", "generated/api/skevgp.EVGPRegressor.html"]
WITH_CODE += [f"auto_examples/plot_{story}.html" for story in ("sparse_gp", "rollout", "real_arm", "tracking")]
WITH_CODE += [
    f"{folder}/{page.stem}.html"
    for folder in ("guide", "howto")
    for page in sorted((Path(__file__).parents[1] / folder).glob("*.md"))
]


@pytest.mark.parametrize("page", WITH_CODE)
def test_no_code_has_to_be_scrolled_at_a_desk(browser, address, page):
    if browser.size == "phone":
        return  # there it may
    opened(browser, address, page)
    wide = browser.execute_script(
        """return [...document.querySelectorAll('article pre')]
             .filter(e => e.getClientRects().length && e.scrollWidth > e.clientWidth + 1)
             .map(e => e.textContent.split('\\n').sort((a, b) => b.length - a.length)[0])"""
    )
    assert wide == []


def test_names_of_parameters_stand_on_one_line(browser, address):
    opened(browser, address, "generated/api/skevgp.EGPRegressor.html")
    names = browser.execute_script(
        """return [...document.querySelectorAll('dl.field-list dt > strong')].filter(e => !e.textContent.includes(' '))
             .map(e => [e.textContent, e.offsetHeight / parseFloat(getComputedStyle(e).fontSize)])"""
    )
    assert len(names) > 20
    assert not [name for name, lines in names if lines > 2.2]


def test_both_tabs_of_the_start_open(browser, address):
    opened(browser, address, "start.html")
    robot = browser.find_element(By.XPATH, "//label[contains(., 'A robot')]")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", robot)
    robot.click()
    shown = [code.text for code in browser.find_elements(By.CSS_SELECTOR, ".sd-tab-content pre") if code.is_displayed()]
    assert any("InertiaForceGravity" in code for code in shown)
    assert not any("PolynomialFeatures" in code for code in shown)


def test_search_finds_the_regressor(browser, address):
    wait = opened(browser, address, "search.html?q=EVGPRegressor")
    found = "#search-results li a"
    wait.until(lambda d: any(link.text == "skevgp.EVGPRegressor" for link in d.find_elements(By.CSS_SELECTOR, found)))
    link = next(link for link in browser.find_elements(By.CSS_SELECTOR, found) if link.text == "skevgp.EVGPRegressor")
    assert "generated/api/skevgp.EVGPRegressor.html" in link.get_attribute("href")
    assert not complaints(browser)


GUIDE = sorted(page.name for page in (Path(__file__).parents[1] / "guide").glob("*.md") if "$$" in page.read_text())


@pytest.mark.parametrize("page", GUIDE)
def test_no_formula_has_to_be_scrolled_at_a_desk(browser, address, page):
    if browser.size == "phone":
        return  # there they may
    wait = opened(browser, address, f"guide/{page.replace('.md', '.html')}")
    check_formulas(browser, wait)
    wide = browser.execute_script(
        """return [...document.querySelectorAll('article :is(div.math, mjx-container[display])')]
             .filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.closest('div.math')?.id ?? e.tagName)"""
    )
    assert wide == []
