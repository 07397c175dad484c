"""The benchmark of skipping adds irrelevant parts to a scene, and nothing else."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from gpe_pl.benchmarks import skip
from gpe_pl.benchmarks.skip import Settings, absent_material_calls, growths, message_passing_calls, run, scene_of, simulator
from gpe_pl.config.folder import CONF
from gpe_pl.learned.approximate import approximate

TINY = Settings(40, 150, 2, 8, ["latent"], num_boundary=[30], num_falling=[10], num_settled=[2], repeats=[3], num_rounds=1)


def test_the_config_has_the_settings() -> None:
    values: Any = OmegaConf.to_container(OmegaConf.load(CONF / "suite" / "skip.yaml"))
    assert values.pop("name") == "skip" and values.pop("accelerator") == "${trainer.accelerator}"
    assert Settings(**values).num_boundary[-1] == 50_000


@pytest.mark.parametrize("metric", ["distant_boundary_overhead", "falling_overhead", "absent_materials_overhead", "settled_overhead"])
def test_what_is_added_does_not_change_the_scene(metric: str) -> None:
    builder, scene = scene_of(TINY)
    (growth,) = (g for g in growths(TINY, builder, scene) if g.metric == metric)
    alone = simulator(TINY, "latent", builder, growth.off).step(scene)
    for skips in (growth.on, growth.off):
        if metric != "absent_materials_overhead":  # its model is another one
            grown = approximate(simulator(TINY, "latent", growth.builder, skips)).step(growth.state)
            torch.testing.assert_close(grown.pos[: scene.num_nodes], alone.pos, rtol=0, atol=1e-9)
    added = growth.state.num_nodes - scene.num_nodes + len(growth.state.boundary.pos)
    assert added == {"distant": 30, "falling": 10, "absent": 0, "settled": 80}[metric.partition("_")[0]]


def test_settled_piles_sleep() -> None:
    builder, scene = scene_of(TINY)
    growth = growths(TINY, builder, scene)[-1]
    step = skip._step(approximate(simulator(TINY, "latent", growth.builder, growth.on)), growth.state)
    assert step().num_asleep == 80


def test_falling_nodes_call_no_message_passing() -> None:
    builder, scene = scene_of(TINY)
    on, off = (message_passing_calls(TINY, builder, scene, skip.Skips(isolated_nodes=level)) for level in (True, False))
    assert on == 0 and off == TINY.num_message_passing_steps


def test_absent_materials_call_nothing_of_theirs() -> None:
    on, off = (absent_material_calls(TINY, skip.Skips(absent_types=level)) for level in (True, False))
    assert on == 0 and off > 0


@pytest.mark.slow
def test_the_table_has_a_row_per_growth() -> None:
    records, table = run(TINY)
    assert {r["metric"] for r in records} >= {
        "distant_boundary_overhead",
        "falling_overhead",
        "absent_materials_overhead",
        "settled_overhead",
    }
    assert all(r["value"] > 0 for r in records if r["metric"] == "step_time")
    assert table.count("| latent |") == 4 and "alone calls 0 layers" in table
    assert [r["case"] for r in records if r["metric"] == "repeat_time_ratio"] == ["3 frames, latent"] and "3 frames, latent" in table
