"""Each benchmark runs in its quick mode, and each documented command has valid options."""

import argparse
import re
import runpy
import shlex
import shutil
import sys
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
from matplotlib import rc_context

from skevgp.features import RigidBodyRegressor
from skevgp.robots.loading import robot_file

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
SCRIPTS = [
    path
    for path in sorted(BENCHMARKS.rglob("*.py"))
    if "__main__" in path.read_text() and ("parse(parser)" in path.read_text() or "parse_args()" in path.read_text())
]
PAGES = [
    ROOT / "README.md",
    ROOT / "REPRODUCTION.md",
    *(ROOT / "docs").glob("[a-z]*.md"),
    *(ROOT / "docs" / "guide").glob("*.md"),
    *SCRIPTS,
]


class InThisProcess:
    """A pool without processes, whose start would take longer than the cells."""

    def __init__(self, *arguments, **options):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def submit(self, run, cell):
        future = Future()
        future.set_result(run(cell))
        return future


@pytest.fixture
def run_script(monkeypatch):
    """Run a benchmark as ``__main__``, with its folder on the path."""
    others = [folder for folder in sys.path if not folder.startswith(str(BENCHMARKS))]
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *others])
    for name in [name for name, module in sys.modules.items() if is_benchmark(module)]:
        monkeypatch.delitem(sys.modules, name)
    import harness

    monkeypatch.setattr(harness, "ProcessPoolExecutor", InThisProcess)

    def run(script, options):
        monkeypatch.setattr(sys, "argv", [script, *options])
        with rc_context():  # the pictures' style ends with the script
            runpy.run_path(str(ROOT / script), run_name="__main__")

    yield run
    for name in [name for name, module in sys.modules.items() if is_benchmark(module)]:
        del sys.modules[name]


def is_benchmark(module):
    return (getattr(module, "__file__", None) or "").startswith(str(BENCHMARKS))


def smoke(script, options="", long=True):
    return pytest.param(script, options, id=f"{script} {options}", marks=[pytest.mark.long] if long else [])


SMOKE = [
    smoke("paper/table3", "--systems network"),
    smoke("paper/table4", "--systems pendulum --models RES-DBNN EVGP-IFG --settings skevgp"),
    smoke("paper/figure5", "--systems toy"),
    smoke("paper/figure6", "--systems pendulum --models EVGP-IF EVGP-IFG"),
    smoke("paper/figure7", "--systems pendulum --settings skevgp"),
    smoke("peers/against_gpr", "--systems smooth --models GPR EVGP --sizes 60"),
    smoke("peers/against_peers", "--datasets smooth --peers 'scikit-learn GPR' 'scikit-learn BayesianRidge'"),
    smoke("peers/neighbors"),
    smoke("peers/neighbors", "--curves --models boosting sparse"),
    smoke("speed", "latency"),
    smoke("speed", "casadi"),
    smoke("speed", "evaluation", long=False),
    smoke("speed", "rows"),
    smoke("speed", "million"),
    smoke("speed", "exact"),
    smoke("speed", "checkout"),
    smoke("control", "rollouts --models EVGP-IFG"),
    smoke("control", "swing_up"),
    smoke("control", "tracking"),
    smoke("realaigym"),
    smoke("physics", "errors"),
    smoke("physics", "wrong"),
    smoke("physics", "curves"),
    smoke("machines", "inverse --machines 'ur5, simulated'"),
    smoke("machines", "contact --machines 'ur5, simulated'"),
    smoke("physics", "rollouts"),
    smoke("parameters", "pendulum"),
    smoke("parameters", "misfit"),
    smoke("parameters", "cost"),
    smoke("bounds"),
    smoke("few_rows"),
    smoke("calibration", "--systems pendulum"),
    smoke("tables", "models --sets toy-200"),
    smoke("tables", "inducing --sets toy-200"),
    smoke("robustness"),
    smoke("robots", "identification"),
    smoke("robots", "payload"),
]


