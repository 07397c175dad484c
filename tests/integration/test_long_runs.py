"""Long runs: memory does not grow, results do not change, and nothing is compiled again."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.fit import fit
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import Start, frames
from gpe_pl.system.machine import resident_bytes
from gpe_pl.training.module import TrainingModule
from gpe_pl.trajectory.state import State
from tests import scenes
from tests.runs import tiny

MEBIBYTE = 2**20


def simulator(**settings: Any) -> LearnedSimulator:
    """Return a small untrained model whose accelerations are small enough for a long rollout."""
    torch.manual_seed(0)
    build = scenes.builder()
    made = LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, **settings), build).eval()
    made.acceleration_std.fill_(1.0)
    return made


def start(num_nodes: int = 20) -> State:
    state = scenes.state(num_nodes).to_torch()
    still = torch.zeros_like(state.vel)
    return replace(state, vel=still, velocity_history=still[:, None])


def test_two_rollouts_are_equal_bit_for_bit() -> None:
    ends = []
    for _ in range(2):
        runner = Contained(simulator(edge_state="geometry", island_momentum="angular"), scenes.metadata().frame_dt)
        state = start()
        for _ in range(30):
            state = runner.step(state)
        ends.append((state.pos.numpy().tobytes(), state.vel.numpy().tobytes()))
    assert ends[0] == ends[1]


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell how much memory is in use")
def test_memory_of_10000_steps_is_flat() -> None:
    about = scenes.metadata()
    used: list[int] = []
    edges: set[int] = set()
    runner = simulator()
    for _, frame, state in frames(Contained(runner, about.frame_dt), [Start(start(), 10_000, about, None)]):
        assert isinstance(state, State)
        if frame % 100 == 0:
            used.append(resident_bytes())
            edges.add(sum(runner.builder(state)[r].edge_index.shape[1] for r in runner.builder.spec.relations))
    assert len(used) == 100
    assert len(edges) > 3
    assert max(used[20:]) - max(used[:20]) < 2 * MEBIBYTE, [u // 1024 for u in used]


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell how much memory is in use")
def test_memory_of_20_epochs_is_flat(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    windows_per_epoch = 2 * (12 - 2 - 1)  # trajectories of 12 frames with a history of 2
    per_epoch = windows_per_epoch // 2
    used: list[int] = []
    plain = TrainingModule.training_step

    def training_step(self: TrainingModule, batch: Any, batch_idx: int) -> Any:
        if self.global_step % per_epoch == 0:
            used.append(resident_bytes())
        return plain(self, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", training_step)
    steps = 20 * per_epoch
    fit(tiny(tiny_data, tmp_path, f"training.num_steps={steps}", f"training.val_interval={steps // 5}", "training.warmup_steps=2"))
    assert len(used) == 20
    assert max(used[10:]) - max(used[:10]) < 4 * MEBIBYTE, [u // 1024 for u in used]


def compilations() -> dict[str, int]:
    """Count the compiled graphs in a rollout, and in a training with different numbers of edges; also count these numbers."""
    from torch._dynamo.utils import counters

    learned = simulator()
    module = TrainingModule(learned, 50, 1e-3, compile="on")
    seen = set()
    with module.compiled():
        state = start(40)
        for _ in range(10):
            state = learned.step(state)
        in_rollout = counters["stats"]["unique_graphs"]
        for seed in range(20):
            graph = learned.builder(scenes.state(20 + 7 * seed, seed=seed).to_torch())
            graph["sand"].target = torch.zeros(graph["sand"].num_nodes, 2)
            seen.add(graph["sand", "radius", "sand"].edge_index.shape[1])
            module.loss(graph).backward()
    return {"rollout": in_rollout, "training": counters["stats"]["unique_graphs"], "edges": len(seen)}


@pytest.mark.long
def test_changing_numbers_of_edges_compile_at_most_three_times_again() -> None:
    """Rollouts compile nothing; training, where it compiles, meets as many edges as there are batches."""
    code = "import json; from tests.integration.test_long_runs import compilations; print(json.dumps(compilations()))"
    ended = subprocess.run(  # checks of types at run time, which the tests do, cannot be compiled
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True
    )
    found = json.loads(ended.stdout.splitlines()[-1])
    assert found["rollout"] == 0
    assert found["edges"] > 15
    assert 1 <= found["training"] <= 4


@pytest.mark.slow
def test_two_runs_train_the_same_weights(tiny_data: Path, tmp_path: Path) -> None:
    ends = []
    for name in ("one", "two"):
        cfg = tiny(tiny_data, tmp_path, f"name={name}", "training.num_steps=3", "training.val_interval=3")
        fit(cfg)
        stored = torch.load(tmp_path / name / "checkpoints" / "last.ckpt", weights_only=True)
        ends.append(
            {k: v.numpy().tobytes() for k, v in stored["state_dict"].items()} | {"metrics": (tmp_path / name / "metrics.csv").read_bytes()}
        )
    assert ends[0] == ends[1]
    assert len(ends[0]) > 5
    assert np.all([len(v) > 0 for v in ends[0].values()])
