"""Errors cross process boundaries with their message and their attributes. Otherwise a pool of workers breaks, and nobody sees the message."""

from __future__ import annotations

import importlib
import pickle
import pkgutil
from pathlib import Path
from typing import Any

import pytest

import gpe_pl
from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import FullDiskError
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.scenes.scene import SceneFault
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.store import UnsoundError

EXAMPLES = [
    UnsoundError("a.h5:00000", "not finite"),
    SceneFault({"box": "too large", "": "no walls"}),
    ArrayError("pos: wrong", 3),
    SimulationError("node 3 is gone", reason="input", node=3),
    FullDiskError(Path("a.h5"), "no space"),
]


def subclasses(kind: type[Any]) -> set[type[Any]]:
    return {kind, *(found for each in kind.__subclasses__() for found in subclasses(each))}


@pytest.mark.parametrize("error", EXAMPLES, ids=lambda error: type(error).__name__)
def test_an_error_with_its_own_arguments_can_be_pickled(error: GpeError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)


def test_all_errors_can_be_pickled() -> None:
    for module in pkgutil.walk_packages(gpe_pl.__path__, "gpe_pl."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    kinds = [kind for kind in subclasses(GpeError) if kind.__module__.startswith("gpe_pl")]
    assert len(kinds) > 50
    for kind in kinds:
        error: Any = kind.__new__(kind, "message")
        error.frame = 3
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is kind
        assert (str(again), again.frame) == (str(error), 3)
