"""Libraries say the same at fixed hyperparameters, or are named."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

# Those that are not there need another environment.
LIBRARIES = {
    **{"skevgp": "skevgp", "scikit-learn GPR": "sklearn"},
    **{"GPflow SGPR": "gpflow", "GPyTorch SGPR": "gpytorch"},
}


def said_by(at_fixed, fixed, folder):
    """Through the files by which processes talk."""
    from peers.jobs import Fixed, Said

    fixed.save(folder / "fixed.npz")
    at_fixed(Fixed.load(folder / "fixed.npz")).save(folder / "said.npz")
    return Said.load(folder / "said.npz")


@pytest.mark.parametrize("peer", [peer for peer, package in LIBRARIES.items() if find_spec(package)])
def test_libraries_agree_with_dense_matrices(peer, tmp_path):
    from peers import agreement
    from peers.models import PEERS

    for fixed in agreement.cases():
        if fixed.exact or PEERS[peer].points != "rows":
            said = said_by(PEERS[peer].at_fixed, fixed, tmp_path)
            assert agreement.difference(said, agreement.expected(fixed)) < agreement.TOLERANCE


@pytest.mark.parametrize("kernel", ["rbf", "matern52"])
def test_skevgp_says_what_the_exact_gp_of_scikit_learn_says(kernel):
    from peers import agreement
    from peers.libraries import with_skevgp, with_sklearn

    fixed = next(case for case in agreement.cases() if case.exact and case.kernel == kernel)
    assert agreement.difference(with_skevgp.at_fixed(fixed), with_sklearn.at_fixed(fixed)) < agreement.TOLERANCE


@pytest.mark.parametrize("part", ["bound", "mean", "variance"])
def test_a_difference_of_any_part_counts(part):
    from peers import agreement

    said = agreement.expected(agreement.cases()[0])
    other = replace(said, **{part: getattr(said, part) * (1.0 + 1e-5)})
    assert agreement.difference(other, said) == pytest.approx(1e-5, rel=1e-3)
    assert not agreement.difference(replace(said, **{part: getattr(said, part) * np.nan}), said) <= agreement.TOLERANCE


def test_the_library_that_disagrees_or_fails_is_named(capsys):
    from peers import agreement
    from peers.jobs import Fixed
    from peers.models import PEERS

    asked = []

    def work(python, peer, given, said):
        asked.append(peer)
        for path in given.iterdir():
            answer = agreement.expected(Fixed.load(path))
            if python == "wrong" and path.stem == "2":
                answer = replace(answer, variance=answer.variance + 0.01)
            answer.save(said / path.name)
        if python == "broken":
            raise RuntimeError("no such module")

    agreement.check(dict.fromkeys(PEERS, "right"), work)
    assert asked == ["skevgp", "GPflow SGPR", "GPyTorch SGPR", "scikit-learn GPR"]
    assert capsys.readouterr().out.count("agrees with dense matrices to 0e+00") == 4
    with pytest.raises(SystemExit, match=r"gpflow disagrees: .*\(kernel matern52, 500 rows.*jitter absolute"):
        agreement.check({"skevgp": "right", "GPflow SGPR": "wrong"}, work)
    with pytest.raises(SystemExit, match="gpytorch failed at fixed hyperparameters: no such module"):
        agreement.check({"GPyTorch SGPR": "broken"}, work)
