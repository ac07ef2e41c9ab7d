"""What is written down to be run can be run: scripts find what they share, and options exist."""

import argparse
import re
import runpy
import shlex
import sys

import pytest

from .conftest import BENCHMARKS

ROOT = BENCHMARKS.parent
SCRIPTS = [path for path in sorted(BENCHMARKS.rglob("*.py")) if "__main__" in path.read_text()]
# They have no options, and run in the tests of the scripts that start them.
WORKERS = [BENCHMARKS / name for name in ("peers/models.py", "speed/checkout_job.py", "speed/latency_job.py")]
PAGES = [ROOT / "README.md", ROOT / "REPRODUCTION.md", *BENCHMARKS.rglob("*.txt"), *SCRIPTS]


def commands():
    """(page, script, options) of each; "then with" options follow those of the command before."""
    for page in PAGES:
        for line in page.read_text().splitlines():
            for script, options, rest in re.findall(r"python (benchmarks/[\w/]+\.py)([^`\n]*)(.*)", line):
                given = shlex.split(options, comments=True)
                yield page.name, script, given
                for more in re.findall(r"then with `([^`]*)`", rest):
                    yield page.name, script, given + shlex.split(more)


class ParsedError(Exception):
    """The options are those of the script."""


@pytest.fixture
def parse(monkeypatch, tmp_path):
    """Run a script, as from a shell, until it has parsed its options; beside the folder is another checkout."""
    parse_args = argparse.ArgumentParser.parse_args
    for name in ("here", "older/skevgp"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "older/skevgp/__init__.py").touch()
    monkeypatch.chdir(tmp_path / "here")

    def parsed(self, *arguments):
        parse_args(self, *arguments)
        raise ParsedError

    def parse(script, options):
        monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
        monkeypatch.setattr(sys, "argv", [script, *options])
        others = [folder for folder in sys.path if folder != str(BENCHMARKS)]
        monkeypatch.setattr(sys, "path", [str((ROOT / script).parent), *others])
        for name in [name for name, module in sys.modules.items() if is_beside(module)]:
            monkeypatch.delitem(sys.modules, name)
        runpy.run_path(str(ROOT / script), run_name="__main__")

    return parse


def is_beside(module):
    return (getattr(module, "__file__", None) or "").startswith(str(BENCHMARKS))


@pytest.mark.parametrize(("page", "script", "options"), [own for own in commands() if ROOT / own[1] not in WORKERS])
def test_a_command_that_is_written_down_can_be_run(parse, page, script, options):
    with pytest.raises(ParsedError):
        parse(script, options)


def test_each_script_says_how_it_is_run():
    run_from = {(page, script) for page, script, _ in commands()}
    assert len(SCRIPTS) > 10
    for path in SCRIPTS:
        assert (path.name, path.relative_to(ROOT).as_posix()) in run_from, path
