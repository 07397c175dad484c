"""Alternatives are timed in turns, each in a separate process."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from gpe_pl.system.timing import apart, paired_times


def noting(file: Path) -> Callable[[], None]:
    """Return a function that records the process in which it runs."""
    with file.open("a") as handle:
        handle.write(f"made {os.getpid()}\n")

    def note() -> None:
        with file.open("a") as handle:
            handle.write(f"called {os.getpid()}\n")

    return note


def failing() -> Callable[[], None]:
    def fail() -> None:
        raise ValueError("on purpose")

    return fail


def unmade() -> Callable[[], None]:
    raise ValueError("on purpose")


@pytest.mark.slow
def test_each_alternative_is_made_once_in_a_process_of_its_own_and_called_there(tmp_path: Path) -> None:
    files = {name: tmp_path / name for name in ("a", "b")}
    with apart({name: partial(noting, file) for name, file in files.items()}) as calls:
        times = paired_times(calls, num_rounds=2, num_warmups=1)
        lines = {name: file.read_text().split("\n") for name, file in files.items()}
    pids = {name: line[0].removeprefix("made ") for name, line in lines.items()}
    assert all(line == [f"made {pids[name]}", *[f"called {pids[name]}"] * 3, ""] for name, line in lines.items())
    assert len({*pids.values(), str(os.getpid())}) == 3
    assert all(len(t) == 2 for t in times.values())


def adding(number: int) -> Callable[[int], int]:
    return lambda other: number + other


@pytest.mark.slow
@pytest.mark.parametrize("modules", [[], [__name__]])
def test_arguments_go_to_the_process_and_results_come_back(modules: list[str]) -> None:
    with apart({"sum": partial(adding, 3)}, modules) as calls:
        assert [calls["sum"](4), calls["sum"](-3)] == [7, 0]


@pytest.mark.slow
@pytest.mark.parametrize("factory", [failing, unmade])
def test_an_alternative_that_fails_is_named(factory: Callable[[], Callable[[], None]]) -> None:
    with pytest.raises(RuntimeError, match="broken: its process ended"), apart({"broken": factory}) as calls:
        calls["broken"]()
    with pytest.raises(RuntimeError, match="broken"), apart({"broken": failing}) as calls:
        with pytest.raises(RuntimeError):
            calls["broken"]()
        calls["broken"]()