@pytest.mark.parametrize(("script", "options"), SMOKE)
def test_quick_run(run_script, tmp_path, script, options):
    output = tmp_path / "result.csv"
    run_script(f"benchmarks/{script}.py", ["--quick", *shlex.split(options), "--output", str(output)])
    before = output.read_text()
    assert before.count("\n") > 1
    assert output.with_suffix(".md").exists()
    run_script(f"benchmarks/{script}.py", ["--quick", *shlex.split(options), "--output", str(output)])
    assert output.read_text() == before  # nothing is measured twice


@pytest.mark.long
def test_quick_run_on_logs(run_script, tmp_path):
    """The real arms' script runs on logs of a simulated arm."""
    home = tmp_path / "data" / "ur10e"
    home.mkdir(parents=True)
    shutil.copy(robot_file("ur10"), home / "ur10e.urdf")
    body = RigidBodyRegressor("ur10", friction=["coulomb"])
    rng = np.random.default_rng(0)
    for name in ("20sec_8harm", "30sec_12harm", "40sec_12harm", "14harm50sec", "14harm50secLoad"):
        t = 0.01 * np.arange(1400)
        phase = np.clip(t - 6.4, 0.0, None)[:, np.newaxis]
        wave, size = rng.uniform(1.0, 2.5, 6), rng.uniform(0.5, 1.0, 6)
        sines, cosines = size * np.sin(wave * phase), size * np.cos(wave * phase)
        X = np.hstack([size - cosines, wave * sines, wave**2 * cosines])
        torque = body.fit(X).transform(X) @ body.coef_prior(6)[0] + 0.05 * rng.normal(size=(len(t), 6))
        rows = np.column_stack([t, X[:, :12], torque / 12.0])
        np.savetxt(home / f"ur-20_02_05-{name}.csv.gz", rows, delimiter=",")
    output = tmp_path / "real_arms.csv"
    run_script("benchmarks/robots.py", ["real", "--data", str(home.parent), "--quick", "--output", str(output)])
    assert "| EVGP |" in output.with_suffix(".md").read_text()
    assert output.with_name("real_arms_parameters.csv").read_text().count(",mass,") == 2


def commands():
    """Find (page, script, options) of each documented command."""
    for page in PAGES:
        for script, options in re.findall(r"python (benchmarks/[\w/]+\.py)([^`\n]*)", page.read_text()):
            yield pytest.param(script, shlex.split(options, comments=True), id=f"{page.name}: {script}{options}")


class AskedError(Exception):
    """A script has made its parser."""

    def __init__(self, parser):
        super().__init__()
        self.parser = parser


# Of each script that has run: a script takes a hundred times longer to load than its options to parse.
PARSERS = {}


@pytest.fixture
def parser_of(request, monkeypatch):
    """The parser of a script, as the script has made it when it asks for its options."""

    def ask(self, *arguments):
        raise AskedError(self)

    def find(script):
        if script not in PARSERS:
            run_script = request.getfixturevalue("run_script")
            with monkeypatch.context() as patch:
                patch.setattr(argparse.ArgumentParser, "parse_args", ask)
                with pytest.raises(AskedError) as asked:
                    run_script(script, [])
            PARSERS[script] = asked.value.parser
        return PARSERS[script]

    return find


@pytest.mark.parametrize(("script", "options"), list(commands()))
def test_command_has_valid_options(parser_of, script, options):
    parser_of(script).parse_args(options)  # exits if one is not valid


@pytest.mark.parametrize("script", [path.relative_to(ROOT).as_posix() for path in SCRIPTS])
def test_script_documents_its_command(script):
    assert f"python {script}" in (ROOT / script).read_text()


def test_each_rule_of_a_fit_can_be_switched_off():
    """The benchmark of the rules edits the code by its text, which must still be there."""
    for rule in runpy.run_path(str(BENCHMARKS / "rules.py"))["RULES_OFF"].values():
        for off in rule.off:
            with off():
                pass
