"""A model of another package is configured, trained, stored, loaded and checked like one of this package."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.fit import fit
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.learned.testing.contract import CHECKS, factory
from gpe_pl.models.lookup import model_class
from tests import outside, scenes
from tests.runs import tiny

OUTSIDE = (
    "model=dpinet",
    "model._target_=outside_gpe.net.Net",
    "~model.num_propagation_steps",
    "~model.material_embedding",
    "graph.mesh=false",
)


@pytest.mark.slow
def test_it_trains_and_its_checkpoint_needs_the_package(tiny_data: Path, tmp_path: Path) -> None:
    with outside.installed(outside.write(tmp_path / "site")):
        fit(tiny(tiny_data, tmp_path / "runs", "data=sand", "name=outside", *OUTSIDE, "evaluation.splits=[test]"))
        loaded = LearnedSimulator.from_checkpoint(tmp_path / "runs" / "outside")
        assert type(loaded.model) is model_class("outside_gpe.net.Net")
        assert loaded.model.settings == {"hidden_channels": 8}
    with pytest.raises(CheckpointError, match=r"model 'outside_gpe.net.Net' is not one of gpe_pl.models") as caught:
        LearnedSimulator.from_checkpoint(tmp_path / "runs" / "outside")
    assert "\n" not in str(caught.value)


def test_a_checkpoint_imports_no_package_that_registers_nothing(tmp_path: Path) -> None:
    site = outside.write(tmp_path / "site")
    with outside.installed(site):
        build = scenes.builder()
        simulator = LearnedSimulator(model_class("outside_gpe.net.Net")(build.spec), build)
        type(simulator.model).__module__ = "hostile_gpe.net"
        simulator.save(tmp_path / "hostile.ckpt")
        with pytest.raises(CheckpointError, match="model 'hostile_gpe.net.Net' is not one of gpe_pl.models"):
            LearnedSimulator.from_checkpoint(tmp_path / "hostile.ckpt")
    assert not (site / "hostile_gpe" / "was_imported").exists()


def test_the_contract_can_be_checked_from_outside(tmp_path: Path) -> None:
    with outside.installed(outside.write(tmp_path / "site")):
        make = factory(model_class("outside_gpe.net.Net"), hidden_channels=4)
        for name, check in CHECKS.items():
            if name not in ("gradients", "walls without features"):  # need a model that reads edges
                check(make)
