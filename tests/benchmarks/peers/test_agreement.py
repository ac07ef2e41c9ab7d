"""Libraries say the same at fixed hyperparameters, or are named."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

# Those that are not there need another environment.
LIBRARIES = {
    **{"skevgp": "skevgp", "scikit-learn GPR": "sklearn"},
    **{"GPflow SGPR": "gpflow", "GPyTorch SGPR": "gpytorch", "GPJax SGPR": "gpjax"},
}
INSTALLED = [peer for peer, package in LIBRARIES.items() if find_spec(package)]
SPARSE_OF_OTHERS = [peer for peer in INSTALLED if peer not in ("skevgp", "scikit-learn GPR")]


def said_by(at_fixed, fixed, folder):
    """Through the files by which processes talk."""
    from peers.jobs import Fixed, Said

    fixed.save(folder / "fixed.npz")
    at_fixed(Fixed.load(folder / "fixed.npz")).save(folder / "said.npz")
    return Said.load(folder / "said.npz")


@pytest.mark.parametrize("peer", INSTALLED)
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
    assert asked == ["skevgp", "GPflow SGPR", "GPJax SGPR", "GPyTorch SGPR", "scikit-learn GPR"]
    assert capsys.readouterr().out.count("agrees with dense matrices to 0e+00") == 5
    with pytest.raises(SystemExit, match=r"gpflow disagrees: .*\(kernel matern52, 500 rows.*jitter absolute"):
        agreement.check({"skevgp": "right", "GPflow SGPR": "wrong"}, work)
    with pytest.raises(SystemExit, match="gpytorch failed at fixed hyperparameters: no such module"):
        agreement.check({"GPyTorch SGPR": "broken"}, work)


if SPARSE_OF_OTHERS:

    @pytest.mark.parametrize("peer", SPARSE_OF_OTHERS)
    def test_a_fit_begins_where_all_begin_and_rises(peer):
        """From the bound of dense matrices at the common start, to a prediction that is better than that."""
        from peers import agreement
        from peers.jobs import Fixed, Job
        from peers.models import run

        rng = np.random.RandomState(0)
        X, X_test = rng.uniform(-2.0, 2.0, (150, 2)), rng.uniform(-2.0, 2.0, (50, 2))
        Y, Y_test = (np.column_stack([np.sin(2.0 * A).sum(axis=1), A[:, 0] ** 2]) for A in (X, X_test))
        Y = 3.0 * Y + 0.1 * rng.randn(*Y.shape)
        result = run(peer, Job(X, Y, X_test, X[:12], X.std(axis=0), 0.5, "none", 15, 300.0, 0, 20))
        starts = []
        for y in Y.T:
            square = np.mean(y**2)
            starts.append(agreement.expected(Fixed("rbf", X, y, X_test, X[:12], X.std(axis=0), square, 0.5 * square)))
        # Its jitter is 1e-6 here.
        assert result.curve[2, 0] == pytest.approx(sum(start.bound for start in starts), rel=1e-4)
        assert (np.diff(result.curve) >= 0.0).all()
        assert result.curve[2, -1] == pytest.approx(result.bound[0]) == pytest.approx(result.bounds.sum())
        assert result.bound[0] > result.curve[2, 0] + 50.0
        assert (np.diff(result.seconds) < 0.0).all()  # looked at from the end on
        assert result.stop.split() in (["iterations"] * 2, ["steps"] * 2)
        means, stds = (np.column_stack(part) for part in zip(*[(s.mean, s.variance**0.5) for s in starts], strict=True))
        np.testing.assert_allclose(result.mean[-1], means, atol=1e-3)
        np.testing.assert_allclose(result.std[-1], stds, rtol=1e-3)
        assert np.sum((result.mean[0] - 3.0 * Y_test) ** 2) < 0.5 * np.sum((result.mean[-1] - 3.0 * Y_test) ** 2)

    @pytest.mark.parametrize("peer", SPARSE_OF_OTHERS)
    def test_a_fit_without_time_left_says_so(peer):
        from peers.jobs import Job
        from peers.models import run

        X = np.linspace(-1.0, 1.0, 20)[:, np.newaxis]
        job = Job(X, X, X, X[:3], np.ones(1), 0.5, "none", 15, 0.0, 0)
        if peer.startswith("GPyTorch"):
            assert run(peer, job).stop == "time"
        else:
            with pytest.raises(RuntimeError, match="succeeded or fitted into the time limit"):
                run(peer, job)
