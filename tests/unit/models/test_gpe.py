"""GPE compared with Algorithm 1 of the paper, written out with concatenated MLPs and loops over edges; and the properties of each option."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE, StressError
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import MATERIALS, is_symmetric
from tests import scenes

DOUBLE = torch.float64


def algorithm_1(model: Any, data: HeteroData) -> dict[str, Tensor]:
    """Compute the paper's pseudo-code edge by edge, in its order: encoder, processor with m_ji = −m_ij, decoder; with latent edge states."""
    directed = model.interaction == "directed"
    h: dict[tuple[str, int], Tensor] = {}
    for t in model.spec.node_types:
        for k in range(data[t].x.shape[0]):
            features = data[t].x[k]
            if t in model.material_embedding:
                features = torch.cat([features, model.material_embedding[t].theta(data[t].material_params[k])])
            h[t, k] = model.node_encoder[model.type_key(t)](features)

    # every edge once, from its first to its second end, or both ways for the model without momentum conservation
    edges: list[tuple[str, tuple[str, int], tuple[str, int], Tensor]] = []
    for relation in model.spec.relations:
        key, (source, _, target) = model.key(relation), relation
        store = data[relation]
        for n in range(store.edge_index.shape[1]):
            j, i = (source, int(store.edge_index[0, n])), (target, int(store.edge_index[1, n]))
            odd, even = store.odd[n], store.even[n]
            if is_symmetric(relation) and not directed:
                lead = next((float(o) for o in odd if o != 0), 1.0)
                if lead < 0:
                    i, j, odd = j, i, -odd
            edges.append((key, i, j, model.edge_encoder[key](torch.cat([odd, even]))))
            if directed:
                edges.append((key, j, i, model.edge_encoder[key](torch.cat([-odd, even]))))

    states = [e for *_, e in edges]
    for convs, updates in zip(model.convs, model.updates, strict=True):
        total = {node: torch.zeros_like(x) for node, x in h.items()}
        for n, (key, i, j, _) in enumerate(edges):
            if key not in convs:  # nobody reads what this edge does
                continue
            conv = convs[key]
            mlp = nn.Sequential(conv.lin_in, conv.act, conv.lin_out)
            m = mlp(torch.cat([h[i], h[j], states[n]]))
            total[i] = total[i] + m
            if not directed:
                total[j] = total[j] - m
            states[n] = states[n] + m
        keys = {node: model.type_key(node[0]) for node in h}
        h = {node: x + updates[keys[node]](total[node]) if keys[node] in updates else x for node, x in h.items()}
    count = {m: data[m].x.shape[0] for m in model.spec.materials}
    return {m: torch.stack([model.node_decoder[m](h[m, k]) for k in range(c)]) for m, c in count.items() if c}


