"""Every experiment composes, has a unique name, and trains and evaluates on miniature data."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from gpe_pl.config.datasets import evaluated_config, scene_metadata
from gpe_pl.config.fit_run import FitRun
from gpe_pl.config.folder import CONF
from gpe_pl.evaluation.metric_rows import read_rows
from gpe_pl.files.run_folder import without_tables
from gpe_pl.fit import fit
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.transfer import start_from
from tests.runs import compose, first_choices, tiny

EXPERIMENTS = sorted(p.stem for p in (CONF / "experiment").glob("*.yaml"))
QUICK = {"smoke"}
"""Experiments that run with the fast tests."""
SLOW = {
    "ablation_momentum",
    "ladder",
    "table1",
    "table1_equal_steps",
    "unseen_materials",
}
"""Experiments that run with the slow tests; all others run with the long tests. The canyon is also trained and evaluated for its notebook."""
FEW_SHOT = ["start_from=null", "data.num_train=2", "data.num_frames=12", "evaluation.data.num_test=1", "evaluation.data.num_frames=12"]
SCALES = ["data.num_train=2", "data.num_val=1", "data.num_test=1", "data.num_frames=40", "evaluation.horizons=[0.02]"]
SHORT = {"stride": ["evaluation.start_time=0.025"], "scales": SCALES, "few_shot": FEW_SHOT, "few_shot_poisson": FEW_SHOT}
"""Overrides with which experiments fit miniature data."""
STARTING = ["channel", "few_shot", "few_shot_poisson"]
"""Experiments that start from a shipped model."""
TAKING_OVER = [e for e in EXPERIMENTS if "\nreuse: table1\n" in (CONF / "experiment" / f"{e}.yaml").read_text()]


def _mark(experiment: str) -> pytest.MarkDecorator:
    return pytest.mark.slow if experiment in SLOW else pytest.mark.long


def test_there_are_experiments() -> None:
    assert set(EXPERIMENTS) > SLOW | QUICK


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_states_its_own_name(experiment: str) -> None:
    assert compose("fit", f"experiment={experiment}").name == experiment


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "trained", "evaluated"),
    [
        (["experiment=few_shot"], "snow_few_12", "snow_few"),
        (["experiment=few_shot", "data=elastomer"], "elastomer_few_12", "elastomer_few"),
        (["experiment=few_shot", "data=fem", "adaptation=scratch_five_times"], "fem_few_60", "fem_few"),
        (["experiment=few_shot_poisson"], "elastomer_poisson_few_12", "elastomer_poisson_few"),
        (["experiment=scales", "scaling=general"], "sand_scales", "sand_scales"),
        (["experiment=scales", "data=snow", "scaling=specialist", "evaluation.data.spacing_factor=2.0"], *["snow_scales_spacing_2"] * 2),
    ],
)
def test_sets_of_an_experiment_are_named_after_their_data(overrides: list[str], trained: str, evaluated: str) -> None:
    cfg = compose("fit", *overrides)
    assert (cfg.data.name, evaluated_config(cfg).data.name) == (trained, evaluated)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("settings", ["experiment=table1", "experiment=tuning", "experiment=few_shot"])
def test_evaluated_scenes_are_not_those_of_the_run(settings: str, seed: int) -> None:
    cfg = compose("fit", settings, f"data.seed={seed}")
    assert evaluated_config(cfg).data.seed != cfg.data.seed


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [e if e in QUICK else pytest.param(e, marks=_mark(e)) for e in EXPERIMENTS])
def test_an_experiment_trains_and_evaluates(experiment: str, tiny_data: Path, tmp_path: Path) -> None:
    cfg = tiny(tiny_data, tmp_path, f"experiment={experiment}", *first_choices(experiment), *SHORT.get(experiment, []))
    value = fit(cfg)
    rows = list(read_rows(tmp_path / experiment / "metrics.csv"))
    assert {r.split for r in rows} == set(cfg.evaluation.splits)
    full = [
        r.value for r in rows if (r.model, r.split, r.metric, r.horizon) == ("learned", cfg.evaluation.splits[0], "rollout_mse", "full")
    ]
    assert value == pytest.approx(sum(full) / len(full))
    assert 0 < value < 10


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [pytest.param(e, marks=pytest.mark.long if e.startswith("tuning") else ()) for e in EXPERIMENTS])
def test_every_value_of_a_sweep_is_a_run_of_its_own(experiment: str) -> None:
    """An axis that changes nothing for some model would train the same thing twice and show it as two."""
    params: dict[str, Any] = compose("fit", f"experiment={experiment}", hydra_config=True).hydra.sweeper.params or {}
    if experiment == "search":
        pytest.skip("its values are proposed while it runs")
    axes = [[f"{key}={value}" for value in str(values).split(",")] for key, values in params.items() if key != "seed"]
    configs: list[Any] = [OmegaConf.to_container(compose("fit", f"experiment={experiment}", *o)) for o in product(*axes)]
    runs = [without_tables(config) for config in configs]
    kept = ("start_from", "data", "graph", "model", "training")
    done = [json.dumps({"on": run["evaluation"]["data"], **{key: run[key] for key in kept}}, sort_keys=True) for run in runs]
    assert len({*done}) == len(done)


@pytest.mark.slow
@pytest.mark.parametrize("experiment", STARTING)
def test_the_model_to_start_from_has_the_settings_of_the_experiment(experiment: str, caplog: pytest.LogCaptureFixture) -> None:
    """Tests with miniature data start from nothing, because a shipped model is too large for them."""
    params: dict[str, Any] = compose("fit", f"experiment={experiment}", hydra_config=True).hydra.sweeper.params or {}
    axes = [[f"{key}={value}" for value in str(values).split(",")] for key, values in params.items() if key != "seed"]
    num_started = 0
    for overrides in product(*axes):
        cfg = compose("fit", f"experiment={experiment}", *overrides)
        run = FitRun(cfg, CONF)
        if run.start is not None:
            builder = GraphBuilder(run.graph, scene_metadata(cfg, "train"))
            start_from(LearnedSimulator(run.new_model(spec=builder.spec), builder, run.stride), run.start)
            num_started += 1
    assert num_started and "other graphs" not in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("experiment", TAKING_OVER)
def test_what_takes_over_from_table_1_has_a_run_to_take(experiment: str) -> None:
    """One of its settings is trained as table 1 does."""
    params: dict[str, Any] = compose("fit", f"experiment={experiment}", hydra_config=True).hydra.sweeper.params or {}
    axes = [[f"{key}={value}" for value in str(values).split(",")] for key, values in params.items() if key != "seed"]
    found = False
    for overrides in product(*axes):
        cfg = compose("fit", f"experiment={experiment}", *overrides)
        domain = cfg.data.name
        model = {"GPE": "gpe_tuned", "GNS": "gns", "DPINet": "dpinet", "ContinuousConvNet": "cconv"}[cfg.model._target_.rpartition(".")[2]]
        there = compose("fit", "experiment=table1", f"data={domain}", f"model={model}")
        found |= all(cfg[key] == there[key] for key in ("size", "data", "graph", "model", "training"))
    assert found


@pytest.mark.slow
@pytest.mark.parametrize("size", ["tiny", "small", "paper"])
@pytest.mark.parametrize("domain", ["sand", "snow", "elastomer"])
def test_the_grid_sees_every_obstacle_of_larger_scenes(domain: str, size: str) -> None:
    """The thinnest are ramps four times as long as thick."""
    larger = compose("fit", "experiment=larger_scenes", f"data={domain}", f"size={size}").evaluation.data
    scene = OmegaConf.merge(compose("fit", f"data={domain}", f"size={size}").data.scene, larger.scene)
    assert 2 * scene.obstacle_radius[0] * np.sin(np.arctan2(1, 4)) >= scene.grid_spacing


@pytest.mark.slow
@pytest.mark.parametrize("model", ["gpe_tuned", "dpinet"])
def test_snow_on_liquid_trains_and_rolls_out(model: str, tiny_data: Path, tmp_path: Path) -> None:
    fit(tiny(tiny_data, tmp_path, "experiment=mixed_materials", "data=snow_on_liquid", f"model={model}", "evaluation.splits=[test_unseen]"))
    values = [r.value for r in read_rows(tmp_path / "mixed_materials" / "metrics.csv") if (r.model, r.metric) == ("learned", "rollout_mse")]
    assert values and all(0 < value < 10 for value in values)


def test_the_ablation_sweeps_every_interaction_over_seeds() -> None:
    hydra = compose("fit", "experiment=ablation_momentum", hydra_config=True).hydra
    assert hydra.mode.name == "MULTIRUN"
    assert hydra.sweeper.params["model.interaction"].split(",") == ["directed", "negated", "odd", "odd_even"]
    assert len(str(hydra.sweeper.params.seed).split(",")) >= 2


@pytest.mark.slow
@pytest.mark.parametrize(("choosing", "judging"), [("tuning_elastic", "table1"), ("tuning", "table1_equal_steps")])
def test_scenes_to_choose_by_are_neither_trained_on_nor_judged_on(choosing: str, judging: str) -> None:
    chosen, judged = (compose("fit", f"experiment={e}", "size=small", "data=elastomer") for e in (choosing, judging))
    sets = [chosen.data, chosen.evaluation.data, judged.evaluation.data]
    assert len({s.name for s in sets}) == len({s.seed for s in sets}) == 3
    assert (chosen.data.name, chosen.data.seed) == (judged.data.name, judged.data.seed)
    assert chosen.evaluation.splits == ["val"]
    assert chosen.evaluation.data.num_val > chosen.data.num_val


@pytest.mark.slow
def test_a_learned_stress_is_drawn_and_compared(tiny_data: Path, tmp_path: Path) -> None:
    cfg = tiny(tiny_data, tmp_path, "experiment=fem_stress", "evaluation.splits=[test]", "evaluation.num_pictures=1")
    fit(cfg)
    folder = tmp_path / "fem_stress"
    assert (folder / "stress_test_00.png").stat().st_size > 1000
    errors = [
        r.value for r in read_rows(folder / "metrics.csv") if (r.model, r.metric, r.horizon) == ("learned", "von_mises_error", "full")
    ]
    assert len(errors) == 1
    assert 0 < errors[0] < 100
