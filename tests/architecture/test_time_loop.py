"""The documentation says that one loop advances scenes in time: ``rollout.loop.step_scenes``."""

from __future__ import annotations

import ast
from pathlib import Path

import gpe_pl

PACKAGE = Path(gpe_pl.__file__).parent
STEPS = ("step", "step_all", "next_states")
CALLS = tuple(f".{name}(" for name in STEPS)


def loops_over_time(source: str) -> list[int]:
    """Lines of loops that replace a state by what a simulator made of it."""
    found: list[int] = []
    if not any(call in source for call in CALLS):  # to parse every file takes a second
        return found
    for loop in ast.walk(ast.parse(source)):
        if not isinstance(loop, ast.For | ast.While):
            continue
        for node in ast.walk(loop):
            if isinstance(node, ast.Assign):
                targets = {n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)}
                values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
                calls = [v for v in values if isinstance(v, ast.Call) and isinstance(v.func, ast.Attribute) and v.func.attr in STEPS]
                if any(isinstance(arg, ast.Name) and arg.id in targets for call in calls for arg in call.args):
                    found.append(loop.lineno)
    return found


def test_a_loop_over_time_is_found() -> None:
    assert loops_over_time("for _ in range(3):\n    state = solver.step(state)") == [1]
    assert loops_over_time("while True:\n    a, b = s.step(a), s.step(b)") == [1]
    assert loops_over_time("for state in states:\n    after = solver.step(state)") == []


def test_there_is_one_time_loop() -> None:
    others = {path.relative_to(PACKAGE): lines for path in PACKAGE.rglob("*.py") if (lines := loops_over_time(path.read_text()))}
    assert others == {}