@pytest.mark.slow
@pytest.mark.parametrize("implementation", ["factored", "plain"])
@pytest.mark.parametrize("interaction", ["directed", "negated"])
@pytest.mark.parametrize("materials", [("sand",), ("sand", "snow")])
@pytest.mark.parametrize("features", ["paper", "contact"])
def test_equals_algorithm_1(interaction: str, implementation: str, materials: tuple[str, ...], features: str) -> None:
    build = scenes.builder(materials, features=features)
    torch.manual_seed(0)
    settings = {"interaction": interaction, "implementation": implementation}
    model = GPE(build.spec, num_message_passing_steps=3, hidden_channels=8, **settings).double()  # type: ignore[arg-type]
    data = scenes.to_dtype(build(scenes.state(25, materials).to_torch()), DOUBLE)
    expected = algorithm_1(model, data)
    out = model(data).acceleration
    assert set(out) == set(expected) == set(materials)
    for material, value in expected.items():
        torch.testing.assert_close(out[material], value, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("interaction", ["directed", "negated"])
@pytest.mark.parametrize("level_weights", ["shared", "separate"])
def test_equals_algorithm_1_on_meshes(interaction: str, level_weights: str) -> None:
    build = scenes.builder(("elastomer",), mesh=True, num_levels=3)
    torch.manual_seed(0)
    settings = {"interaction": interaction, "level_weights": level_weights}
    model = GPE(build.spec, num_message_passing_steps=4, hidden_channels=8, **settings).double()  # type: ignore[arg-type]
    data = scenes.to_dtype(build(scenes.mesh_state("lattice", num_bodies=1).to_torch()), DOUBLE)
    torch.testing.assert_close(model(data).acceleration, algorithm_1(model, data), rtol=1e-11, atol=1e-12)


def test_messages_stop_where_no_material_can_hear_them() -> None:
    """Level l is heard after l more steps; one set of weights per level is built and run only so far."""
    build = scenes.builder(("elastomer",), mesh=True, num_levels=4)
    model = GPE(build.spec, num_message_passing_steps=3, hidden_channels=8, level_weights="separate")
    convs, updates = ([{*cast(nn.ModuleDict, step)} for step in steps] for steps in (model.convs, model.updates))
    down = ["grid_1__down__elastomer", "grid_2__down__grid_1", "grid_3__down__grid_2"]
    same = ["grid_1__same__grid_1", "grid_2__same__grid_2"]
    assert [{k for k in step if "grid" in k} for step in convs] == [{*down, *same}, {*down[:2], *same[:1]}, {*down[:1]}]
    assert [step - {"boundary"} for step in updates] == [{"elastomer", "grid_1", "grid_2"}, {"elastomer", "grid_1"}, {"elastomer"}]


@pytest.mark.parametrize("dim", [2, 3])
def test_stress_is_decoded_at_the_nodes_of_materials_that_have_one(dim: int) -> None:
    build = scenes.builder(("elastomer", "solid"), dim, mesh=True)
    model = GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, stress=True).double()
    s = scenes.mesh_state("triangles" if dim == 2 else "tetrahedra", ("elastomer", "solid"))
    data = scenes.to_dtype(build(s.to_torch()), DOUBLE)
    prediction = model(data)
    assert {m: tuple(v.shape) for m, v in prediction.stress.items()} == {"solid": (data["solid"].num_nodes, 4 if dim == 2 else 6)}
    prediction.stress["solid"].square().sum().backward()
    assert all(p.grad is not None for p in model.stress_decoder.parameters())
    none = scenes.to_dtype(build(scenes.state(5, ("elastomer",), dim=dim).to_torch()), DOUBLE)
    assert model(none).stress == {}
    assert GPE(build.spec, num_message_passing_steps=1, hidden_channels=8).double()(data).stress == {}
    with pytest.raises(StressError, match="the data set stores no stress of sand"):
        GPE(scenes.builder().spec, num_message_passing_steps=1, hidden_channels=8, stress=True)


@pytest.mark.slow
def test_plain_and_factored_are_the_same_function_with_the_same_gradient() -> None:
    data = scenes.graph(("sand", "snow"))
    spec = scenes.builder(("sand", "snow")).spec
    for interaction in ("directed", "negated", "odd", "odd_even"):
        for edge_state in ("latent", "geometry"):
            grads, outs = [], []
            for implementation in ("plain", "factored"):
                torch.manual_seed(0)
                model = GPE(spec, interaction, "node", edge_state, "affine", 3, 16, implementation).double()  # type: ignore[arg-type]
                out = torch.cat(list(model(data).acceleration.values()))
                out.square().sum().backward()
                outs.append(out)
                grads.append({n: p.grad for n, p in model.named_parameters() if p.grad is not None})
            torch.testing.assert_close(outs[0], outs[1], rtol=1e-10, atol=1e-12)
            assert grads[0].keys() == grads[1].keys()
            for name in grads[0]:
                torch.testing.assert_close(grads[0][name], grads[1][name], rtol=1e-9, atol=1e-10)


def isolated_body(num_nodes: int = 60, seed: int = 0) -> HeteroData:
    build = scenes.builder()
    return scenes.to_dtype(build(scenes.state(num_nodes, walls=False, seed=seed).to_torch()), DOUBLE)


@pytest.mark.parametrize("interaction", ["directed", "negated", "odd", "odd_even"])
@pytest.mark.parametrize("seed", range(3))
def test_pair_forces_of_an_isolated_body_sum_to_zero(interaction: str, seed: int) -> None:
    torch.manual_seed(seed)
    model = GPE(scenes.builder().spec, interaction=interaction, decoder="pair", num_message_passing_steps=3, hidden_channels=16).double()  # type: ignore[arg-type]
    data = isolated_body(seed=seed)
    force = model(data).acceleration["sand"] * data["sand"].mass[:, None]
    assert force.norm(dim=1).sum() > 1e-3
    assert force.sum(dim=0).norm() / force.norm(dim=1).sum() < 1e-14


def test_pair_forces_are_computed_for_some_edges_at_a_time() -> None:
    model = GPE(scenes.builder().spec, decoder="pair", num_message_passing_steps=1, hidden_channels=8).double()
    model.skips, seen = Skips(edges_at_once=7), list[int]()
    for force in model.pair_decoder.values():
        force.lin_out.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))  # type: ignore[operator, union-attr]
    data = isolated_body()
    with torch.inference_mode():
        model(data)
    assert max(seen) == 7 and sum(seen) == data["sand", "radius", "sand"].edge_index.shape[1]


