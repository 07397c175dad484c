"""The compiled network gives the results of PyTorch's operations, for every option, and gives way where it cannot."""

from __future__ import annotations

import copy
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models import gpe_program_runner
from gpe_pl.models.base import Prediction
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.blocks import MLP
from gpe_pl.nn.fused import unfused
from gpe_pl.rollout.skips import Skips
from gpe_pl.training.optimizer import OnePassAdam
from tests import meshes, scenes
from tests.guarded_memory import guarded

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
INTERACTIONS = ("directed", "negated", "odd", "odd_even")
VARIANTS: list[dict[str, Any]] = [
    *({"interaction": interaction, "edge_state": state} for interaction in INTERACTIONS for state in ("latent", "geometry")),
    *({"interaction": interaction, "decoder": "pair"} for interaction in INTERACTIONS),
    {"node_norm": "layer"},
    {"node_norm": "layer", "edge_state": "geometry", "island_momentum": "linear"},
    {"island_momentum": "angular", "edge_state": "geometry"},
    {"material_embedding": "mlp"},
    {"material_embedding": "none"},
    {"level_weights": "separate"},
    {"level_weights": "separate", "interaction": "odd_even"},
    {"num_message_passing_steps": 1},
]


def build(spec: Any, dtype: torch.dtype = torch.float64, **variant: Any) -> GPE:
    torch.manual_seed(0)
    model = GPE(spec, **{"num_message_passing_steps": 3, "hidden_channels": 8, **variant}).to(dtype).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))  # no bias is zero and no norm the identity
    return model


def compiled(model: GPE, data: HeteroData) -> Prediction:
    """Return the prediction of the compiled network; fails if PyTorch's operations take over, or if it leaves its memory."""
    model._uncompiled = None  # type: ignore[assignment,method-assign]
    try:
        with torch.inference_mode():
            with guarded() as runs:
                expected = model(data)
            found = model(data)
    finally:
        del model._uncompiled
    assert len(runs) == 1
    for values, others in ((found.acceleration, expected.acceleration), (found.stress, expected.stress)):
        for material, a in values.items():
            largest = float(others[material].abs().max()) if a.numel() else 0.0
            torch.testing.assert_close(a, others[material], rtol=0, atol=TOLERANCE[a.dtype] * largest)
    return found


def assert_equal(model: GPE, data: HeteroData) -> None:
    dtype = next(model.parameters()).dtype
    found = compiled(model, data)
    with torch.inference_mode(), unfused():
        expected = model(data)
    for a, b in ((found.acceleration, expected.acceleration), (found.stress, expected.stress)):
        assert a.keys() == b.keys()
        for material in a:
            assert a[material].shape == b[material].shape and a[material].dtype is dtype
            scale = b[material].abs().max() if b[material].numel() else 1.0
            assert torch.allclose(a[material], b[material], rtol=0.0, atol=TOLERANCE[dtype] * float(scale)), material


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_particles(variant: dict[str, Any], dtype: torch.dtype) -> None:
    assert_equal(build(scenes.builder(("sand", "snow")).spec, dtype, **variant), scenes.graph(("sand", "snow"), dtype))


@pytest.mark.parametrize("variant", [v for v in VARIANTS if "island_momentum" not in v], ids=str)
def test_meshes_with_virtual_nodes(variant: dict[str, Any]) -> None:
    assert_equal(build(meshes.spec(3), **variant), meshes.graph(3))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
@pytest.mark.parametrize("interaction", INTERACTIONS)
def test_contacts_of_bodies(interaction: str, kind: str) -> None:
    dim, materials = (3 if kind == "tetrahedra" else 2), ("solid", "elastomer", "sand")
    builder = scenes.builder(materials, dim, mesh=True)
    data = scenes.to_dtype(builder(scenes.mesh_state(kind, materials, num_bodies=4, gap=0.5).to_torch()), torch.float64)
    (between,) = (r for r in builder.spec.relations if r[1] == "radius" and {r[0], r[2]} == {"solid", "elastomer"})
    assert data[between].edge_index.shape[1]
    settings: dict[str, Any] = {"decoder": "contact", "island_momentum": "angular", "stress": True, "interaction": interaction}
    assert_equal(build(builder.spec, **settings), data)


