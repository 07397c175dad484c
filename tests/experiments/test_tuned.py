"""Tuned values stand as plain numbers in files named after the choices that they are for, and a run uses them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from gpe_pl.config.folder import CONF
from tests.runs import compose

ALWAYS = sorted(path for group in ("training", "model") for path in (CONF / group).glob("data*/*.yaml"))
COMPARED = sorted((CONF / "tuned").glob("*/*.yaml"))
USED = {"sand_gns", "fem_gns", "mixed_gpe_tuned", "small_fluid_gns"}
"""Files of these choices are tested with the fast tests."""


def choices(path: Path) -> dict[str, str]:
    """The choices that a file is named after, by group."""
    left, found = f"{path.stem.removeprefix('compared_')}_", {}
    for group in ("size", "data", "model"):
        names = sorted((p.stem for p in (CONF / group).glob("*.yaml")), key=len, reverse=True)
        if name := next((n for n in names if left.startswith(f"{n}_")), None):
            found[group], left = name, left.removeprefix(f"{name}_")
    assert not left, f"{path}: {left} is no choice"
    return found


def leaves(values: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


@pytest.mark.parametrize("path", [*ALWAYS, *COMPARED], ids=lambda p: p.stem)
def test_values_are_plain_and_files_are_named_after_choices(path: Path) -> None:
    assert "${" not in path.read_text()
    groups = {"data", "model"} if path.parent.parent.name == "model" else set(path.parent.name.split("_"))
    assert choices(path).keys() == groups


def _param(path: Path) -> Any:
    return pytest.param(path, marks=() if "_".join(choices(path).values()) in USED else pytest.mark.slow, id=path.stem)


@pytest.mark.slow
@pytest.mark.parametrize("path", [_param(path) for path in (*ALWAYS, *COMPARED)])
def test_a_run_uses_the_values(path: Path) -> None:
    chosen = choices(path)
    others = {"data": "mixed", "model": "gpe" if path.parent.name == "size" else "dpinet", "size": "tiny"}  # without files of their own
    more = ["comparison=equal_steps"] if path in COMPARED else []
    if chosen.get("data") == "imported":
        more.append("data.name=mine")
    cfg = compose("fit", *more, *(f"{group}={name}" for group, name in {**others, **chosen}.items()))
    for key, value in leaves(OmegaConf.to_container(OmegaConf.load(path))):  # type: ignore[arg-type]
        assert OmegaConf.select(cfg, key) == value, key


@pytest.mark.slow
@pytest.mark.parametrize(("data", "model", "law", "is_elastic"), [
    ("fem", "gpe_tuned", "by_data", True),
    ("fem", "gpe_tuned", "none", False),
    ("fem", "gpe", "by_data", False),
    ("elastomer", "gpe_tuned", "by_data", False),
    ("elastomer", "gpe_tuned", "elastic", True),
    ("elastomer", "gpe", "elastic", True),
])  # fmt: skip
def test_a_law_sets_model_graph_and_training_together(data: str, model: str, law: str, is_elastic: bool) -> None:
    cfg = compose("fit", f"data={data}", f"model={model}", f"law={law}", "comparison=equal_steps")
    expected = {"graph.cells": True, "model.elastic": True}
    if is_elastic:
        expected = dict(leaves(OmegaConf.to_container(OmegaConf.load(CONF / "law" / "elastic.yaml"))))  # type: ignore[arg-type]
    found = {key: OmegaConf.select(cfg, key) == value for key, value in expected.items()}
    assert set(found.values()) == {is_elastic}, found
    assert is_elastic or cfg.training.push_fraction > 0
    of_grid = (data, model, law) == ("elastomer", "gpe_tuned", "elastic")
    assert (cfg.training.loss, cfg.model.wall_layer, cfg.model.only_contacts, cfg.model.viscous) == (
        ("log", 2.0, True, False) if of_grid else ("square", 0.0, False, True)
    )


@pytest.mark.slow
def test_the_law_of_elastomers_holds_beside_other_materials_too() -> None:
    alone, mixed = (compose("fit", f"data={data}", "model=gpe_tuned", "law=elastic") for data in ("elastomer", "mixed"))
    assert mixed.model == alone.model and mixed.training.loss == alone.training.loss
    usual = compose("fit", "data=mixed", "model=gpe_tuned", "law=none").training
    for key in ("velocity_noise_of_change", "push_fraction"):  # sand and snow need both
        assert (mixed.training[key], alone.training[key]) == (usual[key], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [
    ("recipe=paper", "model=gpe"), ("recipe=authors", "model=gns"), ("comparison=equal_time", "model=gpe_tuned", "size=tiny"),
])  # fmt: skip
def test_liquids_in_channels_have_the_values_of_liquids(settings: tuple[str, ...]) -> None:
    closed, channel = (compose("fit", f"data={data}", *settings) for data in ("fluid", "channel"))
    for key in ("training.velocity_noise_of_change", "training.position_noise_of_domain", "graph.connectivity_spacings"):
        assert OmegaConf.select(closed, key) == OmegaConf.select(channel, key), key


WITH_LAW = {"elastic_bodies", "fem_stress", "unseen_materials", "mixed_materials", "sand", "smoke", "few_shot_poisson"}
"""Experiments that leave the law of solids on, or adapt a shipped model that has it. All others compare models or parts of the network."""
OF_PARTICLES = {"canyon", "scales"}
"""Experiments whose data cannot be solids."""


@pytest.mark.slow
@pytest.mark.parametrize("experiment", sorted(p.stem for p in (CONF / "experiment").glob("*.yaml") if p.stem not in OF_PARTICLES))
def test_comparisons_of_models_and_ablations_of_the_network_have_no_law(experiment: str) -> None:
    cfg = compose("fit", f"experiment={experiment}", "data=fem", "model=gpe_tuned")
    assert (cfg.model.elastic, cfg.graph.cells) == (experiment in WITH_LAW,) * 2
