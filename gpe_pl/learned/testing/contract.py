"""The contract of every model: symmetries, independence of bodies, degenerate input, gradients, settings. A check raises ``AssertionError`` if a model fails.

In a test of another package::

    from gpe_pl.learned.testing.contract import CHECKS, factory

    @pytest.mark.parametrize("check", CHECKS.values(), ids=CHECKS)
    def test_contract(check):
        check(factory(Net, hidden_channels=16))

``MESH_CHECKS`` are for models of graphs with meshes, ``elastic_contract.ELASTIC_CHECKS`` for those with an elastic law. In all checks, features are made in
single precision and models compute in double precision.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import Batch, HeteroData

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.standardizer import GraphStandardizer
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing import scenes
from gpe_pl.learned.testing.changes import in_order, permuted, to_dtype, turned
from gpe_pl.models.base import Model
from gpe_pl.schema import BOUNDARY, FeatureSpec
from gpe_pl.trajectory.state import State

Factory = Callable[[FeatureSpec], Model]
"""Makes a model in double precision; every call gives it the same weights."""
Check = Callable[[Factory], None]

TWO = ("sand", "snow")
WITH_MESH = ("sand", "elastomer")


def factory(model: type[Model], **settings: Any) -> Factory:
    """Return a ``Factory`` of a class with these settings."""

    def make(spec: FeatureSpec) -> Model:
        torch.manual_seed(0)
        return model(spec, **settings).double()

    return make


def predict(model: Model, data: HeteroData, num_nodes: int) -> Tensor:
    """Return predictions in the order of the state's nodes [node, dim]."""
    return in_order(model(data), data, num_nodes, model.spec.dim)


def check_relabelling(make: Factory, materials: tuple[str, ...]) -> None:
    """Check that relabelling the nodes relabels the prediction."""
    build, state = scenes.builder(materials), scenes.state(materials=materials)
    order = np.random.default_rng(1).permutation(state.num_nodes)
    model = make(build.spec)
    y = predict(model, _graph(build, state), state.num_nodes)
    _assert_close(predict(model, _graph(build, permuted(state, order)), state.num_nodes), y[order])


def check_edge_orientation(make: Factory) -> None:
    """Check that the order and the orientation of the edges do not matter."""
    build = scenes.builder(TWO)
    data = _graph(build, scenes.state(materials=TWO))
    model = make(build.spec)
    _assert_close(predict(model, turned(data, build.spec), 40), predict(model, data, 40))


def check_translation(make: Factory) -> None:
    """Check that the position of the scene does not matter."""
    build, state = scenes.builder(), scenes.state().to_torch()
    offset = torch.tensor([3.0, -2.0], dtype=torch.float64)
    moved = replace(state, pos=state.pos + offset, boundary=replace(state.boundary, pos=state.boundary.pos + offset))
    model = make(build.spec)
    y, z = (predict(model, to_dtype(build(s), torch.float64), 40) for s in (state, moved))
    _assert_close(z, y, 1e-5)  # features are float32


def check_batches(make: Factory) -> None:
    """Check that a batch gives the same predictions as its graphs alone, also if graphs lack some node types."""
    build = scenes.builder(TWO)
    states = [
        scenes.state(30, ("sand",), seed=1),
        scenes.state(20, ("snow",), seed=2),
        scenes.state(25, TWO, seed=3),
        scenes.state(10, ("snow",), seed=4, walls=False),
        scenes.state(1, ("sand",), seed=5),
    ]
    orders = ((0, 1, 2, 3, 4), (1, 0, 2, 4, 3), (2, 1, 0, 3, 4), (3, 4, 0, 1, 2), (4, 3, 2, 1, 0))
    _check_batches(make, build, states, orders)


def check_bodies_out_of_reach(make: Factory) -> None:
    """Check that bodies without edges between them do not influence each other."""
    build = scenes.builder()
    near, far = scenes.state(20, walls=False, seed=1), scenes.state(15, walls=False, seed=2)
    far = replace(far, pos=far.pos + 10.0)
    model = make(build.spec)
    alone = predict(model, _graph(build, near), 20)
    _assert_close(predict(model, _graph(build, State.joined([near, far])), 35)[:20], alone)


