"""The benchmark of real arms, on a folder of a simulated one: what is read, trained on, tested and told."""

import gzip
import re

import numpy as np
import pytest

from skevgp.datasets import load_robot
from skevgp.features import RigidBodyRegressor

from .conftest import read

pytest.importorskip("pinocchio")

LOGS = {
    "ur-20_02_05-20sec_8harm": 0.0,
    "ur-20_02_10-30sec_12harm": 0.0,
    "ur-20_02_12-40sec_12harm": 0.0,
    "ur-20_02_19_14harm50sec": 0.0,
    "ur-20_02_19_14harm50secLoad": 3.0,
}
# Before the first row that is kept.
REST = 640
NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@pytest.fixture
def real_arms(benchmarks):
    import real_arms

    real_arms.log_of.cache_clear()
    real_arms.moving.cache_clear()
    return real_arms


def urdf():
    """An arm of six links of 2 kg that turn about the z and y axes by turns."""
    parts = ['<robot name="arm"><link name="l0"/>']
    for number, name in enumerate(NAMES, start=1):
        parts.append(
            f'<link name="l{number}"><inertial><origin xyz="0.1 0.02 0.05"/><mass value="2"/>'
            '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial></link>'
            f'<joint name="{name}" type="revolute"><parent link="l{number - 1}"/><child link="l{number}"/>'
            f'<origin xyz="0.2 0 0.1"/><axis xyz="0 {number % 2 == 0:d} {number % 2:d}"/>'
            '<limit effort="100" lower="-6" upper="6" velocity="3"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def table(features, gains, rng, load):
    """Time, q, q̇, currents, desired currents and torques; the arm rests before its trajectory."""
    t = 0.01 * np.arange(1400) + rng.uniform(0.0, 0.002, 1400)
    phase = np.clip(t - 0.01 * REST, 0.0, None)[:, np.newaxis]
    wave, size = rng.uniform(1.0, 2.5, 6), rng.uniform(0.5, 1.0, 6)
    sines, cosines = size * np.sin(wave * phase), size * np.cos(wave * phase)
    q, v = size - cosines, wave * sines
    X = np.hstack([q, v, wave**2 * cosines])
    weights = features.coef_prior(6)[0].copy()
    weights[50] += load
    weights[60:72] = 2.0
    torque = features.transform(X) @ weights + 0.05 * rng.normal(size=(len(t), 6))
    return np.column_stack([t, q, v, torque / gains, np.zeros((len(t), 12))])


@pytest.fixture
def folder(real_arms, tmp_path):
    """With the logs of an arm that is not the real one, in files like its own."""
    home = tmp_path / "data" / "ur10e"
    home.mkdir(parents=True)
    (home / "ur10e.urdf").write_text(urdf())
    features = RigidBodyRegressor(load_robot(home / "ur10e.urdf")).fit(np.zeros((1, 18)))
    rng = np.random.default_rng(0)
    for name, load in LOGS.items():
        rows = table(features, np.array(real_arms.GAINS), rng, load)
        with gzip.open(home / f"{name}.csv.gz", "wt") as file:
            np.savetxt(file, rows, delimiter=",", fmt="%.9g")
    still = rows[:REST].copy()
    still[:, 7:13] = 0.0
    with gzip.open(home / "ur-20_01_17-p1.csv.gz", "wt") as file:
        np.savetxt(file, still, delimiter=",", fmt="%.9g")
    return home.parent


def test_logs_are_found_and_those_at_rest_passed_over(real_arms, folder):
    there = ["14harm50sec", "14harm50secLoad", "20sec_8harm", "30sec_12harm", "40sec_12harm"]
    assert sorted(real_arms.moving("ur10e", folder)) == there
    assert real_arms.tests_of("ur10e", "three", folder) == ["14harm50sec"]
    assert list(real_arms.splits_of("ur10e", folder, "full")) == list(real_arms.SPLITS["ur10e"])
    assert list(real_arms.splits_of("ur10e", folder, "quick")) == ["three"]
    asked = [(one.trained, one.loaded, one.gain_scale) for one in real_arms.questions_of(folder, "quick")]
    assert asked == [
        ("14harm50sec", "14harm50secLoad", 0.0),
        ("14harm50sec", "14harm50secLoad", 0.1),
        ("20sec_8harm+30sec_12harm+40sec_12harm", "", 0.0),
    ]
    assert len(real_arms.questions_of(folder, "full")) == 4 + 4
    assert real_arms.moving("ur10", folder) == ()


def test_only_rows_of_the_trajectory_are_read(real_arms, folder):
    log = real_arms.log_of("ur10e", "30sec_12harm", folder)
    assert len(log.recordings[0].raw.time) == 1400 - 634
    assert np.abs(log.target).max() > 1.0


@pytest.mark.parametrize(
    ("name", "loaded"), [("load", True), ("unload", False), ("14harm50secLoad", True), ("14harm50sec", False)]
)
def test_loads_are_told_by_names(real_arms, name, loaded):
    assert real_arms.has_load(name) == loaded


@pytest.mark.long
def test_it_runs_resumes_and_writes_its_page_and_picture(run_script, folder, tmp_path):
    output = tmp_path / "arms.csv"
    models = ["CAD", "least squares", "EVGP", "random forest"]
    options = (folder, "--quick", "--jobs", "1", "--output", output, "--models", *models)
    run_script("real_arms.py", *options)
    rows = read(output)
    assert len(rows) == 4 * 6
    ratios = {model: [float(row["ratio"]) for row in rows if row["model"] == model] for model in models}
    np.testing.assert_allclose(ratios["least squares"], 1.0)
    assert np.median(ratios["random forest"]) > 3.0
    assert {row["cr2"] == "" for row in rows if row["model"] == "CAD"} == {True}
    found = read(tmp_path / "arms_parameters.csv")
    masses = [row for row in found if row["name"] == "mass"]
    assert len(masses) == 2
    assert all(abs(float(row["value"]) - 3.0) < 0.5 for row in masses)
    page = output.with_suffix(".md").read_text()
    assert "### Trained on three" in page
    assert "2.805 | no |" in page or "2.805 | yes |" in page
    assert re.search(r"!\[[^]]*\]\(arms.png\)", page)
    assert output.with_suffix(".png").stat().st_size > 1000
    said = run_script("real_arms.py", *options)
    assert "4 of 4 cells are in" in said
    assert "3 of 3 cells are in" in said


def test_without_logs_it_says_so(run_script, tmp_path):
    with pytest.raises(SystemExit, match="has no logs of ur10e or ur10"):
        run_script("real_arms.py", tmp_path, "--quick", "--output", tmp_path / "arms.csv")


def line(model, joint, test, nmse, ratio, cr2="0.95", n_test="100"):
    names = ("model", "joint", "test", "nmse", "ratio", "cr1", "cr2", "cr3", "nlpd", "n_test", "fit_seconds")
    return dict(zip(names, (model, joint, test, nmse, ratio, cr2, cr2, cr2, cr2, n_test, "1.5"), strict=True))


def test_the_summary_is_of_all_joints_and_files(real_arms):
    rows = [
        line("least squares", "1", "a", "0.1", "1"),
        line("least squares", "2", "a", "0.1", "1"),
        line("EVGP", "1", "a", "0.025", "0.25", "0.9", "100"),
        line("EVGP", "2", "a", "0.4", "4", "0.6", "300"),
    ]
    lines = list(real_arms.summary_lines(rows))
    assert [text[:5] for text in lines] == [
        ["least squares", "1.00", "1.00", "1.00", "1 of 2"],
        ["EVGP", "1.00", "0.250", "4.00", "1 of 2"],
    ]
    assert lines[1][7] == "0.675"
    assert list(real_arms.error_lines(rows))[1] == ["a", "EVGP", "**0.0250**", "0.400"]
    assert list(real_arms.lost_lines(rows)) == [["a", "2", "least squares", "0.100", "0.400", "4.00"]]


def test_a_model_without_bands_has_none_in_the_tables(real_arms):
    rows = [line("CAD", "1", "a", "1", "9", ""), line("EVGP", "1", "a", "1", "1")]
    assert [text[0] for text in real_arms.band_lines(rows)] == ["EVGP"]
    assert next(real_arms.summary_lines(rows))[4:8] == ["", "", "", ""]
