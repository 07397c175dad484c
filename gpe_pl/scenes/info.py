"""Command ``gpe info MODEL``: what a model is, its trained ranges, its accuracy, and its speed here."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.errors.printable import did_you_mean
from gpe_pl.learned.pretrained import checkpoint_path, names
from gpe_pl.system.command_line import ArgumentFault, command, truth

if TYPE_CHECKING:
    from gpe_pl.learned.simulator import LearnedSimulator

ABOUT = """Say what a model is, what it was trained for, how accurate it is, and how fast it is here: gpe info [MODEL] [KEY=VALUE …]

  gpe info               the shipped models
  gpe info sand          one of them
  gpe info runs/mine     a run of yours, or the path of a checkpoint

Settings (default)
  speed    measure the time of a step on this machine (true)
  card     print the whole model card, with the errors on test scenes (false)"""

KEYS: dict[str, Callable[[str], Any]] = {"speed": truth, "card": truth}
NUM_STEPS = 20
"""Number of steps that are timed, after one that is not."""


def described(model: str) -> Iterator[str]:
    """Yield the lines of ``gpe info`` about a model, except those about its card and speed.

    Raises:
        CheckpointError: the model cannot be loaded.
    """
    from gpe_pl.learned import verdicts
    from gpe_pl.learned.simulator import LearnedSimulator

    path = checkpoint_path(model)
    simulator = LearnedSimulator.from_checkpoint(path)
    own, graph = simulator.builder.metadata, simulator.builder.config
    yield f"{model}: {verdicts.headline(path)}"
    yield f"file: {path} ({path.stat().st_size / 1e6:.1f} MB)"
    count = sum(p.numel() for p in simulator.model.parameters())
    yield f"model: {type(simulator.model).__name__} with {count:,} parameters, for {', '.join(own.materials)} in {own.dim}D; data set {own.dataset}"
    yield (
        f"scale: frames of {own.frame_dt * 1e3:g} ms, nodes {own.spacing:.4g} m apart, radius {simulator.builder.scales.radius:.4g} m, "
        f"history of {graph.history} frames"
    )
    settings = ", ".join(f"{key}={value}" for key, value in simulator.model.settings.items())
    yield f"settings: {settings}; static_friction={simulator.static_friction:g}, least_distance={simulator.least_distance:.4g} m"
    yield "trained ranges (outside of them, a rollout warns):"
    yield from (f"  {name}: {values}" for name, values in simulator.described_training())
    suites: tuple[verdicts.Suite, ...] = ("acceptance", "stability")
    for suite in suites:
        result = verdicts.path_beside(path, suite)
        if not result.exists():
            yield f"{suite}: not measured; `gpe benchmark suite={suite} suite.checkpoints=[{model}]` measures it"
            continue
        checks = verdicts.read(result).checks
        yield f"{suite}: {sum(check.passed for check in checks)} of {len(checks)} checks passed"
        yield from (f"  {check}" for check in checks)


def speed(simulator: LearnedSimulator) -> str:
    """Return the median time of a step here, in a scene like those of the training.

    Raises:
        NotRecorded: the model was trained on data that this package did not simulate.
    """
    import torch

    from gpe_pl.rollout.loop import steps
    from gpe_pl.scenes.recorded import recorded_scene
    from gpe_pl.scenes.rollouts import middle_values

    own = simulator.builder.metadata
    state = simulator.standing(recorded_scene(own).sample(middle_values(simulator), 0), own)
    times = [time.perf_counter() for _ in steps(simulator, state, NUM_STEPS + 1)]
    step = statistics.median(b - a for a, b in itertools.pairwise(times))
    pace = own.frame_dt / step
    compared = f"{pace:.2g} times as fast as real time" if pace >= 1 else f"{1 / pace:.2g} times slower than real time"
    return f"{1e3 * step:.3g} ms for a frame of {state.num_nodes} nodes, {compared} (median of {NUM_STEPS} steps, {torch.get_num_threads()} threads)"


def run(model: str | None, values: dict[str, Any]) -> None:
    """Print what is known of a model, or of all shipped models."""
    from gpe_pl.learned.simulator import LearnedSimulator
    from gpe_pl.learned.verdicts import headline
    from gpe_pl.scenes.recorded import NotRecorded

    if model is None:
        for name in names():
            print(f"{name}: {headline(name)}")
        print("`gpe info MODEL` says more of a model; also of a run of yours, by its folder")
        return
    if not (model in names() or Path(model).exists()):
        raise ArgumentFault(
            f"gpe info {model}: no such model{did_you_mean(model, names())}; name a shipped model ({', '.join(names())}) or the folder of a run"
        )
    for line in described(model):
        print(line)
    card = checkpoint_path(model).with_suffix(".md")
    if card.exists():
        print(f"card: {card}")
        if values.get("card", False):
            print(f"\n{card.read_text(encoding='utf-8')}")
    if values.get("speed", True):
        try:
            print(f"speed here: {speed(LearnedSimulator.from_checkpoint(model))}", flush=True)
        except NotRecorded as fault:
            print(f"speed: not measured; {fault}")


main = command(run, ABOUT, "model", KEYS)

if __name__ == "__main__":
    main()