def check_degenerate_geometry(make: Factory, case: str) -> None:
    """Check that predictions and gradients are finite for coincident, isolated, single and resting nodes. Without nodes, there is no prediction."""
    build = scenes.builder()
    state = scenes.state({"one": 1, "two coincident at rest": 2, "none": 0}.get(case, 12), walls=case != "one")
    assert state.velocity_history is not None
    pos, past = state.pos.copy(), state.velocity_history.copy()
    if case == "coincident":
        pos[1:4] = pos[0]
    elif case == "isolated":
        pos[0] = 50.0
    elif case == "two coincident at rest":
        pos[1], past[:] = pos[0], 0.0
    state = replace(state, pos=pos, vel=past[:, -1], velocity_history=past)
    model = make(build.spec)
    out = model(_graph(build, state)).acceleration
    if case == "none":
        assert not out, "a prediction for a material without nodes"
        return
    assert torch.isfinite(out["sand"]).all(), "predictions are not finite"
    if not out["sand"].requires_grad:
        assert case == "one", "predictions do not depend on the weights"  # a model of forces has none between one node and nothing
        return
    out["sand"].square().sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None), "gradients are not finite"


def check_gradients(make: Factory) -> None:
    """Check that gradients with respect to features of nodes and edges equal finite differences."""
    build = scenes.builder()
    data = _graph(build, scenes.state(5, high=0.2, seed=3))
    model = make(build.spec)

    def f(x: Tensor, odd: Tensor) -> Tensor:
        d = data.clone()
        store = d["sand", "radius", "sand"]
        d["sand"].x, store.odd, store.offset = x, odd, odd[:, :2]
        return model(d).acceleration["sand"]

    x = data["sand"].x.clone().requires_grad_()
    odd = data["sand", "radius", "sand"].odd.clone().requires_grad_()
    assert odd.shape[0] > 0
    assert torch.autograd.gradcheck(f, (x, odd), eps=1e-7, atol=1e-6, fast_mode=True)


def check_every_parameter_is_used(make: Factory, may_be_unused: Collection[str] = ()) -> None:
    """Check that every parameter has a gradient, apart from those with one of the given texts in their name."""
    build = scenes.builder(TWO)
    model = make(build.spec)
    predicted = model(_graph(build, scenes.state(60, TWO))).acceleration
    torch.stack([v.square().sum() for v in predicted.values()]).sum().backward()
    unused = [n for n, p in model.named_parameters() if p.grad is None and not any(text in n for text in may_be_unused)]
    assert not unused, f"parameters without use: {', '.join(unused)}"


def check_settings(make: Factory) -> None:
    """Check that ``Model.settings`` rebuild the model, and that its weights fit the rebuilt model."""
    build = scenes.builder(TWO)
    model = make(build.spec)
    again = type(model)(build.spec, **model.settings).double()
    again.load_state_dict(model.state_dict())
    data = _graph(build, scenes.state(materials=TWO))
    assert torch.equal(predict(again, data, 40), predict(model, data, 40)), "the settings make another model"


def check_order_of_calls(make: Factory) -> None:
    """Check that a step does not depend on the steps before."""
    _check_order_of_calls(make, scenes.builder(), scenes.state(), scenes.state(seed=7))


def check_walls_without_features(make: Factory) -> None:
    """Check that walls are seen if their standardised features are 0, as those of still walls that differ in nothing are."""
    build = scenes.builder()
    data, empty = (_graph(build, scenes.state(walls=walls)) for walls in (True, False))
    data[BOUNDARY].x = torch.zeros_like(data[BOUNDARY].x)
    model = make(build.spec)
    with_walls, without = (predict(model, graph, 40) for graph in (data, empty))
    assert float((with_walls - without).norm()) > 1e-6 * float(without.norm()), "walls whose features are 0 change no prediction"


def check_features(make: Factory, features: str, history: int) -> None:
    """Check that the model takes its channel counts from the specification of the graphs."""
    build = scenes.builder(features=features, history=history)
    data = _graph(build, scenes.state(history=history))
    standardizer = GraphStandardizer(build.spec).double()
    standardizer.fit([data])
    out = make(build.spec)(standardizer(data)).acceleration["sand"]
    assert out.shape == (40, 2)
    assert torch.isfinite(out).all(), "predictions are not finite"


