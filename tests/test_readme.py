"""What the README says works as it stands."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.long
@pytest.mark.parametrize("snippet", SNIPPETS)
def test_snippet_runs(snippet):
    names = {}
    exec(snippet, names)
    assert names["mean"].shape == names["std"].shape
    X, y = (names["test"].data, names["test"].target) if "test" in names else (names["X"], names["y"])
    assert names["model"].score(X, y) > 0.95


@pytest.mark.parametrize("name", ["main", "test"])
def test_there_is_one_command_line_for_each_job(name):
    commands = re.findall(rf"<!-- command: {name} -->\n```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert len(commands) == 1
    assert "\n" not in commands[0]
    assert commands[0].startswith("python3 -m venv .venv && .venv/bin/pip install ")


def test_it_is_short():
    """The site is the manual."""
    assert len(README.splitlines()) <= 150
    assert len(SNIPPETS) == 2


def test_links_lead_to_files():
    links = re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", README)
    assert len(links) > 15
    assert not [link for link in links if not (ROOT / link).exists()]