def test_node_decoder_does_not_conserve_momentum() -> None:
    """The reverse of the test above, so that it can be seen to measure something: hidden antisymmetry is not physical conservation."""
    torch.manual_seed(0)
    model = GPE(scenes.builder().spec, interaction="odd", num_message_passing_steps=3, hidden_channels=16).double()
    data = isolated_body()
    force = model(data).acceleration["sand"] * data["sand"].mass[:, None]
    assert force.sum(dim=0).norm() / force.norm(dim=1).sum() > 1e-3


def test_pair_forces_push_two_materials_apart_equally() -> None:
    build = scenes.builder(("sand", "snow"))
    torch.manual_seed(0)
    model = GPE(build.spec, decoder="pair", num_message_passing_steps=2, hidden_channels=16).double()
    data = scenes.to_dtype(build(scenes.state(40, ("sand", "snow"), walls=False).to_torch()), DOUBLE)
    out = model(data).acceleration
    total = sum((out[m] * data[m].mass[:, None]).sum(dim=0) for m in out)
    assert isinstance(total, Tensor)
    assert total.norm() < 1e-13 * sum(float((out[m] * data[m].mass[:, None]).norm()) for m in out)


@pytest.mark.parametrize("material", ["sand", "snow", "fluid", "elastomer", "solid"])
@pytest.mark.parametrize(("kind", "scale"), [("affine", "linear"), ("affine", None), ("mlp", "linear")])
def test_affine_embedding_interpolates_physical_values_as_the_paper_says(kind: str, scale: str | None, material: str) -> None:
    """Θ(λv₁ + (1−λ)v₂) = λΘ(v₁) + (1−λ)Θ(v₂) for values in SI units holds for ``affine`` of linear parameters and, generically, for nothing else."""
    torch.manual_seed(0)
    build = scenes.builder((material,), parameter_scale=scale)
    simulator = LearnedSimulator(GPE(build.spec, material_embedding=kind, hidden_channels=32), build).double()  # type: ignore[arg-type]
    low, high = {"sand": (20.0, 42.5), "snow": (5.0, 14.0), "fluid": (1e-3, 1e-1), "elastomer": (3e4, 6e5), "solid": (1e6, 4e6)}[material]
    graph = scenes.to_dtype(build(scenes.state(40, (material,)).to_torch()), DOUBLE)

    def with_values(values: torch.Tensor) -> HeteroData:
        changed = graph.clone()
        changed[material].material_params = values[:, None]
        return changed

    simulator.standardizer.fit([with_values(torch.linspace(low, high, 40, dtype=DOUBLE))])
    simulator.standardizer.double()

    def theta(value: float) -> torch.Tensor:
        scaled = simulator.standardizer(with_values(torch.full((40,), value, dtype=DOUBLE)))[material].material_params
        return cast(nn.ModuleDict, simulator.model.material_embedding)[material](scaled)[0].detach()

    ends = theta(low), theta(high)
    mixed = [(x, theta(x * low + (1 - x) * high)) for x in (0.1, 0.4, 0.7)]
    errors = [float((value - x * ends[0] - (1 - x) * ends[1]).norm() / (ends[0] - ends[1]).norm()) for x, value in mixed]
    is_linear = scale == "linear" or MATERIALS[material][0].scale == "linear"
    assert (max(errors) < 1e-9) == (kind == "affine" and is_linear)


@pytest.mark.parametrize("interaction", ["odd", "odd_even"])
def test_odd_interactions_are_mirror_free_without_any_rule(interaction: str) -> None:
    """This includes edges with zero displacement, for which a geometric rule has no direction."""
    build = scenes.builder()
    s = scenes.state(20)
    pos = s.pos.copy()
    pos[10:] = pos[:10]
    order = np.random.default_rng(0).permutation(20)
    s = replace(s, pos=pos)
    torch.manual_seed(0)
    model = GPE(build.spec, interaction=interaction, num_message_passing_steps=3, hidden_channels=16).double()  # type: ignore[arg-type]
    y = model(scenes.to_dtype(build(s.to_torch()), DOUBLE)).acceleration["sand"]
    z = model(scenes.to_dtype(build(scenes.permuted(s, order).to_torch()), DOUBLE)).acceleration["sand"]
    torch.testing.assert_close(z, y[order], rtol=1e-12, atol=1e-12)


def test_absent_types_run_no_code() -> None:
    build = scenes.builder(("sand", "snow"))
    model = GPE(build.spec, num_message_passing_steps=2, hidden_channels=8).double()
    called: list[str] = []
    for name, module in model.named_modules():
        if "snow" in name:
            module.register_forward_hook(lambda *_, n=name: called.append(n))
    s = replace(scenes.state(20), material_params=np.full((20, 2), 30.0))
    model(scenes.to_dtype(build(s.to_torch()), DOUBLE))
    assert called == []
