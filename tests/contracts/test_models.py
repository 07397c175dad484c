"""The contract of every model: symmetries, independence, degenerate input, gradients. A new model joins with one line in ``MODELS``."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import Batch, HeteroData

from gpe_pl.benchmarks.stability.invariances import turned
from gpe_pl.benchmarks.stability.subject import in_order
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.standardizer import GraphStandardizer
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import FeatureSpec
from gpe_pl.trajectory.state import State
from tests import scenes

Factory = Callable[[FeatureSpec], Any]


def factory(model: Any, **settings: Any) -> Factory:
    def make(spec: FeatureSpec) -> torch.nn.Module:
        torch.manual_seed(0)
        return model(spec, **settings).double()

    return make


def gpe(**settings: Any) -> Factory:
    return factory(GPE, num_message_passing_steps=3, hidden_channels=16, **settings)


MODELS: dict[str, Factory] = {
    **{
        f"gpe-{i}-{d}-{e}": gpe(interaction=i, decoder=d, edge_state=e)
        for i, d, e in itertools.product(("directed", "negated", "odd", "odd_even"), ("node", "pair"), ("latent", "geometry"))
    },
    "gpe-mlp-embedding": gpe(material_embedding="mlp"),
    "gpe-plain": gpe(implementation="plain"),
    "gpe-linear": gpe(island_momentum="linear"),
    "gpe-angular": gpe(island_momentum="angular"),
    "gns": factory(GNS, num_message_passing_steps=3, hidden_channels=16),
    "dpinet": factory(DPINet, hidden_channels=16),
    "cconv": factory(ContinuousConvNet, hidden_channels=16),
}

TWO = ("sand", "snow")


USUAL = {
    "gpe-directed-node-latent", "gpe-negated-node-latent", "gpe-odd-pair-geometry", "gpe-odd_even-node-geometry", "gpe-angular", "gns", "dpinet", "cconv",
}  # fmt: skip
"""Combinations that cover every setting and every model once; the slow tests run all combinations."""


@pytest.fixture(params=[pytest.param(name, marks=() if name in USUAL else pytest.mark.slow, id=name) for name in MODELS])
def make(request: pytest.FixtureRequest) -> Factory:
    return MODELS[request.param]


def predict(model: Any, data: HeteroData, num_nodes: int) -> torch.Tensor:
    """Return predictions in the order of the state's nodes."""
    return in_order(model(data), data, num_nodes, model.spec.dim)


def assert_close(a: torch.Tensor, b: torch.Tensor, tolerance: float = 1e-12) -> None:
    assert (a - b).norm() <= tolerance * b.norm()


@pytest.mark.parametrize("materials", [("sand",), TWO])
def test_relabelling_the_nodes_relabels_the_output(make: Factory, materials: tuple[str, ...]) -> None:
    build = scenes.builder(materials)
    s = scenes.state(materials=materials)
    order = np.random.default_rng(1).permutation(s.num_nodes)
    model = make(build.spec)
    y = predict(model, scenes.to_dtype(build(s.to_torch()), torch.float64), s.num_nodes)
    z = predict(model, scenes.to_dtype(build(scenes.permuted(s, order).to_torch()), torch.float64), s.num_nodes)
    assert_close(z, y[order])


def test_edge_orientation_and_order_do_not_matter(make: Factory) -> None:
    build = scenes.builder(TWO)
    data = scenes.to_dtype(build(scenes.state(materials=TWO).to_torch()), torch.float64)
    model = make(build.spec)
    assert_close(predict(model, turned(data, build.spec), 40), predict(model, data, 40))


def test_translation_changes_nothing(make: Factory) -> None:
    build = scenes.builder()
    s = scenes.state().to_torch()
    offset = torch.tensor([3.0, -2.0], dtype=torch.float64)
    moved = replace(s, pos=s.pos + offset, boundary=replace(s.boundary, pos=s.boundary.pos + offset))
    model = make(build.spec)
    y = predict(model, scenes.to_dtype(build(s), torch.float64), 40)
    z = predict(model, scenes.to_dtype(build(moved), torch.float64), 40)
    assert_close(z, y, 1e-5)  # features are float32


