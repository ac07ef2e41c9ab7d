"""The benchmark of exported models, with few points."""

import shutil

import pytest


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("features", ["none", "IFG"])
def test_all_ways_are_timed(features, monkeypatch):
    from speed import casadi_latency

    monkeypatch.setattr(casadi_latency, "ROUNDS", 1)
    monkeypatch.setattr(casadi_latency, "N_TRAJECTORIES", 4)
    row = casadi_latency.run(casadi_latency.Cell(features, 8))
    assert row["m"] == 8
    for name in (*casadi_latency.TIMES.values(), *casadi_latency.ONCE.values()):
        if shutil.which("gcc") or name not in ("write_ms", "compile_s", "c_f_us", "c_j_us", "c_all_us"):
            assert row[name] >= 0.0
    assert max(row["mean_off"], row["std_off"]) < 1e-8
    title, _, times, _, once, _ = casadi_latency.paragraphs([{name: str(value) for name, value in row.items()}])
    assert title == "# A prediction by CasADi and in C"
    assert f"| {features} | 8 |" in times
    assert f"| {features} | 8 |" in once


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_without_a_compiler_the_columns_of_c_are_empty(monkeypatch):
    from speed import casadi_latency

    monkeypatch.setattr(casadi_latency, "ROUNDS", 1)
    monkeypatch.setattr(casadi_latency, "N_TRAJECTORIES", 4)
    model, X, _ = casadi_latency.fitted(casadi_latency.Cell("none", 8))
    monkeypatch.setattr(shutil, "which", lambda name: None)
    found = casadi_latency.of_c(model, X)
    assert set(found.values()) == {""}
    assert casadi_latency.shown(found["c_f_us"]) == ""