def scattered(num_alone: int = 7, materials: tuple[str, ...] = ("sand", "snow", "fluid")) -> HeteroData:
    """Return a graph in which some nodes are far from everything, and of whose materials the last is absent."""
    state = scenes.state(50, materials[:-1], seed=3)
    pos = state.pos.copy()
    pos[:num_alone] += 5.0 * torch.arange(1, num_alone + 1).numpy()[:, None]
    padded = torch.full((50, len(scenes.metadata(materials).param_names)), torch.nan).double().numpy()
    padded[:, : state.material_params.shape[1]] = state.material_params
    return scenes.to_dtype(scenes.builder(materials)(replace(state, pos=pos, material_params=padded).to_torch()), torch.float64)


@pytest.mark.slow
@pytest.mark.parametrize(
    "skips", [Skips(), Skips(isolated_nodes=False), Skips(absent_types=False), Skips(sorted_from=1), Skips(edges_at_once=5)], ids=str
)
@pytest.mark.parametrize("decoder", ["node", "pair"])
@pytest.mark.parametrize("num_alone", [7, 50])
def test_absent_materials_and_isolated_nodes(num_alone: int, decoder: str, skips: Skips) -> None:
    model = build(scenes.builder(("sand", "snow", "fluid")).spec, decoder=decoder, node_norm="layer")
    model.skips = skips
    assert_equal(model, scattered(num_alone))


def test_stress_only_where_it_is_wanted() -> None:
    builder = scenes.builder(("solid",), mesh=True)
    data = scenes.to_dtype(builder(scenes.mesh_state(materials=("solid",)).to_torch()), torch.float64)
    model = build(builder.spec, stress=True)
    assert_equal(model, data)
    model.skips = Skips(stress=True)
    assert not compiled(model, data).stress


def test_batches() -> None:
    graphs = [scenes.graph(("sand", "snow"), seed=k, num_nodes=10 + 20 * k) for k in range(3)]
    assert_equal(build(scenes.builder(("sand", "snow")).spec, island_momentum="angular"), batched(graphs))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("num_nodes", [0, 1, 2, 255, 257, 5000])
def test_sizes(num_nodes: int, dtype: torch.dtype) -> None:
    """Blocks have up to 256 rows; graphs of 5,000 nodes are sorted."""
    data = scenes.graph(("sand",), dtype, num_nodes=num_nodes, high=0.05 * max(num_nodes, 4) ** 0.5)
    for settings in ({"edge_state": "geometry"}, {"edge_state": "latent", "hidden_channels": 33}):
        assert_equal(build(scenes.builder().spec, dtype, num_message_passing_steps=2, **settings), data)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("threads", [1, 2])
