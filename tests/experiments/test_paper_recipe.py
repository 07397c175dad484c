"""``recipe=paper`` gives the settings of the paper, in any experiment or comparison."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from gpe_pl.config.datasets import scene_metadata
from gpe_pl.config.entry_point import construct
from gpe_pl.config.folder import CONF
from gpe_pl.training.run import TrainingSettings
from tests.runs import compose

EXPERIMENTS = sorted(p.stem for p in (CONF / "experiment").glob("*.yaml"))
DOMAINS = ("sand", "snow", "elastomer", "fluid", "fem", "mixed", "snow_on_liquid")


def swept(experiment: str) -> list[tuple[str, ...]]:
    """Return overrides for every model and every data set that an experiment sweeps over."""
    written: Any = OmegaConf.load(CONF / "experiment" / f"{experiment}.yaml")
    params = OmegaConf.select(written, "hydra.sweeper.params") or {}
    return list(product(*([f"{key}={value}" for value in str(params[key]).split(",")] for key in ("data", "model") if key in params)))


def assert_is_the_papers(cfg: DictConfig) -> None:
    training = construct(TrainingSettings, cfg.training, "training")
    assert (training.learning_rate, training.final_learning_rate, training.schedule) == (5e-5, 1e-6, "exponential")
    assert training.gradient_clip is None and training.ema_decay is None
    assert training.push_forward is None and training.sampling == "uniform"  # the plain one-step error, every window alike
    assert not training.val_containment and not cfg.evaluation.containment
    noise = training.noise
    assert 5e-5 <= noise.position_of_domain <= 1e-2 and noise.velocity_of_change == noise.correction == 0
    noise.check(scene_metadata(cfg, "train"))
    graph = cfg.graph
    assert (graph.features, graph.history, graph.connectivity_spacings, graph.boundary_condition) == ("paper", 1, None, False)
    assert graph.parameter_scale == "linear"
    model = {key: value for key, value in cfg.model.items() if key != "_target_"}
    assert model["hidden_channels"] == 128
    assert model.get("num_message_passing_steps", 12) == 12
    if cfg.model._target_ == "gpe_pl.models.gpe.GPE":
        assert (model["interaction"], model["decoder"], model["edge_state"]) == ("negated", "node", "latent")
        assert (model["level_weights"], model["node_norm"]) == ("separate", "none")
        assert (model["material_embedding"], model["island_momentum"], model["elastic"]) == ("affine", "ignored", False)


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS[::4])  # the next test has all of them
def test_the_recipe_wins_over_an_experiment(experiment: str) -> None:
    assert_is_the_papers(compose("fit", f"experiment={experiment}", "recipe=paper", "size=paper", *swept(experiment)[0]))


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [pytest.param(e, marks=pytest.mark.long if e.startswith("tuning") else ()) for e in EXPERIMENTS])
def test_the_recipe_wins_for_every_model_and_data_set(experiment: str) -> None:
    for overrides in swept(experiment):
        assert_is_the_papers(compose("fit", "recipe=paper", f"experiment={experiment}", "size=paper", *overrides))


@pytest.mark.slow
@pytest.mark.parametrize("comparison", sorted(p.stem for p in (CONF / "comparison").glob("*.yaml")))
def test_the_recipe_wins_over_a_comparison(comparison: str) -> None:
    assert_is_the_papers(compose("fit", f"comparison={comparison}", "recipe=paper", "size=small", "model=gpe_tuned"))


@pytest.mark.slow
@pytest.mark.parametrize("domain", DOMAINS)
def test_each_domain_has_one_noise_at_all_sizes(domain: str) -> None:
    configs = [compose("fit", f"data={domain}", "recipe=paper", f"size={size}") for size in ("tiny", "small", "paper")]
    assert len({cfg.training.position_noise_of_domain for cfg in configs}) == 1
    assert_is_the_papers(configs[1])


def test_the_recipe_leaves_the_budget_of_a_comparison_and_what_is_typed() -> None:
    cfg = compose("fit", "experiment=table1", "recipe=paper", "training.learning_rate=1e-4", "graph.boundary_condition=true")
    assert cfg.training.budget_minutes == cfg.size.comparison.budget_minutes
    assert (cfg.training.learning_rate, cfg.graph.boundary_condition) == (1e-4, True)
