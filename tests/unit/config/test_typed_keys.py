"""Unknown keys on the command line are refused beside any experiment, comparison and recipe."""

from __future__ import annotations

import re
from itertools import product
from typing import Any

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

import gpe_pl.config.entry_point  # noqa: F401 registers plugins and resolvers that files in conf/ use
from gpe_pl.config.folder import CONF
from gpe_pl.config.typed_keys import axes_of, without_effect
from gpe_pl.files.run_folder import without_tables

EXPERIMENTS = sorted(p.stem for p in (CONF / "experiment").glob("*.yaml") if p.stem != "search")  # that proposes its values while it runs


def unresolved(*overrides: str, hydra_config: bool = False, command: str = "fit") -> DictConfig:
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra.compose(command, [*overrides], return_hydra_config=hydra_config)


def axes(*overrides: str) -> Any:
    """What the experiment sweeps, unresolved."""
    return axes_of(unresolved(*overrides, hydra_config=True).hydra)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beside", "typed", "because"),
    [
        ("experiment=table1", "training.num_steps=77", "training.budget_minutes=0.5"),
        ("batching=by_nodes", "training.batch_size=4", "batching.max_nodes=20000"),
        ("recipe=paper", "training.warmup_steps=10", "training.schedule=exponential"),
        ("recipe=paper", "training.push_correction=0.2", "training.push_fraction=0.0"),
        ("data=fem", "training.push_correction=0.7", "training.targets=solver"),
        ("data=fem", "training.noise_correction=0.7", "training.targets=solver"),
        ("model=gns", "graph.num_levels=2", "graph.mesh=False"),
        ("model=gpe", "model.wall_damping=0.3", "model.wall_layer=0.0"),
        ("data=imported", "dimension=3", "data.size=imported"),
        ("model=gns", "size.comparison.budget_minutes=3", "no other setting"),
        ("experiment=table1", "size.comparison.tuning_minutes=3", "no other setting"),
        ("experiment=smoke", "size.num_steps=500", "no other setting"),
        ("model=cconv", "size.num_message_passing_steps=9", "no other setting"),
        ("model=gpe", "+size.channels=9", "no other setting"),
        ("data=fluid", "data.sizes.tiny.d2.num_particles=9", "no other setting"),  # another dimension
        ("data=fluid", "data.dimensions.d2.gravity=[0.0,-1.6]", "no other setting"),
        ("data=fluid", "data.bounds.d2=[[0.0,2.0],[0.0,1.0]]", "no other setting"),
        ("data=sand", "data.sizes.small.num_train=9", "no other setting"),  # another size
        ("experiment=few_shot", "data.sizes.small.num_train=24", "no other setting"),  # the experiment has its own number
        ("experiment=table1", "+evaluation.data.sizes.tiny.num_test_unseen=40", "no other setting"),
        ("experiment=table1", "data.larger.scene.max_bodies=3", "no other setting"),
        ("data=sand", "data.larger.scene.bounds=[[0,3],[0,1]]", "no other setting"),  # only other entries of the table take it
        ("experiment=table1", "size.num_steps=9", "no other setting"),  # only training.num_steps takes it, which a time budget replaces
        ("experiment=table1", "size={num_steps: 9}", "no other setting"),
        ("data.scene.grid_spacing=0.02", "data.spacing_factor=0.5", "no other setting"),  # only the name of the data would contain it
        ("experiment=table1", "training={num_steps: 9}", "training.budget_minutes=0.5"),
    ],
)
def test_what_nothing_reads_is_refused(beside: str, typed: str, because: str) -> None:
    refusal = without_effect(unresolved(beside, typed), [beside, typed])
    entry = re.sub(r"={(\w+): (.*)}", r".\1=\2", typed.lstrip("+"))  # of a table
    assert refusal.startswith(f"{entry}: has no effect") and because in refusal


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "choice", "typed"),
    [
        ("few_shot", "adaptation=zero_shot", "training.num_steps=3000"),
        ("few_shot", "adaptation=scratch", "start_from=mine"),
        ("few_shot_poisson", "adaptation=scratch_five_times", "data.num_train=24"),
        ("few_shot", "adaptation=whole", "training.early_layers=2"),
        ("few_shot", "adaptation=early_layers", "training={early_layers: 2}"),
        ("scales", "scaling=general", "graph.scales=dimensional"),
        ("scales", "scaling=without_features", "data.scales=null"),
        ("scales", "scaling=without_features", "data.scales={strides: [1]}"),  # which the file that it builds on sets
        ("scales", "scaling=specialist", "data.spacing_factor=2"),
    ],
)
def test_what_a_swept_choice_is_defined_by_cannot_be_typed(experiment: str, choice: str, typed: str) -> None:
    overrides = [f"experiment={experiment}", choice, typed]
    refusal = without_effect(unresolved(*overrides), overrides, axes(*overrides))
    assert f": {choice} sets this key itself" in refusal and refusal.startswith(typed.partition("=")[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "choice", "typed"),
    [
        ("few_shot", "adaptation=whole", "training.num_steps=3000"),  # which zero_shot sets
        ("few_shot", "adaptation=early_layers", "start_from=mine"),
        ("few_shot", "adaptation=scratch_five_times", "data=elastomer"),
        ("table1", "model=gns", "model.hidden_channels=7"),  # a group with a key of its own
        ("table1", "data=sand", "training.budget_minutes=3"),
    ],
)
def test_what_a_swept_choice_leaves_open_can_be_typed(experiment: str, choice: str, typed: str) -> None:
    overrides = [f"experiment={experiment}", choice, typed]
    assert without_effect(unresolved(*overrides), overrides, axes(*overrides)) == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "is_read"), [("table1", True), ("ablation_momentum", False), ("few_shot", False), ("tuning", False)]
)
def test_seeds_of_a_size_are_refused_where_no_axis_takes_them(experiment: str, is_read: bool) -> None:
    typed = [f"experiment={experiment}", "size.comparison.seeds='0,1,2'"]
    refusal = without_effect(unresolved(*typed), typed, axes(*typed))
    assert (refusal == "") == is_read and (is_read or refusal.startswith(f"{typed[1]}: has no effect"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "beside", "typed", "because"),
    [
        ("fit", "evaluation.containment=false", "evaluation.num_uncontained=3", "with evaluation.containment=False"),
        ("fit", "data=sand", "data.scales={strides: [1]}", ""),
        ("evaluate", "data=sand", "data.scales={strides: [1]}", "because this command has no graph.scales"),
        ("simulate", "data=sand", "data.scales={strides: [1]}", "because this command has no graph.scales"),
        ("evaluate", "data=sand", "rollout.rest_step_spacings=0.5", "with rollout.sleep_after=null"),
        ("evaluate", "data=sand", "rollout.rest_step_change_spacings=0.5", "with rollout.sleep_after=null"),
        ("evaluate", "rollout.sleep_after=9", "rollout.rest_step_spacings=0.5", ""),
        ("simulate", "data=sand", "active.num_candidates=50", "with active.models=null"),
        ("simulate", "data=sand", "active.horizon=0.1", "with active.models=null"),
        ("simulate", "active.models=[a,b]", "active.horizon=0.1", ""),
    ],
)
def test_what_a_switched_off_part_of_a_command_would_read_is_refused(command: str, beside: str, typed: str, because: str) -> None:
    refusal = without_effect(unresolved(beside, typed, command=command), [beside, typed])
    assert because in refusal and refusal.startswith(typed.partition("=")[0] if because else "") and bool(refusal) == bool(because)


