"""The contract of every model of the package (``gpe_pl.learned.testing``). A new model joins by one line in ``MODELS``."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch

from gpe_pl.learned.testing import scenes
from gpe_pl.learned.testing.changes import to_dtype
from gpe_pl.learned.testing.contract import CHECKS, MESH_CHECKS, Check, Factory, check_every_parameter_is_used, factory, predict
from gpe_pl.learned.testing.elastic_contract import ELASTIC_CHECKS
from gpe_pl.models.base import Model, Prediction
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE


def gpe(**settings: Any) -> Factory:
    return factory(GPE, num_message_passing_steps=3, hidden_channels=16, **settings)


BASELINES: dict[str, type[Model]] = {"gns": GNS, "dpinet": DPINet, "cconv": ContinuousConvNet}

MODELS: dict[str, Factory] = {
    **{
        f"gpe-{i}-{d}-{e}": gpe(interaction=i, decoder=d, edge_state=e)
        for i, d, e in itertools.product(("directed", "negated", "odd", "odd_even"), ("node", "pair"), ("latent", "geometry"))
    },
    "gpe-mlp-embedding": gpe(material_embedding="mlp"),
    "gpe-no-embedding": gpe(material_embedding="none"),
    "gpe-plain": gpe(implementation="plain"),
    "gpe-linear": gpe(island_momentum="linear"),
    "gpe-angular": gpe(island_momentum="angular"),
    "gns": factory(GNS, num_message_passing_steps=3, hidden_channels=16),
    "dpinet": factory(DPINet, hidden_channels=16),
    "cconv": factory(ContinuousConvNet, hidden_channels=16),
    **{f"{name}-no-embedding": factory(model, hidden_channels=16, material_embedding="none") for name, model in BASELINES.items()},
}

USUAL = {
    "gpe-directed-node-latent", "gpe-negated-node-latent", "gpe-odd-pair-geometry", "gpe-odd_even-node-geometry", "gpe-angular", "gns", "dpinet", "cconv",
}  # fmt: skip
"""Combinations that cover every setting and every model once; the long tests run all combinations."""
ON_MESHES = ("gpe-negated-node-latent", "gpe-odd-pair-geometry", "gpe-angular", "gns", "dpinet")
MAY_BE_UNUSED = ("updates", "lin_even", "pair_decoder", "boundary")


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in USUAL else pytest.mark.long) for name in MODELS])
@pytest.mark.parametrize("check", CHECKS)
def test_contract(check: str, name: str) -> None:
    if CHECKS[check] is check_every_parameter_is_used:
        check_every_parameter_is_used(MODELS[name], MAY_BE_UNUSED)
    else:
        CHECKS[check](MODELS[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_MESHES)
@pytest.mark.parametrize("check", MESH_CHECKS)
def test_contract_on_meshes(check: str, name: str) -> None:
    MESH_CHECKS[check](MODELS[name])


@pytest.mark.parametrize("check", ELASTIC_CHECKS)
def test_contract_of_elastic_models(check: str) -> None:
    ELASTIC_CHECKS[check](gpe(elastic=True, stress=True))


@pytest.mark.parametrize("name", ["gpe", *BASELINES])
def test_only_models_without_embedding_ignore_the_parameter(name: str) -> None:
    build, state = scenes.builder(("sand", "snow")), scenes.state(materials=("sand", "snow")).to_torch()
    other = replace(state, material_params=1.5 * state.material_params)
    for key, reads in ((f"{name}-no-embedding", False), ("gpe-mlp-embedding" if name == "gpe" else name, True)):
        model = MODELS[key](build.spec)
        predicted, with_other = (predict(model, to_dtype(build(s), torch.float64), 40) for s in (state, other))
        assert (float((predicted - with_other).norm()) > 1e-6) == reads


class Faulty(GNS):
    """A model whose first node gets more than the others, and which counts its calls."""

    def forward(self, data: Any) -> Prediction:
        self.num_calls = getattr(self, "num_calls", 0) + 1
        acceleration = super().forward(data).acceleration
        weight = {m: torch.arange(len(a), dtype=a.dtype)[:, None] == 0 for m, a in acceleration.items()}
        return Prediction({m: a * (1 + self.num_calls * weight[m]) for m, a in acceleration.items()})


@pytest.mark.parametrize("check", ["relabelling", "translation", "batches", "order of calls"])
def test_a_faulty_model_breaks_the_contract(check: str) -> None:
    faulty: Check = CHECKS[check]
    with pytest.raises(AssertionError):
        faulty(factory(Faulty, num_message_passing_steps=1, hidden_channels=8))


def test_factories_repeat_weights() -> None:
    one, other = (MODELS["gns"](scenes.builder().spec) for _ in range(2))
    assert isinstance(one, Model)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
