"""Verdicts on the paper's claims."""

import pytest


def fits(factors=(0.9, 1.0, 1.1), setting="skevgp", **errors):
    """Of each model some data sets, whose Errors differ by factors."""
    from paper.results_table_report import group

    return group(
        [
            {
                **{"system": "pendulum", "angles": "raw", "model": model.replace("_", "-"), "setting": setting},
                **{"seed": str(seed), "error_mean": str(error * factor), "n_parameters": str(count)},
                **{"converged": "True", "max_iter": "", "n_iter": "9", "unlearned": "0"},
                **{f"cr{k}": str(ratio) for k, ratio in zip((1, 2, 3), ratios, strict=True)},
            }
            for model, (error, count, ratios) in errors.items()
            for seed, factor in enumerate(factors)
        ]
    )


GOOD, BAD = (0.68, 0.95, 0.99), (0.99, 1.0, 1.0)
AS_IN_THE_PAPER = {
    "VGP": (0.3, 407, BAD),
    "RES_VGP": (0.15, 407, BAD),
    "RES_DBNN": (0.02, 634, BAD),
    "EVGP_IF": (0.013, 119, BAD),
    "EVGP_IFG": (0.005, 123, GOOD),
}


def holds(finder, groups):
    (finding,) = finder(groups)
    return finding.holds


def test_claims_of_errors_ratios_and_parameters():
    from paper import claims

    finders = (
        *(claims.lowest_error, claims.lowest_is_ifg, claims.ifg_below_if, claims.best_ratios, claims.fewest_parameters),
    )
    assert [holds(finder, fits(**AS_IN_THE_PAPER)) for finder in finders] == [True] * 5
    others = {**AS_IN_THE_PAPER, "RES_VGP": (0.001, 407, GOOD), "EVGP_IFG": (0.014, 1000, BAD)}
    assert [holds(finder, fits(**others)) for finder in finders] == [False] * 5
    plain = {**AS_IN_THE_PAPER, "EVGP_IF": (0.004, 119, GOOD)}
    assert [holds(finder, fits(**plain)) for finder in finders] == [True, False, False, True, True]
    without = {name: value for name, value in AS_IN_THE_PAPER.items() if name != "VGP"}
    assert list(claims.lowest_error(fits(**without))) == []


def test_of_few_data_sets_or_scattered_ones_nothing_is_decided():
    from paper import claims

    errors = (claims.lowest_error, claims.lowest_is_ifg, claims.ifg_below_if)
    alone = fits(factors=(1.0,), **AS_IN_THE_PAPER)
    assert [holds(finder, alone) for finder in (*errors, claims.fewest_parameters, claims.best_ratios)] == [None] * 5
    (finding,) = claims.lowest_error(alone)
    assert finding.said.startswith("EVGP-IFG 0.00500 (1), EVGP-IF 0.0130 (1)")
    groups = fits(**AS_IN_THE_PAPER)
    for row, error in zip(groups["pendulum", "EVGP-IFG", "skevgp"], ("0.001", "0.001", "0.036"), strict=True):
        row["error_mean"] = error
    assert [holds(finder, groups) for finder in errors] == [None, None, None]
    # Only data sets that all models have are compared.
    groups = fits(factors=(0.8, 0.9, 1.0, 1.1), **AS_IN_THE_PAPER)
    groups["pendulum", "EVGP-IFG", "skevgp"][3]["error_mean"] = "0.9"
    groups["pendulum", "VGP", "skevgp"][3]["seed"] = "7"
    (finding,) = claims.lowest_error(groups)
    assert finding.holds
    assert finding.said.startswith("EVGP-IFG 0.00450 (3)")


def test_lower_means_on_all_data_sets_and_three_at_least():
    from paper.claims import lower

    first = {"0": 1.0, "1": 2.0, "2": 3.0}
    assert lower(first, {"0": 1.1, "1": 2.2, "2": 3.3, "5": 0.0}) is True
    assert lower(first, {"0": 0.9, "1": 1.8, "2": 2.7}) is False
    assert lower(first, {"0": 1.1, "1": 1.9, "2": 9.0}) is None
    assert lower({"0": 1.0, "1": 1.0}, {"0": 9.0, "1": 9.0}) is None


def curves_of(**errors):
    """Of models the Errors of three runs with 100, 200 and 400 rows."""
    return [
        {
            **{"system": "pendulum", "model": model.replace("_", "-"), "setting": "skevgp", "seed": str(seed)},
            **{"n_rows": str(n_rows), "error_mean": str(error * factor), "converged": "True"},
        }
        for model, own in errors.items()
        for n_rows, error in zip((100, 200, 400), own, strict=True)
        for seed, factor in enumerate((1.0, 1.1, 1.2))
    ]