def test_batch_equals_singles_whatever_types_are_present(make: Factory) -> None:
    build = scenes.builder(TWO)
    states = [
        scenes.state(30, ("sand",), seed=1),
        scenes.state(20, ("snow",), seed=2),
        scenes.state(25, TWO, seed=3),
        scenes.state(10, ("snow",), seed=4, walls=False),
        scenes.state(1, ("sand",), seed=5),
    ]
    states = [replace(s, material_params=_columns(s, len(build.metadata.param_names))) for s in states]
    graphs = [scenes.to_dtype(build(s.to_torch()), torch.float64) for s in states]
    model = make(build.spec)
    singles = [predict(model, g, s.num_nodes) for g, s in zip(graphs, states, strict=True)]
    for order in ((0, 1, 2, 3, 4), (1, 0, 2, 4, 3), (2, 1, 0, 3, 4), (3, 4, 0, 1, 2), (4, 3, 2, 1, 0)):
        batch = Batch.from_data_list([graphs[k] for k in order])
        out = model(batch).acceleration
        for material, value in out.items():
            owner = batch[material].batch
            for position, k in enumerate(order):
                rows = owner == position
                expected = singles[k][graphs[k][material].node_id]
                assert rows.sum() == len(expected)
                if len(expected):
                    assert_close(value[rows], expected)
    assert sum(float(y.norm()) for y in singles) > 0


def _columns(s: Any, count: int) -> np.ndarray:
    if s.material_params.shape[1] == count:
        return s.material_params
    return np.repeat(s.material_params, count, axis=1)


def test_bodies_out_of_reach_do_not_feel_each_other(make: Factory) -> None:
    build = scenes.builder()
    near, far = scenes.state(20, walls=False, seed=1), scenes.state(15, walls=False, seed=2)
    far = replace(far, pos=far.pos + 10.0)
    both = State.joined([near, far])
    model = make(build.spec)
    alone = predict(model, scenes.to_dtype(build(near.to_torch()), torch.float64), 20)
    together = predict(model, scenes.to_dtype(build(both.to_torch()), torch.float64), 35)
    assert_close(together[:20], alone)


@pytest.mark.parametrize("case", ["coincident", "isolated", "one", "two coincident at rest", "none"])
def test_degenerate_geometry_is_finite_with_finite_gradients(make: Factory, case: str) -> None:
    build = scenes.builder()
    s = scenes.state({"one": 1, "two coincident at rest": 2, "none": 0}.get(case, 12), walls=case != "one")
    assert s.velocity_history is not None
    pos, past = s.pos.copy(), s.velocity_history.copy()
    if case == "coincident":
        pos[1:4] = pos[0]
    elif case == "isolated":
        pos[0] = 50.0
    elif case == "two coincident at rest":
        pos[1], past[:] = pos[0], 0.0
    s = replace(s, pos=pos, vel=past[:, -1], velocity_history=past)
    data = scenes.to_dtype(build(s.to_torch()), torch.float64)
    model = make(build.spec)
    out = model(data).acceleration
    if case == "none":
        assert not out
        return
    assert torch.isfinite(out["sand"]).all()
    if not out["sand"].requires_grad:  # nobody exerts a force
        assert model.settings["decoder"] == "pair" and case == "one"
        return
    out["sand"].square().sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


def test_gradients_are_correct(make: Factory) -> None:
    build = scenes.builder()
    s = scenes.state(5, high=0.2, seed=3)
    data = scenes.to_dtype(build(s.to_torch()), torch.float64)
    model = make(build.spec)

    def f(x: torch.Tensor, odd: torch.Tensor) -> torch.Tensor:
        d = data.clone()
        store = d["sand", "radius", "sand"]
        d["sand"].x, store.odd, store.offset = x, odd, odd[:, :2]
        return model(d).acceleration["sand"]

    x = data["sand"].x.clone().requires_grad_()
    odd = data["sand", "radius", "sand"].odd.clone().requires_grad_()
    assert odd.shape[0] > 0
    assert torch.autograd.gradcheck(f, (x, odd), eps=1e-7, atol=1e-6, fast_mode=True)


def test_every_parameter_is_used(make: Factory) -> None:
    build = scenes.builder(TWO)
    data = scenes.to_dtype(build(scenes.state(60, TWO).to_torch()), torch.float64)
    model = make(build.spec)
    sum(v.square().sum() for v in model(data).acceleration.values()).backward()
    unused = [n for n, p in model.named_parameters() if p.grad is None]
    allowed = ("updates", "lin_even", "pair_decoder", "boundary")
    assert all(any(a in n for a in allowed) for n in unused), unused


