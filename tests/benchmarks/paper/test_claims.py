"""Verdicts on the paper's claims."""

import pytest

from .test_claims_curves import AS_TOLD, curves_of, holds


def fits(factors=(0.9, 1.0, 1.1), setting="skevgp", **errors):
    """Of each model some data sets, whose Errors differ by factors."""
    from paper.results_table_report import group

    return group(
        [
            {
                **{"system": "pendulum", "angles": "raw", "model": model.replace("_", "-"), "setting": setting},
                **{"seed": str(seed), "error_mean": str(error * factor), "n_parameters": str(count)},
                **{"std_norm": str(error * factor / 2), "error_inside": str(error * factor / 10), "size": "full"},
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


def test_claims_of_errors_ratios_and_parameters():
    from paper import claims_table as claims

    finders = (
        *(claims.lowest_error, claims.lowest_is_ifg, claims.ifg_below_if, claims.best_ratios, claims.fewest_parameters),
        claims.low_std,
    )
    assert [holds(finder, fits(**AS_IN_THE_PAPER)) for finder in finders] == [True] * 6
    others = {**AS_IN_THE_PAPER, "RES_VGP": (0.001, 407, GOOD), "EVGP_IFG": (0.014, 1000, BAD)}
    assert [holds(finder, fits(**others)) for finder in finders] == [False] * 6
    plain = {**AS_IN_THE_PAPER, "EVGP_IF": (0.004, 119, GOOD)}
    assert [holds(finder, fits(**plain)) for finder in finders] == [True, False, False, True, True, False]
    (finding,) = claims.fewest_parameters(fits(**plain))
    assert finding.said.startswith("Error: EVGP-IF 0.00400 (3), RES-DBNN 0.0200 (3); parameters: VGP 407, RES-VGP 407")
    (finding,) = claims.low_std(fits(**plain))  # not of the Error: half of it here
    assert finding.said.startswith("EVGP-IF 0.00200 (3), EVGP-IFG 0.00250 (3)")
    without = {name: value for name, value in AS_IN_THE_PAPER.items() if name != "VGP"}
    assert list(claims.lowest_error(fits(**without))) == []


def test_of_few_data_sets_or_scattered_ones_nothing_is_decided():
    from paper import claims_table as claims

    errors = (claims.lowest_error, claims.lowest_is_ifg, claims.ifg_below_if)
    alone = fits(factors=(1.0,), **AS_IN_THE_PAPER)
    assert [holds(finder, alone) for finder in (*errors, claims.fewest_parameters, claims.best_ratios)] == [None] * 5
    (finding,) = claims.lowest_error(alone)
    assert finding.said.startswith("EVGP-IFG 0.00500 (1), EVGP-IF 0.0130 (1)")
    groups = fits(**AS_IN_THE_PAPER)
    for row, error in zip(groups["pendulum", "EVGP-IFG", "skevgp"], ("0.001", "0.001", "0.036"), strict=True):
        row["error_mean"] = error
    # There EVGP-IF is the better of the two.
    assert [holds(finder, groups) for finder in errors] == [True, None, None]
    # Only data sets that all models have are compared.
    groups = fits(factors=(0.8, 0.9, 1.0, 1.1), **AS_IN_THE_PAPER)
    groups["pendulum", "EVGP-IFG", "skevgp"][3]["error_mean"] = "0.9"
    groups["pendulum", "VGP", "skevgp"][3]["seed"] = "7"
    (finding,) = claims.lowest_error(groups)
    assert finding.holds
    assert finding.said.startswith("EVGP-IFG 0.00450 (3)")


def test_lower_means_on_all_data_sets_and_three_at_least():
    from paper.claims_findings import lower

    first = {"0": 1.0, "1": 2.0, "2": 3.0}
    assert lower(first, {"0": 1.1, "1": 2.2, "2": 3.3, "5": 0.0}) is True
    assert lower(first, {"0": 0.9, "1": 1.8, "2": 2.7}) is False
    assert lower(first, {"0": 1.1, "1": 1.9, "2": 9.0}) is None
    assert lower({"0": 1.0, "1": 1.0}, {"0": 9.0, "1": 9.0}) is None


def test_all_hold_together_or_one_fails():
    from paper.claims_findings import together

    assert [together(holds) for holds in ([True, True], [True, False], [True, None], [None, False])] == [
        *(True, False, None, False)
    ]


def test_inside_is_a_second_verdict_by_the_same_rule():
    from paper.claims import Line, verdict
    from paper.claims_findings import inside_of
    from paper.claims_table import ifg_below_if, low_std
    from paper.results_table_report import group

    rows = [row for own in fits(**AS_IN_THE_PAPER).values() for row in own]
    for row in rows:
        if row["model"] == "EVGP-IFG":
            row["error_inside"] = "0.9"
    assert [row["error_mean"] for row in inside_of(rows) if row["model"] == "EVGP-IFG"] == ["0.9"] * 3
    assert rows[0]["error_mean"] != inside_of(rows)[0]["error_mean"]  # the rows stay as they are

    def found(rows, find=ifg_below_if, of_errors=True):
        own = verdict(Line("IFG is best", find, of_errors=of_errors), rows, group)
        (finding,) = own.findings
        return own, finding

    own, finding = found(rows)
    assert (finding.holds, finding.inside) == (True, False)
    assert finding.said == "IF 0.0130 (3), IFG 0.00500 (3), lower on 3 of 3 data sets"
    assert finding.said_inside == "IF 0.00130 (3), IFG 0.900 (3), lower on 0 of 3 data sets"
    assert (own.count("skevgp"), own.count("skevgp", inside=True)) == ("1 / 0 / 0", "0 / 1 / 0")
    # Of too few data sets nothing is decided, as of none.
    for row in rows[:1]:
        row["error_inside"] = "nan"
    rows[-1]["error_inside"] = "nan"
    own, finding = found(rows)
    assert (finding.holds, finding.inside) == (True, None)
    assert "lower on 0 of 2 data sets" in finding.said_inside
    own, finding = found([{**row, "error_inside": "nan"} for row in rows])
    assert (finding.holds, finding.inside, finding.said_inside) == (True, None, "not measured")
    # What is not of Errors has one verdict.
    own, finding = found(rows, low_std, of_errors=False)
    assert (own.count("skevgp"), own.count("skevgp", inside=True), finding.said_inside) == ("1 / 0 / 0", "", "")


def test_the_papers_own_table_is_judged_by_the_same_rules():
    from paper import claims_table as claims
    from paper.results_table_report import PAPER

    assert claims.in_the_paper(claims.lowest_there) == "4 / 0 / 0"
    # On cartpole and iiwa14 RES-DBNN is surer of itself.
    assert claims.in_the_paper(claims.low_std_there) == "2 / 2 / 0"
    assert not claims.low_std_there(PAPER["cartpole"])
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
    ("b", "expected"),
    [
        (((-0.13,) * 3, (-0.01, 0.2, 0.0)), True),
        (((-0.13,) * 3, (-0.10,) * 3), False),
        (((0.01,) * 3, (0.0,) * 3), False),
        (((-0.13, -0.13, 0.13), (-0.01,) * 3), None),
        (((-0.13,) * 3, (-0.01, -0.01, -0.10)), None),
    ],
    ids=str,
)
def test_gravity_is_imitated_where_if_is_negative_and_ifg_is_not(b, expected):
    from paper import claims

    rows = [
        {
            **{"system": "acrobot", "setting": "paper", "model": model, "seed": seed, "feature": feature},
            **{"output": output, "mean": str(mean), "std": "0.001", "least_squares": "-0.1"},
        }
        for model, means in zip(claims.EVGP, b, strict=True)
        for seed, mean in zip("012", means, strict=True)
        for output in ("q1", "dq1/dt")
        for feature in ("q1",)
    ]
    (finding,) = claims.imitated_gravity(rows)
    assert (finding.where, finding.setting) == ("(dq1/dt, q1)", "paper")
    assert finding.holds == expected


def weights(**b):
    """Of both EVGPs of an acrobot with one velocity, on three data sets."""
    features = {"dq1/dt": 1.0, "q1": 0.0, "sin(q1)": 0.0}
    return [
        {
            **{"system": "acrobot", "setting": "paper", "model": model, "seed": seed, "output": "dq1/dt"},
            **{"feature": feature, "prior_mean": str(prior), "size": "full", "std": "0.1", "least_squares": "0.0"},
            "mean": str(mean if (seed, model) == ("1", "EVGP-IFG") else (0.9, -0.1, -0.4)[number]),
        }
        for model in ("EVGP-IF", "EVGP-IFG")
        for seed in "012"
        for number, ((feature, prior), mean) in enumerate(
            zip(features.items(), b.get("other", (0.9, -0.1, -0.4)), strict=True)
        )
    ]


def test_weights_have_the_priors_structure_if_signs_and_sizes_are_its():
    from paper.claims import structure

    def found(*other):
        plain, gravity = structure(weights(other=other))
        assert (plain.where, plain.setting, plain.holds) == ("EVGP-IF", "paper", True)
        return gravity.holds, gravity.said

    assert found(0.9, -0.1, -0.4) == (
        True,
        "least (dq1/dt, dq1/dt) 0.900 against (dq1/dt, sin(q1)) 0.400, × 2.25, signs as the prior's on 3 of 3 data "
        "sets; with γ least (dq1/dt, sin(q1)) 0.400 against (dq1/dt, q1) 0.100, × 4.00",
    )
    decided, said = found(0.9, -1.0, -0.4)  # a weight that the prior has not is larger on one data set
    assert decided is None
    assert said.startswith("least (dq1/dt, dq1/dt) 0.900 against (dq1/dt, q1) 1.00, × 0.900, signs")
    decided, said = found(-0.9, -0.1, -0.4)
    assert decided is None
    assert "signs as the prior's on 2 of 3 data sets" in said
    rows = [{**row, "mean": "0.9"} for row in weights()]
    assert [finding.holds for finding in structure(rows)] == [False, False]
    assert [finding.where for finding in structure([row for row in rows if row["model"] == "EVGP-IF"])] == ["EVGP-IF"]


def test_verdicts_are_of_full_fits_with_raw_angles(tmp_path):
    from harness import append
    from paper.claims import verdicts

    rows = [row for own in fits(**AS_IN_THE_PAPER).values() for row in own]
    for row in rows:
        if row["model"] == "VGP":
            row["error_inside"] = "1e-9"
    others = [{**row, name: value, "error_mean": "9"} for row in rows for name, value in (("size", "quick"),)]
    others += [{**row, "angles": "wrapped", "error_mean": "9"} for row in rows]
    append([*rows, *others], tmp_path / "results_table.csv")
    append(curves_of(**AS_TOLD), tmp_path / "learning_curves.csv")
    append([{**row, "output": output} for output in ("q1", "dq1/dt") for row in weights()], tmp_path / "beta.csv")
    angles = {"system": "pendulum", "random_state": "0", "size": "full", "column": "q", "low": "-3.1", "high": "3.1"}
    append([angles], tmp_path / "data_sets.csv")

    found = {verdict.claim: verdict for verdict in verdicts(tmp_path)}
    best = found["EVGP models provided the lowest error"]
    assert (best.of_the_paper, best.count("skevgp"), best.count("skevgp", inside=True)) == (
        *("4 / 0 / 0", "1 / 0 / 0", "0 / 1 / 0"),
    )
    one_place = [verdict.findings for verdict in found.values() if len(verdict.findings) == 1]
    assert len(one_place) == len(found) - 1 == 17  # all but the structure, which is of both models
    assert all(verdict.criterion.endswith((".", ".)")) for verdict in found.values())
    assert all("  " not in verdict.criterion for verdict in found.values())
    alone = [claim for claim, verdict in found.items() if not verdict.has_inside]
    assert [claim[:24] for claim in alone] == [
        *("EVGP-IFG provided the es", "EVGP models provided the", "The values cover at leas"),
        *("The learned parameters f", "With IF, EVGP assigns ne"),
    ]


def test_a_verdict_says_in_how_many_places():
    from paper.claims import exceptions, paragraphs, summary
    from paper.claims_findings import Finding, Verdict

    lakes = [Finding("sea", "paper", True, "1"), Finding("lake", "paper", False, "2"), Finding("pond", "", None, "3")]
    lakes.append(Finding("pool", "paper", False, "4"))
    verdict = Verdict("Fish fly", "They leave the water.", tuple(lakes), "4 / 0 / 0")
    assert [verdict.count(setting) for setting in ("paper", "skevgp", "")] == ["1 / 2 / 0", "", "0 / 0 / 1"]
    assert [verdict.where(holds) for holds in (True, False, None)] == ["paper: sea", "paper: lake, pool", "pond"]
    assert "| Fish fly | 4 / 0 / 0 | 1 / 2 / 0 |  | 0 / 0 / 1 |  |" in summary([verdict])
    assert "holds / fails / undecided" in summary([verdict]).splitlines()[0]
    assert "| Fish fly | paper: lake, pool | pond |  |  |" in exceptions([verdict])
    page = "\n".join(paragraphs([verdict]))
    assert "They leave the water." in page
    assert "| pond |  | undecided | 3 |" in page
    assert "inside the training range |" not in page

    whales = Finding("sea", "skevgp", True, "1", None, "not measured"), Finding("lake", "skevgp", True, "2", False, "5")
    verdict = Verdict("Whales swim", "They stay.", whales)
    assert "| Whales swim |  |  |  | 2 / 0 / 0 | 0 / 1 / 1 |" in summary([verdict])
    assert "| Whales swim |  |  | skevgp: lake | skevgp: sea |" in exceptions([verdict])
    page = "\n".join(paragraphs([verdict]))
    assert "| where | setting | holds | inside the training range | numbers | numbers inside |" in page
    assert "| sea | skevgp | yes | undecided | 1 | not measured |" in page
    assert "1/16" in page
