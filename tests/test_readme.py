"""What the README says works as it stands."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("snippet", SNIPPETS, ids=["toy", "pendulum"])
def test_snippets_run(snippet):
    names = {}
    exec(snippet, names)
    assert names["mean"].shape == names["std"].shape
    assert names["model"].score(names.get("X", names["test"].data if "test" in names else None), target(names)) > 0.95


def target(names):
    return names["test"].target if "test" in names else names["y"]


@pytest.mark.parametrize("name", ["main", "test"])
def test_there_is_one_command_line_for_each_job(name):
    commands = re.findall(rf"<!-- command: {name} -->\n```bash\n(.*?)\n```", README, flags=re.DOTALL)
    assert len(commands) == 1
    assert "\n" not in commands[0]
    assert commands[0].startswith("python3 -m venv .venv && .venv/bin/pip install ")


def test_links_and_pictures_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (Path(__file__).parents[1] / target).exists(), target
