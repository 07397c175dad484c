"""The base class of all models."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from torch_geometric.data import HeteroData

from gpe_pl.models.base import Model, Prediction
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.skips import Skips
from tests import scenes


@pytest.mark.parametrize("model", [GPE, GNS])
def test_settings_are_all_keyword_arguments(model: type[Model]) -> None:
    spec = scenes.builder().spec
    made = model(spec, hidden_channels=8)
    assert made.spec is spec
    assert made.settings["hidden_channels"] == 8
    assert model(spec, **made.settings).settings == made.settings


def test_skips_of_one_model_are_not_those_of_another() -> None:
    one, other = (GNS(scenes.builder().spec, hidden_channels=8) for _ in range(2))
    one.skips = replace(one.skips, stress=True)
    assert other.skips == Skips()


def test_a_model_without_reach_cannot_be_built() -> None:
    class Without(Model):
        def forward(self, data: HeteroData) -> Prediction:
            return Prediction({})

    unfinished: Any = Without
    with pytest.raises(TypeError, match="num_hops"):
        unfinished(scenes.builder().spec)
