"""The driver of the mutation tests: `tests/long/mutants.py` runs them, which takes half an hour."""

import pytest

from skevgp.metrics import crps, prediction_error

from .long.mutants import PACKAGE, TESTS, equivalent, mutants_of, put_in_place

each_module = pytest.mark.parametrize("module", TESTS)


@each_module
def test_mutants_can_be_compiled_and_told_apart(module):
    mutants = mutants_of(module)
    assert len({mutant.key for mutant in mutants}) == len(mutants) > 100
    for mutant in mutants:
        compile(mutant.source, module, "exec")


@each_module
def test_tests_that_see_mutants_are_there(module):
    assert [path for path in TESTS[module] if not (PACKAGE.parent / path.partition("::")[0]).is_file()] == []


def test_those_that_no_test_can_see_are_still_mutants_each_with_a_reason():
    keys = {mutant.key for module in TESTS for mutant in mutants_of(module)}
    assert set(equivalent()) <= keys
    assert all(equivalent().values())


def test_a_mutant_takes_the_place_of_what_has_been_imported():
    (mutant,) = (
        mutant for mutant in mutants_of("metrics.py") if "y_true + y_pred" in mutant.after and ".norm(" in mutant.after
    )
    source = (PACKAGE / "metrics.py").read_bytes()
    try:
        assert put_in_place("metrics.py", mutant.source) == ""
        assert prediction_error([1.0], [1.0]) == 2.0
        assert put_in_place("metrics.py", source.replace(b"density = np.exp", b"density = np.exq")) == ""
        with pytest.raises(AttributeError):
            crps([1.0], [1.0], [1.0])
    finally:
        put_in_place("metrics.py", source)
    assert prediction_error([1.0], [1.0]) == 0.0


def test_a_constant_and_a_default_are_put_in_place_too():
    from skevgp.model import statistics
    from skevgp.utils.linalg import JITTER

    module, source = "model/statistics.py", (PACKAGE / "model" / "statistics.py").read_bytes()
    of = statistics.Whitening.of
    try:
        put_in_place(module, source.replace(b"_NO_JITTER = 1e-13", b"_NO_JITTER = 0.5"))
        assert statistics._NO_JITTER == 0.5
        put_in_place(module, source.replace(b"jitter: Jitter = JITTER\n", b"jitter: Jitter = None\n"))
        assert of.__defaults__ == (None,)
    finally:
        put_in_place(module, source)
    assert of.__defaults__ == (JITTER,)
    assert statistics._NO_JITTER == 1e-13


def test_a_module_that_cannot_be_imported_says_so():
    assert put_in_place("metrics.py", b"import nowhere").startswith("import: ModuleNotFoundError")
