"""What is told while a fit runs, and how it is told to stop."""

import io
from threading import Thread

import numpy as np
import pytest

from skevgp.utils.monitor import Monitor, Progress, monitor_of


def heard():
    """A list, and a monitor that writes all that it is told into it."""
    told = []
    return told, Monitor(lambda *what: told.append(what))


def test_an_iteration_is_told_with_its_number_and_loss():
    told, monitor = heard()
    monitor.iteration(1, 5.0)
    monitor.iteration(2, 4.0)
    assert [what[:2] for what in told] == [(1, 5.0), (2, 4.0)]


def test_nobody_needs_to_listen():
    Monitor().iteration(1, 5.0)


def test_a_part_tells_in_the_units_and_numbers_of_the_whole():
    told, monitor = heard()
    monitor.seen_as(100, 2.0, 7.0, range(1, 3)).iteration(3, 5.0)
    assert told == [(103, 2.0 * 5.0 + 7.0, range(1, 3))]


def test_parts_of_parts_compose():
    """Per row of the internal units -> all rows in internal units -> in the user's, with iterations before each."""
    told, monitor = heard()
    in_users_units = monitor.seen_as(shift=30.0, outputs=range(0, 1))
    second_stage = in_users_units.seen_as(100, 60.0)
    second_stage.seen_as(20, 0.5, 1.0).iteration(3, 4.0)
    assert told == [(123, 60.0 * (0.5 * 4.0 + 1.0) + 30.0, range(0, 1))]


def test_a_part_that_knows_its_outputs_better_says_so():
    told, monitor = heard()
    whole = monitor.seen_as(outputs=range(0, 4))
    whole.seen_as(5).iteration(1, 0.0)
    whole.seen_as(outputs=range(2, 3)).iteration(1, 0.0)
    assert [what[2] for what in told] == [range(0, 4), range(2, 3)]


def test_a_part_leaves_the_whole_as_it_was():
    told, monitor = heard()
    monitor.seen_as(100, 2.0, 7.0, range(3))
    monitor.iteration(1, 5.0)
    assert told == [(1, 5.0, range(0))]


# --- stopping ------------------------------------------------------------------------------------------------------


def test_ctrl_c_inside_ends_the_work_without_an_error():
    monitor, done = Monitor(), []
    with monitor.keeping_the_best():
        done.append("before")
        raise KeyboardInterrupt
    assert done == ["before"]
    assert monitor.stopped


def test_other_errors_are_not_kept():
    monitor = Monitor()
    with pytest.raises(ZeroDivisionError), monitor.keeping_the_best():
        raise ZeroDivisionError
    assert not monitor.stopped


def test_what_ends_well_is_not_stopped():
    monitor = Monitor()
    with monitor.keeping_the_best():
        monitor.iteration(1, 0.0)
    assert not monitor.stopped


@pytest.mark.parametrize("where", ["whole", "part"])
def test_ctrl_c_anywhere_stops_all_parts(where):
    told, monitor = heard()
    parts = monitor.seen_as(10), monitor.seen_as(20).seen_as(5)
    (monitor if where == "whole" else parts[1]).stop()
    for one in (monitor, *parts):
        assert one.stopped
        with pytest.raises(KeyboardInterrupt):
            one.iteration(1, 0.0)
    # What comes too late is not told.
    assert told == []


def test_ctrl_c_in_one_thread_ends_the_others_at_their_next_iteration():
    monitor, reached = Monitor(), []

    def work(part):
        with part.keeping_the_best():
            for number in range(10**9):
                reached.append(number)
                part.iteration(number, 0.0)

    threads = [Thread(target=work, args=(monitor.seen_as(),)) for _ in range(3)]
    for thread in threads:
        thread.start()
    monitor.stop()
    for thread in threads:
        thread.join(60.0)
        assert not thread.is_alive()


def test_a_listener_may_stop_the_fit():
    def interrupt(number, loss, outputs):
        if number == 3:
            raise KeyboardInterrupt

    monitor = Monitor(interrupt)
    with monitor.keeping_the_best():
        for number in range(1, 10):
            monitor.iteration(number, 0.0)
    assert number == 3
    assert monitor.stopped


