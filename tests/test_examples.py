"""The examples as a user runs them, in short mode."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from skevgp.robots import load_robot
from skevgp.robots.loading import robot_file

EXAMPLES = Path(__file__).parents[1] / "examples"
LEARN = EXAMPLES / "plot_learn_dynamics.py"
pytestmark = pytest.mark.long


@pytest.fixture(autouse=True)
def short_mode(monkeypatch):
    monkeypatch.setenv("SKEVGP_EXAMPLES_QUICK", "1")
    monkeypatch.setattr(plt, "show", lambda: None)
    yield
    plt.close("all")


def run(script, *arguments, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
    return runpy.run_path(str(script), run_name="__main__")


EXAMPLE_RUNS = [
    ("sparse_gp", ["picture.png"], "EVGPRegressor"),
    ("tabular", [], "inducing points, for 1 output"),
    ("many_rows", [], "nearest rows"),
    ("online", [], "forgetting factor"),
    ("learn_dynamics", ["--system", "pendulum"], "EVGP-IFG"),
    ("link_gravity", [], "shoulder_lift_joint"),
    ("nominal_dynamics", [], "the wrong model without data"),
    ("any_robot", [], "constant velocity"),
    ("rollout", [], "share of the true states within 2 std"),
    ("swing_up", ["--system", "cartpole"], "EVGP-IFG"),
    ("acrobot", ["--robot", "pendubot"], "predicted std"),
    ("crocoddyl", ["--system", "pendulum"], "particles are"),
    ("real_arm", [], "coulomb(wrist_3_joint)"),
    ("payload", [], "online, forgetting factor 0.8"),
    ("tracking", [], "break a limit"),
]


@pytest.mark.parametrize(("name", "arguments", "printed"), EXAMPLE_RUNS, ids=[name for name, *_ in EXAMPLE_RUNS])
def test_example_prints_and_draws(monkeypatch, capsys, tmp_path, name, arguments, printed):
    if name == "crocoddyl":
        pytest.importorskip("crocoddyl", reason="not on Windows")
    monkeypatch.chdir(tmp_path)
    output = [] if name == "sparse_gp" else ["--output", tmp_path]
    run(EXAMPLES / f"plot_{name}.py", *arguments, *output, monkeypatch=monkeypatch)
    assert printed in capsys.readouterr().out
    pictures = [*tmp_path.glob("*.png")]
    assert pictures
    assert all(picture.stat().st_size > 10_000 for picture in pictures)


@pytest.mark.parametrize("script", ["plot_real_arm.py", "plot_payload.py"])
def test_example_takes_folder_of_logs(monkeypatch, tmp_path, script):
    write_log = runpy.run_path(str(EXAMPLES / "simulated_arm.py"))["write_log"]
    robot = load_robot("ur10")
    names = ["20sec_8harm", "30sec_12harm", "40sec_12harm", "50sec_12harm"]
    if script == "plot_payload.py":
        names = ["14harm50sec", "14harm50secLoad"]
    folder = tmp_path / "data"
    folder.mkdir()
    for seed, name in enumerate(names):
        write_log(folder / f"arm_{name}.csv.gz", robot, 5.0, seed)
    (folder / "arm.urdf").write_bytes(robot_file("ur10").read_bytes())
    found = run(EXAMPLES / script, folder, "--output", tmp_path, monkeypatch=monkeypatch)
    assert found["com" if "payload" in script else "truth"] is None


def command_line(*arguments, script=LEARN, code=""):
    program = [
        "-c",
        f"import runpy, sys; {code or 'pass'}; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0])",
        str(script),
    ]
    environment = os.environ | {"MPLBACKEND": "Agg"}
    return subprocess.run(
        [sys.executable, *program, *arguments], capture_output=True, text=True, env=environment, check=False
    )


def test_help():
    result = command_line("--help")
    assert result.returncode == 0
    assert "--system {acrobot,cartpole,pendulum}" in result.stdout


def test_invalid_system_lists_systems():
    result = command_line("--system", "pendulums")
    assert result.returncode == 2
    assert "invalid choice: 'pendulums'" in result.stderr
    assert "cartpole" in result.stderr


@pytest.mark.parametrize(
    ("package", "pip"), [("pinocchio", "pip install pin"), ("matplotlib", "pip install pin matplotlib")]
)
def test_missing_package_names_pip_command(package, pip):
    result = command_line(code=f"sys.modules[{package!r}] = None")
    assert result.returncode == 1
    assert pip in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    "script",
    [
        "plot_link_gravity.py",
        "plot_nominal_dynamics.py",
        "plot_any_robot.py",
        "plot_rollout.py",
        "plot_swing_up.py",
        "plot_crocoddyl.py",
        "plot_tracking.py",
        "plot_online.py",
        "plot_real_arm.py",
        "plot_payload.py",
    ],
)
def test_example_without_pinocchio_names_pip_command(script):
    result = command_line(script=EXAMPLES / script, code="sys.modules['pinocchio'] = None")
    assert result.returncode == 1
    assert "pip install pin" in result.stderr
    assert "Traceback" not in result.stderr
