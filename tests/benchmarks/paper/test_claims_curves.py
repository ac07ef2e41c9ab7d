"""Verdicts on what the paper claims of its learning curves."""


def holds(finder, rows):
    (finding,) = finder(rows)
    return finding.holds


def curves_of(sizes=(100, 200, 400), **errors):
    """Of models the Errors of three runs with some numbers of rows."""
    return [
        {
            **{"system": "pendulum", "model": model.replace("_", "-"), "setting": "skevgp", "seed": str(seed)},
            **{"n_rows": str(n_rows), "error_mean": str(error * factor), "converged": "True", "size": "full"},
            "error_inside": str(error * factor / 10),
        }
        for model, own in errors.items()
        for n_rows, error in zip(sizes, own, strict=True)
        for seed, factor in enumerate((1.0, 1.1, 1.2))
    ]


AS_TOLD = {
    **{"VGP": (9.0, 8.8, 8.7), "RES_VGP": (8.0, 7.8, 7.7), "RES_DBNN": (6.0, 3.0, 1.0)},
    **{"EVGP_IF": (0.4, 0.3, 0.2), "EVGP_IFG": (0.1, 0.09, 0.08)},
}


def test_claims_of_learning_curves():
    from paper import claims_curves as claims

    def found(**errors):
        rows = curves_of(**errors)
        return [
            *(holds(finder, rows) for finder in (claims.small_sets, claims.plateaus)),
            *(holds(lambda rows, other=other: claims.gaps(rows, other), rows) for other in ("RES-DBNN", "EVGP-IF")),
        ]

    assert found(**AS_TOLD) == [True, True, True, True]
    otherwise = AS_TOLD | {"VGP": (9.0, 4.0, 2.0), "RES_VGP": (0.01, 0.01, 0.01), "RES_DBNN": (6.0, 7.0, 8.0)}
    assert found(**otherwise) == [False, False, False, True]
    # A gap that is reversed is gone; where there was none, or one run says otherwise, nothing is decided.
    assert found(**AS_TOLD | {"EVGP_IF": (0.4, 0.3, 0.05)})[3] is True
    assert found(**AS_TOLD | {"EVGP_IF": (0.05, 0.3, 0.2)})[3] is None
    fewer = [row for row in curves_of(**AS_TOLD) if row["seed"] != "2"]
    finders = (claims.small_sets, claims.plateaus, claims.network_is_poor, claims.fewer_samples, claims.more_rows_help)
    finders += (claims.accurate_pendulum, claims.gap_to_physics)
    assert [holds(finder, fewer) for finder in finders] == [None] * 7
    assert [list(finder([])) for finder in finders] == [[]] * 7
    limited = curves_of(**AS_TOLD)
    for row in limited:
        row["converged"] = str(row["model"] != "VGP")
    for finder in (claims.small_sets, claims.network_is_poor):
        (finding,) = finder(limited)
        assert finding.where == "pendulum (100 rows)"
        assert finding.said == "EVGP-IFG 0.110, EVGP-IF 0.440, RES-DBNN 6.60, RES-VGP 8.80, VGP 9.90\\* (3)"
    (finding,) = claims.plateaus(limited)
    assert finding.said == "VGP × 0.98\\*, RES-VGP × 0.98"


def test_a_gap_is_told_as_difference_and_ratio():
    from paper import claims_curves as claims

    def gap(**errors):
        (finding,) = claims.gaps(curves_of(**{**AS_TOLD, **errors}), "EVGP-IF")
        return finding.holds, finding.said.removesuffix(" (3)")

    # Both Errors are halved: so is their difference, but not their ratio.
    halved = gap(EVGP_IF=(0.4, 0.3, 0.2), EVGP_IFG=(0.2, 0.15, 0.1))
    said = "difference 0.220 → 0.110, less in 3 of 3; ratio × 2.00 → × 2.00, less in 0 of 3: no"
    assert halved == (True, said)
    said = "difference 0.220 → 0.275, less in 0 of 3; ratio × 2.00 → × 6.00, less in 0 of 3: no"
    assert gap(EVGP_IF=(0.4, 0.3, 0.3), EVGP_IFG=(0.2, 0.15, 0.05)) == (False, said)
    said = "difference 0.220 → 0.110, less in 3 of 3; ratio × 2.00 → × 1.50, less in 3 of 3: yes"
    assert gap(EVGP_IF=(0.4, 0.3, 0.3), EVGP_IFG=(0.2, 0.2, 0.2)) == (True, said)
    said = "difference -0.110 → 0.110; ratio × 0.667 → × 2.00; no gap to begin with"
    assert gap(EVGP_IF=(0.2, 0.3, 0.2), EVGP_IFG=(0.3, 0.2, 0.1)) == (None, said)
    # One run, whose gap grows, leaves it undecided though the mean's does not.
    rows = curves_of(**AS_TOLD)
    for row in rows:
        if (row["model"], row["seed"], row["n_rows"]) == ("EVGP-IF", "0", "400"):
            row["error_mean"] = "0.39"
    (finding,) = claims.gaps(rows, "EVGP-IF")
    assert finding.holds is None
    assert finding.said == (
        "difference 0.330 → 0.195, less in 2 of 3; ratio × 4.00 → × 3.22, less in 2 of 3: undecided (3)"
    )
    rows[-1]["converged"] = "False"  # IFG's with the most rows
    (finding,) = claims.gaps(rows, "EVGP-IF")
    assert "0.330 → 0.195\\*," in finding.said