def test_graphs_that_grow_and_shrink(threads: int, dtype: torch.dtype) -> None:
    """One model keeps its memory between graphs, and several threads may use it."""
    model, before = build(scenes.builder().spec, dtype), torch.get_num_threads()
    graphs = [scenes.graph(("sand",), dtype, num_nodes=n, seed=n, walls=n % 2 == 0) for n in (3, 120, 0, 40, 121, 1, 400, 2)]
    with torch.inference_mode(), unfused():
        expected = [model(data).acceleration.get("sand") for data in graphs]

    def run(data: HeteroData) -> Tensor | None:
        with torch.inference_mode():
            return model(data).acceleration.get("sand")

    torch.set_num_threads(threads)
    try:
        with ThreadPoolExecutor(threads) as pool:
            found = [x for _ in range(3) for x in pool.map(run, graphs)]
    finally:
        torch.set_num_threads(before)
    for a, b in zip(found, 3 * expected, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            torch.testing.assert_close(a, b, rtol=0, atol=TOLERANCE[dtype] * float(b.abs().max()))


class DoubleBuilder(GraphBuilder):
    """Builder of graphs in double precision."""

    precision = torch.float64


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rollouts_of_100_steps(dtype: torch.dtype) -> None:
    """Edges change in every step. Graphs are in single precision unless the builder says otherwise."""
    states = [scenes.state(n, seed=n, high=0.3).to_torch() for n in (30, 12)]
    build_graph = (DoubleBuilder if dtype is torch.float64 else GraphBuilder)(scenes.builder().config, scenes.metadata())
    simulator = LearnedSimulator(build(build_graph.spec, torch.float32, island_momentum="angular"), build_graph).to(dtype).eval()
    simulator.acceleration_std.fill_(3.0)
    num_edges = set()

    def rollout(count: bool = False) -> Tensor:
        now: Any = [replace(s, vel=0 * s.vel, velocity_history=0 * s.velocity_history) for s in states]  # type: ignore[operator]
        for _ in range(100):
            now = simulator.step_all(now)
            if count:
                num_edges.add(tuple(build_graph(s)["sand", "radius", "sand"].edge_index.shape[1] for s in now))
        return torch.cat([s.pos for s in now])  # type: ignore[list-item]

    found = rollout(count=True)
    with unfused():
        expected = rollout()
    moved = float((expected - torch.cat([s.pos for s in states])).abs().max())  # type: ignore[list-item]
    assert len(num_edges) > 10 and moved > 0.01
    torch.testing.assert_close(found, expected, rtol=0, atol=TOLERANCE[dtype])


@pytest.mark.parametrize("wrong", [-1, 40])
def test_edges_without_a_node_are_refused(wrong: int) -> None:
    model, data = build(scenes.builder().spec), scenes.graph()
    data["sand", "radius", "sand"].edge_index[0, 3] = wrong
    for skips in (Skips(), Skips(isolated_nodes=False)):
        model.skips = skips
        with torch.inference_mode(), pytest.raises(IndexError, match="sand to sand"):
            model(data)


@pytest.mark.parametrize("key", ["x", "material_params", "mass", "odd", "even", "edge_index"])
def test_tensors_of_another_shape_are_left_to_pytorch(key: str, caplog: pytest.LogCaptureFixture) -> None:
    model, data = build(scenes.builder().spec, decoder="pair"), scenes.graph()
    store = data["sand"] if key in data["sand"] else data["sand", "radius", "sand"]
    store[key] = store[key][:, :-1] if key == "edge_index" else store[key][:-1]
    gpe_program_runner.notice.cache_clear()
    with torch.inference_mode(), caplog.at_level(logging.INFO):
        assert model._compiled(data, False) is None
    assert "shape" in caplog.records[-1].message


def test_changed_weights_are_read_again() -> None:
    model, data = build(scenes.builder().spec), scenes.graph()
    before = compiled(model, data).acceleration["sand"]
    with torch.no_grad():
        model.convs[1]["sand__radius__sand"].lin_in.weight.mul_(1.1)  # type: ignore[index,union-attr]
    assert_equal(model, data)
    assert not torch.equal(compiled(model, data).acceleration["sand"], before)
    other = copy.deepcopy(model)
    model.load_state_dict(build(scenes.builder().spec).state_dict())
    assert torch.equal(compiled(model, data).acceleration["sand"], before)
    assert_equal(other, data)
    model.load_state_dict(other.state_dict(), assign=True)
    assert_equal(model, data)
    model.updates[0]["sand"] = build(scenes.builder().spec, node_norm="layer").updates[0]["sand"]  # type: ignore[index,operator]
    assert_equal(model, data)


def test_weights_are_read_again_after_training() -> None:
    model, data = build(scenes.builder().spec, island_momentum="ignored"), scenes.graph()
    before = compiled(model, data).acceleration["sand"]
    optimizer = OnePassAdam(model.parameters(), 0.01)
    model(data).acceleration["sand"].square().sum().backward()
    optimizer.step()
    assert not torch.equal(compiled(model, data).acceleration["sand"], before)
    assert_equal(model, data)


def test_changes_that_pytorch_does_not_count_are_seen() -> None:
    """Averages of weights, NumPy, and vectors that contain all weights write to memory in evaluation mode."""
    model, data = build(scenes.builder().spec), scenes.graph()
    weight = model.updates[0]["sand"][0].weight  # type: ignore[index]
    vector = torch.nn.utils.parameters_to_vector(model.parameters()).detach()

    def through_data() -> None:
        for parameter in model.parameters():
            parameter.data *= 1.01

    def through_numpy() -> None:
        weight.detach().numpy()[3, 5] += 1.0

    def through_a_vector() -> None:
        vector.mul_(1.01)

    torch.nn.utils.vector_to_parameters(vector, model.parameters())
    for change in (through_a_vector, through_data, through_numpy):
        before = compiled(model, data).acceleration["sand"]
        change()
        assert not torch.equal(compiled(model, data).acceleration["sand"], before)
        assert_equal(model, data)


def notices(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [r.message.rpartition(": ")[2] for r in caplog.records]


class Changed(GPE):
    """A model of someone else."""


class Doubled(MLP):
    """A layer of someone else."""

    def forward(self, *rows: Any) -> Tensor:
        return 2 * super().forward(*rows)


def test_subclasses_and_layers_of_someone_else_give_way_with_a_notice(caplog: pytest.LogCaptureFixture) -> None:
    data, spec = scenes.graph(), scenes.builder().spec
    gpe_program_runner.notice.cache_clear()
    with torch.inference_mode(), caplog.at_level(logging.INFO):
        made = build(spec)
        changed = Changed(spec, **made.settings).double().eval()
        changed.load_state_dict(made.state_dict())
        with unfused():
            expected = made(data).acceleration["sand"]
        for model in (made, changed, made, changed):
            torch.testing.assert_close(model(data).acceleration["sand"], expected, rtol=0, atol=1e-10)
        decoder: Any = made.node_decoder["sand"]
        made.node_decoder["sand"] = Doubled(8, 8, spec.dim).double()
        made.node_decoder["sand"].load_state_dict(decoder.state_dict())
        torch.testing.assert_close(made(data).acceleration["sand"], 2 * expected, rtol=0, atol=1e-10)
        made.node_decoder["sand"] = decoder
        torch.testing.assert_close(made(data).acceleration["sand"], expected, rtol=0, atol=1e-10)
        decoder.forward = lambda rows: rows[:, : spec.dim]
        found = made(data).acceleration["sand"]
        with unfused():
            torch.testing.assert_close(found, made(data).acceleration["sand"], rtol=0, atol=1e-10)
    wanted = ["Changed is a subclass of GPE", "a layer is a Doubled, which GPE does not make", "a layer has another forward"]
    assert notices(caplog) == wanted


def test_where_it_gives_way(caplog: pytest.LogCaptureFixture) -> None:
    model, data = build(scenes.builder().spec), scenes.graph()
    seen: list[int] = []
    gpe_program_runner.notice.cache_clear()
    with caplog.at_level(logging.INFO), torch.inference_mode():
        handle = model.updates[0]["sand"].register_forward_hook(lambda *_: seen.append(1))  # type: ignore[index,union-attr]
        hooked = [model(data) for _ in range(2)]
        handle.remove()
        assert len(seen) == 2 and torch.allclose(hooked[0].acceleration["sand"], model(data).acceleration["sand"])
        assert len(seen) == 2
        with pytest.raises(RuntimeError):  # as without a compiled network
            model(scenes.graph(dtype=torch.float32))
    assert notices(caplog) == [
        "a layer has hooks",
        "the graph has another precision, device or shape than the weights",
    ]
    model.train()
    with torch.no_grad():
        assert model._compiled(data, False) is None
    assert model.eval()._compiled(data, False) is None  # gradients are wanted
    with torch.no_grad(), unfused():
        assert model._compiled(data, False) is None
