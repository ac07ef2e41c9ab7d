"""What is told while a fit runs, and how it is told to stop."""

from threading import Thread

import pytest

from skevgp._progress import Monitor, Progress, monitor_of


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


def test_every_iteration_is_printed_if_asked_for_twice(capsys):
    progress = Progress(2)
    for number in range(1, 4):
        progress(number, 10.0 * number, range(0, 1))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in lines] == [
        ["iteration", str(number), "bound", f"{-10.0 * number:.3f}"] for number in (1, 2, 3)
    ]


def test_the_first_iteration_is_printed_at_once(capsys):
    progress = Progress(1)
    progress(1, 1.0, range(0, 1))
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_a_callback_is_told_the_bound():
    told = []
    monitor_of(0, lambda *what: told.append(what)).seen_as(outputs=range(0, 2)).iteration(4, -3.0)
    assert told == [(4, 3.0, range(0, 2))]


@pytest.mark.parametrize("verbose", [0, 2])
def test_both_are_served(verbose, capsys):
    told = []
    monitor_of(verbose, lambda *what: told.append(what)).iteration(1, 5.0)
    monitor_of(verbose).iteration(1, 5.0)
    assert len(told) == 1
    assert len(capsys.readouterr().out.splitlines()) == verbose