def test_what_only_unread_keys_read_is_refused() -> None:
    law, typed = ("data=elastomer", "model=gpe_tuned", "law=elastic"), "model.wall_damping=0.3"
    assert without_effect(unresolved(*law, typed), [typed]) == ""
    refusal = without_effect(unresolved(*law, typed, "model.elastic=false"), [typed])
    assert refusal == "model.wall_damping=0.3: has no effect with model.elastic=False; leave out one of the two"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("data=fem", "model=gpe_tuned", "law=elastic", "recipe=paper"),
            "law=elastic: recipe=paper sets graph.islands=False instead of True",
        ),
        (
            ("data=elastomer", "model=gpe", "law=elastic", "recipe=paper"),
            "law=elastic: recipe=paper sets graph.islands=False instead of True",
        ),
        (("data=fem", "model=gpe_tuned", "law=none", "recipe=paper"), ""),
        (("data=fem", "model=gpe_tuned", "law=elastic"), ""),
        (("experiment=elastic_bodies", "recipe=paper"), ""),
    ],
)
def test_a_typed_law_that_the_recipe_switches_off_is_refused(overrides: tuple[str, ...], message: str) -> None:
    refusal = without_effect(unresolved(*overrides), overrides)
    assert refusal.startswith(message) and bool(refusal) == bool(message)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beside", "typed"),
    [
        ("recipe=paper", "training.warmup_steps=0"),
        ("experiment=table1", "size.comparison.budget_minutes=3"),
        ("experiment=larger_scenes", "data.larger.solver.bounds=[[0,3],[0,1]]"),
        ("experiment=larger_scenes", "data.larger.scene.bounds=[[0,3],[0,1]]"),
        ("experiment=larger_scenes", "data.larger.scene.max_bodies=3"),
        ("experiment=larger_scenes", "data.sizes.tiny.larger_num_particles=99"),
        ("data=fluid", "data.sizes.tiny.d3.num_particles=9"),
        ("data=fluid", "data.dimensions.d3.gravity=[0.0,0.0,-1.6]"),
        ("data=fluid", "data.bounds.d3=[[0,2],[0,1],[0,1]]"),
        ("data=fluid", "data.default_dimension=2"),
        ("data=sand", "data.variant=d3"),
        ("data=sand", "data.spacing_factor=0.5"),
        ("data.scene.grid_spacing=0.02", "+evaluation.data.spacing_factor=0.5"),  # half of the typed spacing
        ("data=fluid", "data.suffix=_mine"),
        ("model=gpe", "training.num_steps=77"),
        ("model=gpe", "size.num_steps=77"),
        ("model=gns", "size.hidden_channels=77"),
        ("model=gpe", "graph.num_levels=2"),
        ("experiment=tuning_push", "training.push_correction=0.2"),
    ],
)
def test_what_is_read_is_not(beside: str, typed: str) -> None:
    assert without_effect(unresolved(beside, typed), [beside, typed]) == ""


