"""Batches filled up to fixed sizes give the results and gradients of the batches alone. ``tests/contracts/test_gpu.py`` has the graphs themselves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch_geometric.data import Batch, HeteroData

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing import scenes
from gpe_pl.models.base import Model
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.training.cuda_graph import MOST_EDGES, MULTIPLE, CudaGraphs, FilledArguments, Sizes, enlarged, sizes_of, without_further_nodes
from gpe_pl.training.module import TrainingModule
from tests import meshes

MATERIALS = ("sand", "snow")
MODELS: dict[str, tuple[type[Model], dict[str, Any]]] = {
    "gpe": (GPE, {}),
    "gpe_tuned": (GPE, {"edge_state": "geometry", "node_norm": "layer"}),
    "gpe-odd-pair": (GPE, {"interaction": "odd", "decoder": "pair"}),
    "gpe-odd_even": (GPE, {"interaction": "odd_even"}),
    "gpe-directed": (GPE, {"interaction": "directed", "implementation": "plain"}),
    "gns": (GNS, {}),
    "dpinet": (DPINet, {}),
    "cconv": (ContinuousConvNet, {}),
}


def built(name: str, spec: Any) -> Model:
    cls, settings = MODELS[name]
    torch.manual_seed(0)
    model = cls(spec, hidden_channels=8, **settings).double().train()
    for parameter in model.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    return model


def particles(num_nodes: int = 30, seed: int = 0) -> HeteroData:
    data = scenes.builder(MATERIALS)(scenes.state(num_nodes, MATERIALS, seed=seed).to_torch())
    for store in data.stores:
        for key, value in store.items():
            if isinstance(value, Tensor) and value.is_floating_point():
                store[key] = value.double()
    return data


def gradients(model: Model, data: HeteroData) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    model.zero_grad()
    found = model(data).acceleration
    torch.stack([(a * torch.arange(1.0, a.numel() + 1).view_as(a)).sum() for a in found.values()]).sum().backward()
    return found, {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


def filled_up(compute: Callable[..., Any]) -> Callable[..., Any]:
    def filled_compute(*arguments: Any) -> Any:
        filled = FilledArguments(arguments, enlarged(sizes_of(arguments), {}))
        filled.fill(arguments)
        assert all(leaf.isfinite().all() for leaf in pytree.tree_leaves(filled.arguments))
        return without_further_nodes(compute(*filled.arguments), sizes_of(arguments))

    return filled_compute


def assert_same(model: Model, data: HeteroData) -> None:
    expected, expected_gradients = gradients(model, data)
    expected = {m: a.detach().clone() for m, a in expected.items()}
    expected_gradients = {name: g.clone() for name, g in expected_gradients.items()}
    model.compute = filled_up(model.compute)
    found, found_gradients = gradients(model, data)
    assert found.keys() == expected.keys()
    assert found_gradients.keys() == expected_gradients.keys()
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, rtol=1e-10, atol=1e-12)
    for key, value in expected_gradients.items():
        torch.testing.assert_close(found_gradients[key], value, rtol=1e-9, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_further_particles_change_neither_results_nor_gradients(name: str) -> None:
    assert_same(built(name, scenes.builder(MATERIALS).spec), particles())


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in MODELS if name != "cconv"])
def test_further_nodes_of_meshes_change_neither_results_nor_gradients(name: str) -> None:
    assert_same(built(name, meshes.spec(3)), meshes.graph(3))


def test_further_edges_join_further_nodes_alone() -> None:
    arguments = ({"sand": torch.rand(70, 2)}, {("sand", "radius", "sand"): (torch.randint(70, (2, 100)), torch.rand(100, 3))})
    filled = FilledArguments(arguments, enlarged(sizes_of(arguments), {}))
    for count, num_edges in ((70, 100), (50, 10), (60, 120)):
        nodes, index = torch.rand(count, 2), torch.randint(count, (2, num_edges))
        filled.fill(({"sand": nodes}, {("sand", "radius", "sand"): (index, torch.rand(num_edges, 3))}))
        (own,) = filled.arguments[0].values()
        own_index = filled.arguments[1]["sand", "radius", "sand"][0]
        assert torch.equal(own[:count], nodes)
        assert torch.equal(own_index[:, :num_edges], index)
        assert own_index[:, num_edges:].min() == count
        assert own_index[:, num_edges:].max() < len(own)


def test_sizes_have_a_margin_and_stay_while_they_suffice() -> None:
    relation = ("sand", "radius", "sand")
    first = enlarged({"sand": 100, relation: 100}, {})
    assert first == {"sand": 2 * MULTIPLE, relation: 2 * MULTIPLE}
    assert enlarged({"sand": 127, relation: 128}, first) == first
    assert enlarged({"sand": 128, relation: 128}, first) == {"sand": 3 * MULTIPLE, relation: 2 * MULTIPLE}


def test_further_nodes_have_few_edges() -> None:
    relation = ("sand", "radius", "sand")
    before: Sizes = {}
    for nodes, edges in ((200, 4000), (250, 3000), (150, 1000), (255, 4400)):
        before = enlarged({"sand": nodes, relation: edges}, before)
        assert before["sand"] > nodes
        assert before[relation] >= edges
        assert (before[relation] - edges) / (before["sand"] - nodes) <= MOST_EDGES


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> CudaGraphs:
    """Graphs of a model on a CPU, where nothing can be captured: a graph is the module that would be captured."""
    monkeypatch.setattr("torch.cuda.graph_pool_handle", lambda: None)
    monkeypatch.setattr("torch.cuda.make_graphed_callables", lambda network, tensors, **settings: network)
    model = built("gpe", scenes.builder(MATERIALS).spec)
    model.compute = found = CudaGraphs(model, model.compute)
    return found


@pytest.mark.slow
def test_batches_of_similar_sizes_share_a_graph(graphs: CudaGraphs) -> None:
    for seed in range(10):
        graphs.begin_step()
        graphs.model(particles(30, seed))
    few = graphs.num_made
    assert 1 <= few < 6
    for seed in range(10):
        graphs.begin_step()
        graphs.model(particles(30, seed))
    assert graphs.num_made == few
    graphs.begin_step()
    graphs.model(particles(120))
    assert graphs.num_made == few + 1


def test_weights_get_the_gradients(graphs: CudaGraphs) -> None:
    expected = gradients(graphs.model, particles())[1]
    graphs.begin_step()
    data = particles()
    graphs.works = False
    plain = gradients(graphs.model, data)[1]
    assert graphs.num_made == 1
    assert expected.keys() == plain.keys()
    for key, value in plain.items():
        torch.testing.assert_close(expected[key], value, rtol=1e-9, atol=1e-10)


@pytest.mark.slow
def test_only_the_first_call_of_a_step_uses_a_graph(graphs: CudaGraphs, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    fill = FilledArguments.fill

    def counted(self: FilledArguments, arguments: Any) -> None:
        calls.append(1)
        fill(self, arguments)

    graphs.model(particles())
    monkeypatch.setattr(FilledArguments, "fill", counted)
    graphs.model(particles())
    assert not calls
    graphs.begin_step()
    graphs.model(particles())
    assert len(calls) == 1
    graphs.begin_step()
    with torch.no_grad():
        graphs.model(particles())
    graphs.model.eval()
    graphs.model(particles())
    assert len(calls) == 1


def test_large_batches_have_no_graph(graphs: CudaGraphs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.training.cuda_graph.MOST_ROWS", 100)
    graphs.model(particles())
    assert not graphs.num_made


def test_moved_weights_need_a_new_graph(graphs: CudaGraphs) -> None:
    graphs.model(particles())
    weight = next(graphs.model.parameters())
    weight.data = weight.data.clone()
    graphs.begin_step()
    graphs.model(particles())
    assert graphs.num_made == 2


@pytest.mark.slow
def test_training_goes_on_where_graphs_cannot_be_made(
    graphs: CudaGraphs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr("torch.cuda.make_graphed_callables", fails)
    with caplog.at_level("WARNING"):
        for _ in range(3):
            graphs.begin_step()
            assert graphs.model(particles()).acceleration
    assert [record.getMessage().count("not permitted") for record in caplog.records] == [1]


def test_each_loss_begins_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    began = []
    build = scenes.builder(MATERIALS, history=1)
    module = TrainingModule(LearnedSimulator(GPE(build.spec, hidden_channels=8), build), 10)
    monkeypatch.setattr(CudaGraphs, "begin_step", lambda self: began.append(1))
    module._graphs = CudaGraphs(module.simulator.model, module.simulator.model.compute)
    data = build(scenes.state(30, MATERIALS).to_torch())
    for material in MATERIALS:
        data[material].target = torch.zeros(data[material].num_nodes, 2)
    module.loss(Batch.from_data_list([data]))
    assert began == [1]


def test_a_cpu_uses_no_graphs() -> None:
    build = scenes.builder(MATERIALS, history=1)
    module = TrainingModule(LearnedSimulator(GPE(build.spec, hidden_channels=8), build), 10)
    with module.compiled():
        assert "compute" not in module.simulator.model.__dict__


@pytest.mark.parametrize(("compile", "cuda_graph", "wanted"), [("auto", "auto", False), ("auto", "off", True), ("on", "auto", True)])
def test_long_runs_with_graphs_compile_only_if_asked(compile: Any, cuda_graph: Any, wanted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    build = scenes.builder(MATERIALS, history=1)
    simulator = LearnedSimulator(GPE(build.spec, hidden_channels=8), build)
    module = TrainingModule(simulator, 20_000, compile=compile, cuda_graph=cuda_graph)
    monkeypatch.setattr(TrainingModule, "device", torch.device("cuda"))
    monkeypatch.setattr("gpe_pl.training.module.has_cpp_compiler", lambda: True)
    assert module._wants_compilation() == wanted
