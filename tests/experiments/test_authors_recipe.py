"""``recipe=authors`` gives the settings that the authors of each baseline state, in any experiment, and refuses other models."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.config.entry_point import ConfigError, construct, explain
from gpe_pl.config.entry_point import compose as composed
from gpe_pl.data.generation import generate
from gpe_pl.fit import fit
from gpe_pl.training.run import TrainingSettings
from tests.runs import DATA, RUN, compose

BASELINES = ("gns", "dpinet", "cconv")
DOMAINS = ("sand", "snow", "elastomer", "fluid", "fem")
DEPTH = {"gns": ("num_message_passing_steps", 10, 128), "dpinet": ("num_propagation_steps", 2, 200), "cconv": ("num_convolutions", 4, 64)}


def check(model: str, data: str, *overrides: str) -> None:
    cfg = compose("fit", *overrides, "recipe=authors", f"model={model}", f"data={data}")
    training = construct(TrainingSettings, cfg.training, "training")
    depth, number, width = DEPTH[model]
    assert (cfg.model[depth], cfg.model.hidden_channels) == (number, width)
    assert training.gradient_clip is None and training.ema_decay is None and training.push_forward is None
    assert (training.sampling, training.targets, training.noise.position_of_domain) == ("uniform", "trajectory", 0.0)
    assert cfg.graph.features == "paper" and not cfg.evaluation.containment
    rates = training.schedule, training.learning_rate, training.final_learning_rate
    loss = training.unroll_steps, training.loss, training.neighbor_weight
    if model == "gns":
        assert (rates, training.batch_size, loss) == (("exponential", 1e-4, 1e-6), 2, (None, "square", None))
        assert (cfg.graph.history, training.noise.velocity_of_change, training.noise.correction) == (
            5,
            9.0 if data == "fluid" else 2.4,
            0.0,
        )
    elif model == "dpinet":
        assert (rates, training.batch_size, loss) == (("exponential", 1e-4, 1e-4), 2, (None, "square", None))
        assert cfg.graph.history == (4 if data in ("elastomer", "fem") else 1) and not training.noise.is_any
    else:
        assert (rates, training.batch_size, loss) == (("staircase", 1e-3, 1e-3 / 32), 16, (2, "root", 1.0))
        assert (cfg.graph.history, cfg.graph.connectivity_spacings) == (1, 2.25) and not training.noise.is_any


@pytest.mark.slow
@pytest.mark.parametrize("model", BASELINES)
def test_the_recipe_wins_over_a_comparison(model: str) -> None:
    check(model, "elastomer", "experiment=table1", "size=small")


@pytest.mark.slow
@pytest.mark.parametrize("data", DOMAINS)
@pytest.mark.parametrize("model", BASELINES)
def test_the_recipe_wins_in_every_domain(model: str, data: str) -> None:
    for size in ("tiny", "small", "paper"):
        check(model, data, "experiment=table1_equal_steps", f"size={size}")


def test_a_model_without_a_recipe_is_refused() -> None:
    for overrides in (["recipe=authors"], ["experiment=table1", "recipe=authors", "model=gpe_tuned"]):
        with pytest.raises(ConfigError, match=r"^recipe=authors is for model=gns, model=dpinet and model=cconv; .*models$"):
            composed("fit", overrides)
    assert explain(ConfigError("other"), "fit", []) == "other"


@pytest.mark.parametrize("data", DOMAINS)
@pytest.mark.long
def test_every_row_of_table_1_trains(tmp_path: Path, data: str) -> None:
    small = [each for each in DATA if "num_particles" not in each]
    generate(tmp_path / "data", dataset_spec(compose("simulate", *small, f"data={data}")), 1)
    paths = [
        f"paths.data={tmp_path / 'data'}",
        f"paths.runs={tmp_path}",
        f"name={data}",
        "evaluation.data=null",
        "evaluation.material_controls=false",
    ]
    short = [each for each in RUN if not each.startswith(("size.", "graph.", "training.num_steps", "training.val_interval"))]
    for model in BASELINES:
        cfg = compose("fit", *small, *short, *paths, "experiment=table1", "recipe=authors", f"data={data}", f"model={model}",
                      "training.budget_minutes=null", "training.num_steps=2", "training.val_interval=1", f"name={data}_{model}")  # fmt: skip
        assert fit(cfg) > 0