@pytest.mark.long
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_with_the_papers_recipe_too_an_axis_changes_something_or_is_refused(experiment: str) -> None:
    params: dict[str, Any] = unresolved(f"experiment={experiment}", hydra_config=True).hydra.sweeper.params or {}
    axes = [[f"{key}={value}" for value in str(values).split(",")] for key, values in params.items() if key != "seed"]
    runs = []
    for overrides in product(*axes):
        cfg = unresolved(f"experiment={experiment}", "recipe=paper", *overrides)
        if not without_effect(cfg, overrides):
            values: Any = OmegaConf.to_container(cfg, resolve=True)
            kept = without_tables(values)
            runs.append(
                [kept[key] for key in ("data", "graph", "model", "training")] + [values["start_from"], values["evaluation"].get("data")]
            )
    assert all(run not in runs[:k] for k, run in enumerate(runs))


def commands_of_suites() -> list[tuple[str, list[str]]]:
    """Return the commands that suites run themselves, with their overrides."""
    faults, sets, adaptation = (OmegaConf.load(CONF / "suite" / f"{name}.yaml") for name in ("faults", "learning_sets", "adaptation"))
    data = [*faults.data]
    found = [(name, data + [a for a in faults.commands[name].arguments if "{" not in a]) for name in ("simulate", "fit")]
    imported = ["data=imported", "data.name=own"]
    found += [("fit", [*imported, *own, "training.budget_minutes=10"]) for own in sets.training.values()]
    return found + [
        ("fit", [*imported, *own.training, "training.num_steps=9", "training.learning_rate=1e-3"]) for own in adaptation.engines.values()
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("command", "overrides"), commands_of_suites(), ids=lambda v: v if isinstance(v, str) else "")
def test_commands_of_suites_are_not_refused(command: str, overrides: list[str]) -> None:
    assert without_effect(unresolved(*overrides, command=command), overrides) == ""