# --- what the user sees --------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    """Of which the tests decide what it shows."""

    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture(params=[Terminal, io.StringIO], ids=["terminal", "log"])
def output(request):
    return request.param()


@pytest.fixture
def terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    return Terminal()


def shown(progress, clock, losses, seconds=1.0, outputs=range(1), first=1, **options):
    """Iterations that take so many seconds each."""
    monitor = Monitor(progress=progress).seen_as(outputs=outputs)
    for number, loss in enumerate(losses, first):
        clock.now += seconds
        monitor.iteration(number, loss, **options)


def test_every_iteration_is_printed_if_asked_for_twice(output):
    progress = Progress(2, output)
    shown(progress, Clock(), [10.0, 20.0, 30.0])
    progress.close()
    lines = output.getvalue().splitlines()
    assert [line.split()[:4] for line in lines] == [
        ["iteration", str(number), "bound", f"{-10.0 * number:.3f}"] for number in (1, 2, 3)
    ]


def test_on_a_terminal_one_line_is_written_over_and_ended_with_the_fit(terminal):
    clock = Clock()
    progress = Progress(1, terminal, clock)
    shown(progress, clock, [1234.0, 5.0])
    assert "\n" not in terminal.getvalue()
    progress.close()
    _, first, second = terminal.getvalue().split("\r")
    assert first == "iteration 1, bound -1234.000, 1 s"
    # Nothing of the longer one before is left.
    assert second == "iteration 2, bound -5.000, 2 s".ljust(len(first)) + "\n"


def test_a_live_line_is_written_a_few_times_a_second_and_at_the_end(terminal):
    clock = Clock()
    progress = Progress(1, terminal, clock)
    shown(progress, clock, np.zeros(1000), seconds=0.01)
    progress.close()
    lines = terminal.getvalue().split("\r")[1:]
    assert 10 <= len(lines) <= 21
    assert lines[-1].startswith("iteration 1000,")