def test_the_gap_to_physics_is_between_the_best_of_each():
    from paper.claims_curves import gap_to_physics

    def found(**errors):
        (finding,) = gap_to_physics(curves_of(**{**AS_TOLD, **errors}))
        return finding

    finding = found()
    assert finding.holds is True
    assert finding.said.startswith("difference 6.49 → 1.01, ")
    assert finding.said.endswith("; EVGP-IFG and RES-DBNN, then EVGP-IFG and RES-DBNN (3)")
    assert found(RES_VGP=(0.9, 0.9, 1.5)).holds is False
    better = found(VGP=(6.5, 1.0, 0.5), EVGP_IF=(0.4, 0.2, 0.05))
    assert better.said.endswith("; EVGP-IFG and RES-DBNN, then EVGP-IF and VGP (3)")
    none = found(VGP=(0.01, 0.01, 0.01))
    assert none.holds is None
    assert "no gap to begin with" in none.said


def test_fewer_samples_means_below_the_others_with_all_rows():
    from paper.claims_curves import fewer_samples

    rows = curves_of(**AS_TOLD)
    (finding,) = fewer_samples(rows)
    assert finding.holds
    assert finding.said == "EVGP-IFG 0.0990 with 200 rows, RES-DBNN 1.10 with 400 rows (3)"
    # Below them with as many rows is not enough.
    assert holds(fewer_samples, curves_of(**AS_TOLD | {"RES_VGP": (8.0, 4.0, 0.085)})) is False
    assert list(fewer_samples([row for row in rows if row["n_rows"] == "100"])) == []
    assert list(fewer_samples([row for row in rows if row["model"] != "VGP"])) == []


def test_the_network_is_poor_if_both_evgps_are_better_with_few_rows():
    from paper.claims_curves import network_is_poor

    assert holds(network_is_poor, curves_of(**AS_TOLD)) is True
    assert holds(network_is_poor, curves_of(**AS_TOLD | {"RES_DBNN": (0.2, 0.1, 0.1)})) is False  # between the two
    assert holds(network_is_poor, curves_of(**AS_TOLD | {"RES_DBNN": (0.42, 0.1, 0.1)})) is True


def test_more_rows_help_if_no_model_gets_worse():
    from paper.claims_curves import more_rows_help

    (finding,) = more_rows_help(curves_of(**AS_TOLD))
    assert finding.holds
    assert finding.said.startswith("VGP × 0.967 (3 of 3), RES-VGP × 0.963 (3 of 3), RES-DBNN × 0.167 (3 of 3)")
    assert holds(more_rows_help, curves_of(**AS_TOLD | {"VGP": (9.0, 1.0, 9.1)})) is False
    rows = curves_of(**AS_TOLD)
    rows[2 * 3]["error_mean"] = "9.5"  # VGP's first run with the most rows
    (finding,) = more_rows_help(rows)
    assert finding.holds is None
    assert "VGP × 0.994 (2 of 3)" in finding.said


def test_the_pendulum_needs_few_rows_if_ifg_has_less_error_than_if_with_all():
    from paper.claims_curves import accurate_pendulum

    rows = curves_of(**AS_TOLD)
    (finding,) = accurate_pendulum(rows)
    assert finding.holds
    assert finding.said == (
        "EVGP-IFG 0.110 with 100 rows, EVGP-IF 0.220 with 400 rows, EVGP-IFG 0.0880 with 400 rows (3)"
    )
    assert holds(accurate_pendulum, curves_of(**AS_TOLD | {"EVGP_IF": (0.4, 0.3, 0.09)})) is False
    assert list(accurate_pendulum([{**row, "system": "acrobot"} for row in rows])) == []
