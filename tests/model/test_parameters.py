import numpy as np
import pytest

from skevgp.model.parameters import Parameter, ParameterTable


def table():
    return ParameterTable(
        [
            Parameter("length", np.array([1.0, 2.0]), "log", 0.5, np.array([3.0, 1.5])),
            Parameter("noise", np.array([0.1]), "log", fixed=True),
            Parameter("points", np.arange(6.0).reshape(1, 3, 2), unit=np.array([2.0, 4.0])),
        ]
    )


def test_values_come_back():
    values = table().values(table().start())
    np.testing.assert_allclose(values["points"], np.arange(6.0).reshape(1, 3, 2))
    np.testing.assert_allclose(values["noise"], [0.1])
    assert table().size == 8


def test_limits_are_those_of_the_coordinates():
    lower, upper = table().limits()
    np.testing.assert_allclose(lower[:2], np.log(0.5))
    np.testing.assert_allclose(upper[:2], np.log([3.0, 1.5]))
    assert np.isinf(upper[2:]).all()
    np.testing.assert_allclose(table()["length"].value_limits(), [[0.5, 3.0], [0.5, 1.5]])


def test_coordinates_far_from_zero_are_of_order_one_around_their_origin():
    first = 1e8 + np.array([0.5, -0.25])
    far = ParameterTable([Parameter("points", first, unit=2.0, origin=1e8)])
    np.testing.assert_array_equal(far.start(), [0.25, -0.125])
    np.testing.assert_array_equal(far.values(far.start())["points"], first)
    np.testing.assert_array_equal(far.values(far.start() + 1.0)["points"], first + 2.0)


def test_warm_starts_take_over_only_what_fits():
    again = table().started_at(
        {"length": np.array([0.7, 0.8]), "noise": np.array([9.0]), "points": np.zeros((2, 3, 2))}
    )
    values = again.values(again.start())
    np.testing.assert_allclose(values["length"], [0.7, 0.8])
    np.testing.assert_allclose(values["noise"], [0.1])
    np.testing.assert_allclose(values["points"], np.arange(6.0).reshape(1, 3, 2))


@pytest.mark.parametrize(("signal", "upper"), [(9.0, 10.0), (10.0, 1e3), (50.0, 1e3), (5e3, 1e3)])
def test_start_at_an_upper_limit_or_above_has_the_widest(signal, upper):
    first = ParameterTable([Parameter("signal", np.ones(2), "log", 1e-3, 10.0, widest=1e3)])
    np.testing.assert_allclose(first.limits()[1], np.log([10.0, 10.0]))
    np.testing.assert_allclose(first["signal"].value_limits(), [[1e-3, 1e3]] * 2)
    again = first.started_at({"signal": np.array([1.0, signal])})
    np.testing.assert_allclose(again.limits()[1], np.log(upper))
    np.testing.assert_allclose(again.values_at_start()["signal"], [1.0, min(signal, upper)])


def test_widest_limits_of_active_bounds():
    two = ParameterTable(
        [Parameter(name, np.ones(1), "log", 1e-3, 10.0, widest=1e3) for name in ("signal", "noise")]
        + [Parameter("length", np.ones(1), "log", 1e-3, 10.0)]
    )
    values = {"signal": np.array([10.0]), "noise": np.array([2.0]), "length": np.array([10.0])}
    assert two.held(values) == ("signal",)
    np.testing.assert_allclose(two.started_at(values).limits()[1], np.log([1e3, 10.0, 10.0]))
    np.testing.assert_allclose(two.widened(["noise"]).limits()[1], np.log([10.0, 1e3, 10.0]))


def test_table_where_all_is_fixed_has_no_coordinates():
    fixed = ParameterTable([Parameter("noise", np.array([0.1]), "log", fixed=True)])
    assert fixed.start().shape == (0,)
    np.testing.assert_allclose(fixed.values(fixed.start())["noise"], [0.1])


def partly_fixed():
    fixed = np.array([True, False, False, True])
    return ParameterTable(
        [
            Parameter("shape", np.array([1.0, 2.0, 3.0, 4.0]), "log", 0.5, np.array([1.0, 5.0, 2.5, 3.0]), fixed=fixed),
            Parameter("points", np.arange(2.0)),
        ]
    )


def test_single_entries_can_be_fixed():
    table = partly_fixed()
    assert table.size == 4
    np.testing.assert_allclose(table.values(table.start())["shape"], [1.0, 2.0, 2.5, 4.0])
    lower, upper = table.limits()
    np.testing.assert_allclose(upper[:2], np.log([5.0, 2.5]))
    np.testing.assert_allclose(lower[:2], np.log(0.5))
    values = table.values(np.array([0.1, 0.2, 7.0, 8.0]))
    np.testing.assert_allclose(values["shape"], [1.0, np.exp(0.1), np.exp(0.2), 4.0])
    np.testing.assert_allclose(values["points"], [7.0, 8.0])
    np.testing.assert_allclose(table.flat({"shape": np.arange(4.0), "points": np.ones(2)}), [1.0, 2.0, 1.0, 1.0])
    again = table.started_at({"shape": np.array([9.0, 1.0, 2.0, 9.0])})
    np.testing.assert_allclose(again.values(again.start())["shape"], [1.0, 1.0, 2.0, 4.0])


def test_points_of_one_column_are_alike_and_nothing_else():
    table = ParameterTable(
        [
            Parameter("lengthscales", np.ones(2), "log"),
            Parameter("noise", np.ones(3), "log", fixed=np.array([False, True, False])),
            Parameter("points", np.zeros((2, 4, 2))),
        ]
    )
    alike = table.alike()
    assert len(alike) == table.size == 2 + 2 + 16
    assert len(set(alike[:4])) == 4
    assert len(set(alike[4::2])) == len(set(alike[5::2])) == 1
    assert len(set(alike)) == 4 + 2