def test_claims_of_learning_curves():
    from paper import claims

    def found(rows):
        return [
            *(holds(finder, rows) for finder in (claims.small_sets, claims.plateaus)),
            *(holds(lambda rows, other=other: claims.gaps(rows, other), rows) for other in ("RES-DBNN", "EVGP-IF")),
        ]

    as_told = {
        **{"VGP": (9.0, 8.8, 8.7), "RES_VGP": (8.0, 7.8, 7.7), "RES_DBNN": (6.0, 3.0, 1.0)},
        **{"EVGP_IF": (0.4, 0.3, 0.2), "EVGP_IFG": (0.1, 0.1, 0.1)},
    }
    assert found(curves_of(**as_told)) == [True, True, True, True]
    otherwise = as_told | {"VGP": (9.0, 4.0, 2.0), "RES_VGP": (0.01, 0.01, 0.01), "RES_DBNN": (6.0, 7.0, 8.0)}
    assert found(curves_of(**otherwise)) == [False, False, False, True]
    # A gap that is reversed is gone; where there was none, or one run says otherwise, nothing is decided.
    assert found(curves_of(**as_told | {"EVGP_IF": (0.4, 0.3, 0.05)}))[3] is True
    assert found(curves_of(**as_told | {"EVGP_IF": (0.05, 0.3, 0.2)}))[3] is None
    assert found([row for row in curves_of(**as_told) if row["seed"] != "2"]) == [None] * 4
    limited = curves_of(**as_told)
    for row in limited:
        row["converged"] = str(row["model"] != "VGP")
    (finding,) = claims.small_sets(limited)
    assert "VGP 9.90\\*" in finding.said
    (finding,) = claims.gaps(limited, "RES-DBNN")
    assert finding.said == "above by 6.49 with the fewest rows, by 0.990 with the most"
    (finding,) = claims.plateaus(limited)
    assert finding.said == "VGP × 0.98\\*, RES-VGP × 0.98"


def test_the_papers_own_table_is_judged_by_the_same_rules():
    from paper import claims
    from paper.results_table_report import PAPER

    assert claims.in_the_paper(claims.lowest_there) == "4 of 4"
    # On the pendulum RES-DBNN's containing ratios are nearer to a normal distribution's.
    assert not claims.best_ratios_there(PAPER["pendulum"])
    assert claims.best_ratios_there(PAPER["iiwa14"])
    assert claims.fewest_there(PAPER["acrobot"])
    assert not claims.lowest_there({**PAPER["acrobot"], "VGP": PAPER["pendulum"]["EVGP-IFG"]})


def test_angles_that_reach_pi_cover_the_range():
    from paper import claims

    def rows(*ranges):
        return [
            {"system": "pendulum", "column": "q", "random_state": str(state), "low": str(low), "high": str(high)}
            for state, (low, high) in enumerate(ranges)
        ]

    (finding,) = claims.angles_cover(rows((-3.1, 3.1), (-3.0, 8.0)))
    assert finding.holds
    (finding,) = claims.angles_cover(rows((-3.1, 3.1), (-2.3, 8.0)))
    assert not finding.holds
    assert finding.said == "narrowest -2.3 to 3.1; 1 of 2"


@pytest.mark.parametrize(
    ("b", "expected"), [((-0.13, -0.01), True), ((-0.13, -0.10), False), ((0.01, 0.0), False)], ids=str
)
def test_gravity_is_imitated_where_if_is_negative_and_ifg_is_not(b, expected):
    from paper import claims

    rows = [
        {
            **{"system": "acrobot", "setting": "paper", "model": model, "seed": "0", "feature": feature},
            **{"output": output, "mean": str(mean), "std": "0.001", "least_squares": "-0.1"},
        }
        for model, mean in zip(claims.EVGP, b, strict=True)
        for output in ("q1", "dq1/dt")
        for feature in ("q1",)
    ]
    (finding,) = claims.imitated_gravity(rows)
    assert (finding.where, finding.setting) == ("(dq1/dt, q1)", "paper")
    assert finding.holds == expected


def test_a_verdict_says_in_how_many_places():
    from paper.claims import Finding, Verdict, paragraphs, summary

    found = (Finding("sea", "paper", True, "1"), Finding("lake", "paper", False, "2"), Finding("pond", "", None, "3"))
    verdict = Verdict("Fish fly", "They leave the water.", found, "4 of 4")
    assert [verdict.count(setting) for setting in ("paper", "skevgp", "")] == ["1 of 2", "", "0 of 1"]
    assert "| Fish fly | 4 of 4 | 1 of 2 | 0 of 1 | lake, paper | pond |" in summary([verdict])
    page = "\n".join(paragraphs([verdict]))
    assert "They leave the water." in page
    assert "| pond |  | undecided | 3 |" in page
