"""What is told while a fit runs, and how it is told to stop."""

import io
import re
import sys
from threading import Thread
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from skevgp.utils.monitor import Monitor, Progress


def heard():
    """A list, and a monitor that writes all that it is told into it."""
    told = []
    return told, Monitor(lambda *what: told.append(what))


def test_part_tells_in_the_units_and_numbers_of_the_whole():
    told, monitor = heard()
    monitor.seen_as(100, 2.0, 7.0, range(1, 3)).iteration(3, 5.0)
    assert told == [(103, 2.0 * 5.0 + 7.0, range(1, 3))]


# --- stopping ------------------------------------------------------------------------------------------------------


def test_ctrl_c_inside_ends_the_work_without_an_error():
    monitor, done = Monitor(), []
    with monitor.keeping_the_best():
        done.append("before")
        raise KeyboardInterrupt
    assert done == ["before"]
    assert monitor.stopped


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


# --- what the user sees --------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    """Of which the tests decide what it shows."""

    now = 100.0

    def __call__(self):
        return self.now


class Bar:
    """What is used of tqdm, as it is in a notebook: the texts that are shown."""

    made: ClassVar[list] = []

    def __init__(self, desc, **options):
        self.texts, self.disable, self.closed = [desc], False, False
        self.made.append(self)

    def set_description_str(self, desc, refresh):
        self.desc = desc

    def display(self):
        self.texts.append(self.desc)

    def close(self):
        self.closed = True


@pytest.fixture
def without_tqdm(monkeypatch):
    for name in ("tqdm", "tqdm.auto", "tqdm.asyncio"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def notebook(monkeypatch):
    """The bars of a notebook."""
    monkeypatch.setattr(Bar, "made", [])
    monkeypatch.setitem(sys.modules, "tqdm.auto", SimpleNamespace(tqdm=Bar))
    monkeypatch.setitem(sys.modules, "tqdm.asyncio", SimpleNamespace(tqdm=object))
    return Bar.made


def fit(progress, clock, losses, seconds=1.0, about=""):
    """Iterations that take so many seconds each."""
    monitor = Monitor(progress=progress).seen_as(about=about)
    for number, loss in enumerate(losses, 1):
        clock.now += seconds
        monitor.iteration(number, loss)


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_verbose_2_prints_each_iteration(stream):
    stream = stream()
    progress = Progress(2, stream)
    fit(progress, Clock(), [10.0, 20.0, 30.0])
    progress.close()
    lines = stream.getvalue().splitlines()
    assert [line.split()[:4] for line in lines] == [
        ["iteration", str(number), "bound", f"{-10.0 * number:.3f}"] for number in (1, 2, 3)
    ]


def test_on_a_terminal_tqdm_draws_one_line():
    pytest.importorskip("tqdm")
    clock, terminal = Clock(), Terminal()
    progress = Progress(1, terminal, clock)
    fit(progress, clock, [1234.0, 5.0], about="y[:, 2]")
    assert "\n" not in terminal.getvalue()
    progress.close()
    _, first, *_, last = terminal.getvalue().split("\r")
    assert first.rstrip() == "y[:, 2], iteration 1, bound -1234.000, 1 s"
    assert last.rstrip(" \n") == "y[:, 2], iteration 2, bound -5.000, 2 s"
    assert last.endswith("\n")


def test_models_fitted_side_by_side_share_a_bar(notebook):
    """A line is about the model that has just had an iteration."""
    clock = Clock()
    progress = Progress(1, io.StringIO(), clock)
    monitor = Monitor(progress=progress)

    def work(output):
        part = monitor.seen_as(about=f"y[:, {output}]")
        for number in range(1, 51):
            clock.now += 1.0
            part.iteration(number, 0.0)

    threads = [Thread(target=work, args=(output,)) for output in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    progress.close()
    (bar,) = notebook
    for output in range(4):
        numbers = [int(re.search(r"iteration (\d+)", text)[1]) for text in bar.texts if f"y[:, {output}]" in text]
        assert numbers == sorted(numbers)
        assert numbers


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_without_tqdm_there_is_a_line_each_ten_seconds_and_the_last(without_tqdm, stream):
    clock, stream = Clock(), stream()
    progress = Progress(1, stream, clock)
    fit(progress, clock, np.ones(25), about="all rows")
    progress.close()
    progress.close()
    assert stream.getvalue().splitlines() == [
        f"all rows, iteration {number}, bound -1.000, {number} s" for number in (10, 20, 25)
    ]


def test_part_of_the_fit_is_told():
    clock, log = Clock(), io.StringIO()
    monitor = Monitor(progress=Progress(1, log, clock)).seen_as(about="y[:, 2]").seen_as(about="50 of 90 rows")
    clock.now += 10.0
    monitor.iteration(3, 2.0)
    clock.now += 10.0
    monitor.silent().iteration(4, 2.0)
    assert log.getvalue() == "y[:, 2], 50 of 90 rows, iteration 3, bound -2.000, 10 s\n"
