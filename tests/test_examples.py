"""The examples as a user runs them, in short mode."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from skevgp.metrics import prediction_error
from skevgp.robots import load_robot
from skevgp.robots.loading import urdf_path

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


def test_sparse_gp(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_sparse_gp.py", tmp_path / "picture.png", monkeypatch=monkeypatch)
    assert "EVGPRegressor" in capsys.readouterr().out
    assert names["difference"] < 1.0
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_tabular(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_tabular.py", "--output", tmp_path, monkeypatch=monkeypatch)
    results = names["results"]
    assert len(results) == 5 * 4
    for name in names["sets"]:
        ours, theirs, trees, _ = (results[name, label] for label in names["labels"])
        assert ours[1] < min(theirs[1] + 0.1, trees[1])  # NLPD, of few rows
        assert 0.8 < ours[2] < 0.98
    assert "inducing points, for 1 output" in capsys.readouterr().out
    assert (tmp_path / "tabular.png").stat().st_size > 10_000


def test_online(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_online.py", "--output", tmp_path, monkeypatch=monkeypatch)
    assert "forgetting factor" in capsys.readouterr().out
    after = [np.median(error[names["change"] :]) for error in names["errors"].values()]
    assert after[2] < after[0]  # what forgets follows
    assert (tmp_path / "online.png").stat().st_size > 10_000


@pytest.mark.parametrize("system", ["pendulum", "cartpole"])
def test_learn_dynamics(monkeypatch, capsys, tmp_path, system):
    run(LEARN, "--system", system, "--output", tmp_path, monkeypatch=monkeypatch)
    lines = capsys.readouterr().out.splitlines()
    errors = {
        line.split()[0]: float(line.split()[1]) for line in lines if line.split()[0].endswith(("GP", "IF", "IFG"))
    }
    assert errors.keys() == {"VGP", "RES-VGP", "EVGP-IF", "EVGP-IFG"}
    assert max(errors.values()) < 1.0
    assert errors["EVGP-IFG"] < 0.1
    assert (tmp_path / f"learn_dynamics_{system}.png").stat().st_size > 10_000


def test_link_gravity(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_link_gravity.py", "--output", tmp_path, monkeypatch=monkeypatch)
    assert "shoulder_lift_joint" in capsys.readouterr().out
    for case, label in ((("iiwa14", "q6"), "u_x and u_y"), (("ur5", "shoulder_lift_joint"), "u_x")):
        curves = names["curves"][case]
        np.testing.assert_allclose(curves[label], curves["gravity's torque"], rtol=0, atol=1e-9)
    assert names["weights"][1] == pytest.approx(-names["moment"][1])
    assert (tmp_path / "link_gravity.png").stat().st_size > 10_000


def test_nominal_dynamics(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_nominal_dynamics.py", "--output", tmp_path, monkeypatch=monkeypatch)
    errors = names["results"]
    assert errors["IF + nominal"][-1] < names["untrained_error"] < errors["IFG"][-1]
    np.testing.assert_allclose(names["weights"], names["test"].dt, rtol=0.3)
    assert "the wrong model without data" in capsys.readouterr().out
    assert (tmp_path / "nominal_dynamics.png").stat().st_size > 10_000


def test_any_robot(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_any_robot.py", "--output", tmp_path, monkeypatch=monkeypatch)
    truth = names["moves"].target
    errors = {name: prediction_error(truth, mean) for name, (mean, _) in names["predictions"].items()}
    assert errors["IF + wrong URDF"] < min(errors["IF"], prediction_error(truth, names["constant"]))
    assert "constant velocity" in capsys.readouterr().out
    assert (tmp_path / "any_robot_ur5.png").stat().st_size > 10_000


def test_rollout(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_rollout.py", "--output", tmp_path, monkeypatch=monkeypatch)
    assert names["rollouts"].keys() == {"pendulum", "cartpole", "acrobot"}
    for system, ahead in names["rollouts"].items():
        errors = np.median(np.abs(ahead.mean - names["truths"][system]), axis=(0, 2))
        assert errors[0] < min(0.2, errors[-1])
        assert (np.median(ahead.std, axis=(0, 2))[[0, -1]] > 0.1 * errors[[0, -1]]).all()
    assert "share of the true states within 2 std" in capsys.readouterr().out
    assert (tmp_path / "rollout.png").stat().st_size > 10_000


@pytest.mark.parametrize("system", ["pendulum", "cartpole"])
def test_swing_up(monkeypatch, capsys, tmp_path, system):
    names = run(EXAMPLES / "plot_swing_up.py", "--system", system, "--output", tmp_path, monkeypatch=monkeypatch)
    assert names["runs"]["EVGP-IFG"].success
    for found in names["runs"].values():
        assert found.distance[0] == np.pi
        assert np.abs(found.inputs).max() <= names["task"].limit
    assert "EVGP-IFG" in capsys.readouterr().out
    assert (tmp_path / f"swing_up_{system}.png").stat().st_size > 10_000


@pytest.mark.parametrize("system", ["pendulum", "cartpole"])
def test_crocoddyl(monkeypatch, capsys, tmp_path, system):
    pytest.importorskip("crocoddyl", reason="the extra 'control' is not installed")
    names = run(EXAMPLES / "plot_crocoddyl.py", "--system", system, "--output", tmp_path, monkeypatch=monkeypatch)
    assert names["success"]["with FDDP's gains"]
    assert not names["success"]["inputs as planned"]
    assert names["furthest"].keys() == {"Fx", "Fu", "Lx", "Lu", "Lxx", "Lxu", "Luu"}
    assert 0.0 < max(names["furthest"].values()) < 1e-3  # differences of 1e-5
    # The plan keeps the limit, and is a motion of the model.
    Z, U, limit = names["Z"], names["U"], names["task"].limit
    assert np.abs(U).max() == pytest.approx(limit)
    np.testing.assert_allclose(names["fast"].predict(np.hstack([Z[:-1], U])), Z[1:], rtol=0, atol=1e-6)
    assert "particles are" in capsys.readouterr().out
    assert (tmp_path / f"crocoddyl_{system}.png").stat().st_size > 10_000


def test_without_crocoddyl():
    result = command_line(script=EXAMPLES / "plot_crocoddyl.py", code="sys.modules['crocoddyl'] = None")
    assert result.returncode == 1
    assert "pip install pin crocoddyl matplotlib" in result.stderr
    assert "Traceback" not in result.stderr


def test_real_arm(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_real_arm.py", "--output", tmp_path, monkeypatch=monkeypatch)
    errors = {name: error.mean() for name, error in names["errors"].items()}
    assert errors["InverseDynamics"] < errors["least squares"] < 0.1 * errors["URDF"]
    assert (names["inside"] > 0.7).all()
    assert "coulomb(wrist_3_joint)" in capsys.readouterr().out
    for picture in ("real_arm.png", "real_arm_signals.png"):
        assert (tmp_path / picture).stat().st_size > 10_000


def test_payload(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_payload.py", "--output", tmp_path, monkeypatch=monkeypatch)
    least, largest = names["found"][0.1][-1].mass_interval
    assert least < names["mass"] < largest
    remembers, forgets = (names["followed"][factor][0, -1] for factor in (1.0, 0.8))
    assert abs(forgets - names["mass"]) < abs(remembers - names["mass"])
    assert "online, forgetting factor 0.8" in capsys.readouterr().out
    assert (tmp_path / "payload.png").stat().st_size > 10_000


@pytest.mark.parametrize("script", ["plot_real_arm.py", "plot_payload.py"])
def test_a_folder_with_a_urdf_and_logs_takes_the_place_of_the_simulation(monkeypatch, tmp_path, script):
    write_log = runpy.run_path(str(EXAMPLES / "simulated_arm.py"))["write_log"]
    robot = load_robot("ur10")
    names = ["20sec_8harm", "30sec_12harm", "40sec_12harm", "50sec_12harm"]
    if script == "plot_payload.py":
        names = ["14harm50sec", "14harm50secLoad"]
    folder = tmp_path / "data"
    folder.mkdir()
    for seed, name in enumerate(names):
        write_log(folder / f"arm_{name}.csv.gz", robot, 5.0, seed)
    (folder / "arm.urdf").write_bytes(urdf_path("ur10").read_bytes())
    found = run(EXAMPLES / script, folder, "--output", tmp_path, monkeypatch=monkeypatch)
    assert found["com" if "payload" in script else "truth"] is None


def test_tracking(monkeypatch, capsys, tmp_path):
    names = run(EXAMPLES / "plot_tracking.py", "--output", tmp_path, monkeypatch=monkeypatch)
    assert names["errors"]["with what was learned"] < 0.2 * names["errors"]["nominal model"]
    broken = [np.mean(peak > 1.0) for *_, peak in names["tried"].values()]
    assert broken[1] < broken[0]  # with and without what the std adds
    assert "break a limit" in capsys.readouterr().out
    assert (tmp_path / "tracking.png").stat().st_size > 10_000


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


def test_a_wrong_system_lists_the_right_ones():
    result = command_line("--system", "pendulums")
    assert result.returncode == 2
    assert "invalid choice: 'pendulums'" in result.stderr
    assert "cartpole" in result.stderr


@pytest.mark.parametrize(
    ("package", "pip"), [("pinocchio", "pip install pin"), ("matplotlib", "pip install pin matplotlib")]
)
def test_without_an_optional_package(package, pip):
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
def test_the_stories_of_robots_without_pinocchio(script):
    result = command_line(script=EXAMPLES / script, code="sys.modules['pinocchio'] = None")
    assert result.returncode == 1
    assert "pip install pin" in result.stderr
    assert "Traceback" not in result.stderr
