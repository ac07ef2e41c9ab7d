"""Verdicts on the paper's claims."""

import pytest


def fits(**errors):
    """Of each model two data sets, in the setting skevgp."""
    from paper.results_table_report import group

    return group(
        [
            {
                **{"system": "pendulum", "angles": "raw", "model": model.replace("_", "-"), "setting": "skevgp"},
                **{"seed": str(seed), "error_mean": str(error), "n_parameters": str(count)},
                **{f"cr{k}": str(ratio) for k, ratio in zip((1, 2, 3), ratios, strict=True)},
            }
            for model, (error, count, ratios) in errors.items()
            for seed in (0, 1)
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
    assert finding.where == "(dq1/dt, q1), paper"
    assert finding.holds == expected


def test_a_verdict_says_in_how_many_places():
    from paper.claims import Finding, Verdict, summary

    verdict = Verdict("Fish fly", (Finding("sea", True, "1"), Finding("lake", False, "2")))
    assert verdict.text == "holds in 1 of 2"
    assert "| Fish fly | holds in 1 of 2 | lake |" in summary([verdict])
    assert Verdict("", verdict.findings[:1]).text == "holds"
    assert Verdict("", verdict.findings[1:]).text == "does not hold"
    assert Verdict("", ()).text == "not measured"