def check_mesh(make: Factory) -> None:
    """Check that relabelling the nodes of a mesh relabels the prediction, and that reversing edges changes nothing."""
    build, state = scenes.builder(WITH_MESH, mesh=True), scenes.mesh_state(materials=WITH_MESH)
    assert build.spec.num_levels > 1
    order = np.random.default_rng(1).permutation(state.num_nodes)
    model, data = make(build.spec), _graph(build, state)
    y = predict(model, data, state.num_nodes)
    relabelled = predict(model, _graph(build, permuted(state, order)), state.num_nodes)
    _assert_close(relabelled, y[order], 1e-5)  # features are float32, and means over children round by order
    _assert_close(predict(model, turned(data, build.spec), state.num_nodes), y)


def check_batches_of_meshes(make: Factory) -> None:
    """Check that a batch of scenes with and without a mesh gives the same predictions as its graphs alone."""
    build = scenes.builder(WITH_MESH, mesh=True)
    states = [
        scenes.mesh_state(materials=WITH_MESH),
        scenes.state(20, ("sand",), seed=2),
        scenes.mesh_state("lattice", WITH_MESH, seed=3),
    ]
    _check_batches(make, build, states, ((0, 1, 2), (1, 2, 0), (2, 0, 1)))


def check_order_of_calls_with_meshes(make: Factory) -> None:
    """Check that a step of a mesh does not depend on the steps before."""
    first, other = scenes.mesh_state(materials=WITH_MESH), scenes.mesh_state("lattice", WITH_MESH, seed=7)
    _check_order_of_calls(make, scenes.builder(WITH_MESH, mesh=True), first, other)


CHECKS: dict[str, Check] = {
    "relabelling": partial(check_relabelling, materials=("sand",)),
    "relabelling of two materials": partial(check_relabelling, materials=TWO),
    "edge orientation": check_edge_orientation,
    "translation": check_translation,
    "batches": check_batches,
    "bodies out of reach": check_bodies_out_of_reach,
    **{
        f"degenerate geometry: {case}": partial(check_degenerate_geometry, case=case)
        for case in ("coincident", "isolated", "one", "two coincident at rest", "none")
    },
    "gradients": check_gradients,
    "every parameter is used": check_every_parameter_is_used,
    "settings": check_settings,
    "order of calls": check_order_of_calls,
    "walls without features": check_walls_without_features,
    **{f"features: {f}, history {h}": partial(check_features, features=f, history=h) for f in ("paper", "contact") for h in (1, 3)},
}
"""Checks of all models by name."""

MESH_CHECKS: dict[str, Check] = {
    "mesh": check_mesh,
    "batches of meshes": check_batches_of_meshes,
    "order of calls with meshes": check_order_of_calls_with_meshes,
}
"""Further checks of models of graphs with meshes."""


def _graph(build: GraphBuilder, state: State) -> HeteroData:
    return to_dtype(build(state.to_torch()), torch.float64)


def _assert_close(a: Tensor, b: Tensor, tolerance: float = 1e-12) -> None:
    difference, size = float((a - b).norm()), float(b.norm())
    assert difference <= tolerance * size, f"predictions differ by {difference:.1e}, allowed are {tolerance:g} of {size:.1e}"


def _check_batches(make: Factory, build: GraphBuilder, states: list[State], orders: tuple[tuple[int, ...], ...]) -> None:
    count = len(build.metadata.param_names)
    states = [
        s if s.material_params.shape[1] == count else replace(s, material_params=np.repeat(s.material_params, count, axis=1))
        for s in states
    ]
    graphs = [_graph(build, s) for s in states]
    model = make(build.spec)
    singles = [predict(model, g, s.num_nodes) for g, s in zip(graphs, states, strict=True)]
    assert sum(float(y.norm()) for y in singles) > 0, "all predictions are zero"
    for order in orders:
        batch = Batch.from_data_list([graphs[k] for k in order])
        for material, value in model(batch).acceleration.items():
            for position, k in enumerate(order):
                rows, expected = batch[material].batch == position, singles[k][graphs[k][material].node_id]
                assert rows.sum() == len(expected)
                if len(expected):
                    _assert_close(value[rows], expected)


def _check_order_of_calls(make: Factory, build: GraphBuilder, state: State, other: State) -> None:
    simulator, start = LearnedSimulator(make(build.spec).float(), build), state.to_torch()
    first = simulator.step(start)
    simulator.step(other.to_torch())
    assert torch.equal(simulator.step(start).pos, first.pos), "a step depends on the steps before"