def test_a_live_line_is_no_longer_than_the_terminal(terminal, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    clock = Clock()
    shown(Progress(1, terminal, clock), clock, [1.0])
    assert terminal.getvalue() == "\riteration 1, bound "


def test_a_log_gets_a_line_each_ten_seconds_and_the_last():
    clock, log = Clock(), io.StringIO()
    progress = Progress(1, log, clock)
    shown(progress, clock, np.zeros(25))
    progress.close()
    progress.close()
    assert [line.split(",")[0] for line in log.getvalue().splitlines()] == [
        "iteration 10", "iteration 20", "iteration 25"
    ]  # fmt: skip


def test_a_fit_without_iterations_leaves_no_line(output):
    Progress(1, output).close()
    assert output.getvalue() == ""


def test_the_part_of_the_fit_is_told(terminal):
    clock = Clock()
    monitor = Monitor(progress=Progress(1, terminal, clock)).seen_as(about="y[:, 2]").seen_as(about="50 of 90 rows")
    clock.now += 1.0
    monitor.iteration(3, 2.0)
    monitor.silent().iteration(4, 2.0)
    assert terminal.getvalue() == "\ry[:, 2], 50 of 90 rows, iteration 3, bound -2.000, 1 s"


def left(terminal):
    """What the last line says of the time left."""
    line = terminal.getvalue().split("\r")[-1].strip()
    return line.rpartition(", about ")[2].removesuffix(" left") if " left" in line else None


def test_where_only_the_number_of_steps_ends_them_the_time_left_is_in_proportion(terminal):
    clock = Clock()
    shown(Progress(1, terminal, clock), clock, np.zeros(60), most=100)
    assert left(terminal) == "40 s"
    shown(Progress(1, terminal, clock), clock, np.zeros(60), seconds=10.0, most=100)
    assert left(terminal) == "7 min"


def test_it_is_that_of_recent_iterations(terminal):
    clock = Clock()
    progress = Progress(1, terminal, clock)
    shown(progress, clock, np.zeros(30), seconds=9.0, most=100)
    shown(progress, clock, np.zeros(60), first=31, most=100)
    assert left(terminal) == "10 s"


@pytest.mark.parametrize("factor", [1.0, 50.0])
def test_gains_that_fall_geometrically_tell_when_they_are_small_enough(terminal, factor):
    """0.9^k of the first after k iterations: a thousandth after 66."""
    clock, losses = Clock(), 0.9 ** np.arange(41)
    monitor = Monitor(progress=Progress(1, terminal, clock)).seen_as(100, factor, 7.0)
    for number, loss in enumerate(losses, 1):
        clock.now += 1.0
        monitor.iteration(number, loss, most=1000, enough=0.1 * 1e-3)
    assert left(terminal) == "30 s"


def test_it_is_no_longer_than_the_most_iterations_take(terminal):
    clock = Clock()
    shown(Progress(1, terminal, clock), clock, 0.99 ** np.arange(81), most=90, enough=1e-30)
    assert left(terminal) == "9 s"


@pytest.mark.parametrize(
    ("losses", "is_last", "most"),
    [
        (0.9 ** np.arange(12), True, 1000),
        (-np.arange(40.0), True, 1000),
        (0.9 ** np.arange(40), False, 1000),
        (0.9 ** np.arange(40), True, None),
    ],
    ids=["too early", "gains do not fall", "others follow", "nobody says"],
)
def test_nothing_is_said_that_is_not_known(terminal, losses, is_last, most):
    clock = Clock()
    monitor = Monitor(progress=Progress(1, terminal, clock)).seen_as(is_last=is_last).seen_as()
    for number, loss in enumerate(losses, 1):
        clock.now += 1.0
        monitor.iteration(number, loss, most=most, enough=1e-3)
    assert "iteration" in terminal.getvalue()
    assert left(terminal) is None


def test_a_tolerance_of_nothing_is_no_end(terminal):
    clock = Clock()
    shown(Progress(1, terminal, clock), clock, 0.9 ** np.arange(60), most=100, enough=0.0)
    assert left(terminal) == "40 s"


def test_a_new_start_is_not_taken_for_the_old_one(terminal):
    clock = Clock()
    progress = Progress(1, terminal, clock)
    shown(progress, clock, np.zeros(50), most=60)
    assert left(terminal) == "10 s"
    shown(progress, clock, np.zeros(5), most=60)
    assert left(terminal) is None


def test_outputs_side_by_side_are_told_apart(terminal):
    """One is fast and one slow; the line is of the one that has just had an iteration."""
    clock = Clock()
    progress = Progress(1, terminal, clock)
    for number in range(1, 31):
        shown(progress, clock, [0.0], seconds=0.5, outputs=range(1), first=number, most=60)
        shown(progress, clock, [0.0], seconds=0.5, outputs=range(1, 2), first=number, most=50)
    assert left(terminal) == "20 s"
    shown(progress, clock, [0.0], outputs=range(1), first=31, most=60)
    assert left(terminal) == "30 s"


def test_a_callback_is_told_the_bound():
    told = []
    with monitor_of(0, lambda *what: told.append(what)) as monitor:
        monitor.seen_as(outputs=range(0, 2)).iteration(4, -3.0)
    assert told == [(4, 3.0, range(0, 2))]


@pytest.mark.parametrize("verbose", [0, 1, 2])
def test_both_are_served(verbose, capsys):
    told = []
    for callback in (lambda *what: told.append(what), None):
        with monitor_of(verbose, callback) as monitor:
            monitor.iteration(1, 5.0)
    assert len(told) == 1
    assert len(capsys.readouterr().out.splitlines()) == (2 if verbose else 0)


def test_a_fit_that_fails_ends_its_line(capsys):
    def fit():
        with monitor_of(1) as monitor:
            monitor.iteration(1, 5.0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fit()
    assert capsys.readouterr().out == "iteration 1, bound -5.000, 0 s\n"