def test_settings_rebuild_the_model(make: Factory) -> None:
    build = scenes.builder(TWO)
    model = make(build.spec)
    again = type(model)(build.spec, **model.settings).double()
    again.load_state_dict(model.state_dict())
    data = scenes.to_dtype(build(scenes.state(materials=TWO).to_torch()), torch.float64)
    assert torch.equal(predict(again, data, 40), predict(model, data, 40))


def test_a_step_is_independent_of_the_order_of_calls(make: Factory) -> None:
    build = scenes.builder()
    simulator = LearnedSimulator(make(build.spec).float(), build)
    s = scenes.state().to_torch()
    first = simulator.step(s)
    simulator.step(scenes.state(seed=7).to_torch())
    assert torch.equal(simulator.step(s).pos, first.pos)


@pytest.mark.parametrize("history", [1, 3])
@pytest.mark.parametrize("features", ["paper", "contact"])
def test_all_features_work(make: Factory, features: str, history: int) -> None:
    build = scenes.builder(features=features, history=history)
    assert build.config == GraphConfig(features=features, history=history, islands=True)  # type: ignore[arg-type]
    data = scenes.to_dtype(build(scenes.state(history=history).to_torch()), torch.float64)
    standardizer = GraphStandardizer(build.spec).double()
    standardizer.fit([data])
    out = make(build.spec)(standardizer(data)).acceleration["sand"]
    assert out.shape == (40, 2)
    assert torch.isfinite(out).all()


# --- meshes ---------------------------------------------------------------------------------------------------------------------------------

MESH = ("sand", "elastomer")


@pytest.fixture(params=["gpe-negated-node-latent", "gpe-odd-pair-geometry", "gpe-angular", "gns", "dpinet"])
def make_on_mesh(request: pytest.FixtureRequest) -> Factory:
    return MODELS[request.param]


def test_relabelling_and_turning_a_mesh_change_nothing(make_on_mesh: Factory) -> None:
    build = scenes.builder(MESH, mesh=True)
    assert build.spec.num_levels > 1
    s = scenes.mesh_state(materials=MESH)
    order = np.random.default_rng(1).permutation(s.num_nodes)
    model = make_on_mesh(build.spec)
    data = scenes.to_dtype(build(s.to_torch()), torch.float64)
    y = predict(model, data, s.num_nodes)
    relabelled = scenes.to_dtype(build(scenes.permuted(s, order).to_torch()), torch.float64)
    assert_close(predict(model, relabelled, s.num_nodes), y[order], 1e-5)  # features are float32, and means over children round by order
    assert_close(predict(model, turned(data, build.spec), s.num_nodes), y)


def test_batch_of_scenes_with_and_without_mesh_equals_singles(make_on_mesh: Factory) -> None:
    build = scenes.builder(MESH, mesh=True)
    sand = scenes.state(20, ("sand",), seed=2)
    states = [
        scenes.mesh_state(materials=MESH),
        replace(sand, material_params=_columns(sand, 2)),
        scenes.mesh_state("lattice", MESH, seed=3),
    ]
    graphs = [scenes.to_dtype(build(s.to_torch()), torch.float64) for s in states]
    model = make_on_mesh(build.spec)
    singles = [predict(model, g, s.num_nodes) for g, s in zip(graphs, states, strict=True)]
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        batch = Batch.from_data_list([graphs[k] for k in order])
        for material, value in model(batch).acceleration.items():
            for position, k in enumerate(order):
                expected = singles[k][graphs[k][material].node_id]
                rows = batch[material].batch == position
                assert rows.sum() == len(expected)
                if len(expected):
                    assert_close(value[rows], expected)


def test_a_step_of_a_mesh_is_independent_of_the_order_of_calls(make_on_mesh: Factory) -> None:
    build = scenes.builder(MESH, mesh=True)
    simulator = LearnedSimulator(make_on_mesh(build.spec).float(), build)
    s = scenes.mesh_state(materials=MESH).to_torch()
    first = simulator.step(s)
    simulator.step(scenes.mesh_state("lattice", MESH, seed=7).to_torch())
    assert torch.equal(simulator.step(s).pos, first.pos)
