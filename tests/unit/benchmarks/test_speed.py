"""The benchmark of speed runs, counts the matrix products, and times the stated operations."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from gpe_pl.benchmarks.speed import REFERENCE, Case, Settings, cases, flop, run, training_step
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.lattice import lattice_graph
from gpe_pl.nn.fused import works_on
from gpe_pl.system.machine import reduces_precision

SMALL = Settings(num_nodes=40, num_edges=100, num_message_passing_steps=2, hidden_channels=8, num_rounds=1, compile=False)


@pytest.mark.parametrize(("dim", "num_nodes", "num_edges"), [(2, 400, 2000), (2, 400, 4000), (3, 1000, 7000)])
def test_the_lattice_has_about_the_wanted_edges(dim: int, num_nodes: int, num_edges: int) -> None:
    builder, graph = lattice_graph(num_nodes, num_edges, GraphConfig(), dim)
    found = sum(graph[r].edge_index.shape[1] for r in builder.spec.relations)
    assert abs(found - num_edges) < 0.02 * num_edges
    assert graph["sand"].x.shape[0] == num_nodes and builder.spec.dim == dim


@pytest.mark.slow
def test_a_scene_larger_than_the_sample_that_its_radius_comes_from() -> None:
    builder, graph = lattice_graph(50_000, 250_000, GraphConfig(history=1))
    assert abs(sum(graph[r].edge_index.shape[1] for r in builder.spec.relations) - 250_000) < 0.02 * 250_000


def test_products_are_counted_as_by_hand() -> None:
    builder, graph = lattice_graph(50, 120, GraphConfig())
    spec, hidden, steps = builder.spec, 8, 3
    relation = ("sand", "radius", "sand")
    edges = graph[relation].edge_index.shape[1]
    features = spec.odd_channels[relation] + spec.even_channels[relation]
    counted = flop(Case().build(spec, steps, hidden), graph)
    square = 2 * hidden * hidden
    nodes = 50 * (2 * hidden * (1 + spec.node_channels["sand"] + hidden) + square)  # material embedding and encoder
    nodes += 50 * (steps * 4 * square + square)  # two factors, two layers of the update; the last product after the sums
    nodes += 50 * (square + 2 * hidden * 2)  # decoder
    per_edge = 2 * features * hidden + square + steps * square + (steps - 1) * square
    assert counted == nodes + edges * per_edge


def test_a_training_step_has_gradients_and_changes_nothing() -> None:
    builder, graph = lattice_graph(40, 100, GraphConfig())
    model = Case().build(builder.spec, 2, 8)
    before = {k: v.clone() for k, v in model.state_dict().items()}
    loss = training_step(model, graph)()
    assert loss > 0 and any(p.grad is not None and p.grad.abs().max() > 0 for p in model.parameters())
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())


@pytest.mark.slow
def test_every_case_has_its_records_and_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A suite that is stopped in its third group measures only this group and later ones when it is started again."""
    groups: list[list[str]] = []

    def here(factories: dict[str, Any], modules: list[str]) -> Any:
        groups.append([*factories])
        if len(groups) == 3:
            raise KeyboardInterrupt
        return nullcontext({name: factory() for name, factory in factories.items()})

    monkeypatch.setattr("gpe_pl.benchmarks.speed.peaks_in_turn", lambda passes: dict.fromkeys(passes, 1_000_000))
    monkeypatch.setattr("gpe_pl.benchmarks.speed.copy_rate", lambda *_: 1e9)
    monkeypatch.setattr("gpe_pl.benchmarks.speed.apart", here)
    monkeypatch.setattr("gpe_pl.benchmarks.speed.reduces_precision", lambda _: True)
    with pytest.raises(KeyboardInterrupt):
        run(SMALL, {}, {}, tmp_path)
    records, table = run(SMALL, {}, {}, tmp_path)
    assert groups[2] == groups[3] and all(REFERENCE in group for group in groups)
    assert sorted(name for group in groups[:2] + groups[3:] for name in group if name != REFERENCE) == sorted(
        {*cases(compiled=False, reduced=True)} - {REFERENCE}
    )
    found = {(r["metric"], r["case"]): r["value"] for r in records}
    for name, case in cases(compiled=False, reduced=True).items():
        wanted = {"forward_time", "training_time", "forward_speedup", "forward_speedup_vs_gns", "training_speedup"}
        if case.precision != "highest":
            wanted |= {"forward_difference"}
        else:
            wanted |= {"peak_memory"} | ({"flop_floor", "byte_floor", "floor_ratio"} if case.model == "GPE" else set())
        assert (("forward_time_saved", name) in found) == (case.saves_against is not None)
        assert all(found[metric, name] >= 0 for metric in wanted)
        assert f"| {name} |" in table
    assert found["forward_speedup", REFERENCE] == 1 and found["forward_speedup_vs_gns", "GNS"] == 1
    assert found["neighbor_time", "cpu"] > 0
    assert found["flop", "negated, geometry"] < found["flop", "negated"] < found["flop", REFERENCE]


def test_products_that_do_not_become_less_exact_are_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not any(case.precision != "highest" for case in cases(compiled=True, reduced=False).values())

    def exact(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return torch.mm(a.double(), b.double()).float()  # some processors round products in single precision, if they may

    monkeypatch.setattr(torch.Tensor, "__matmul__", exact)
    assert not reduces_precision("cpu")

    def rounded(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return exact(a, b) if torch.get_float32_matmul_precision() == "highest" else exact(a.bfloat16().float(), b.bfloat16().float())

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    assert reduces_precision("cpu")
    assert torch.get_float32_matmul_precision() == "highest"


def test_precision_holds_within_a_pass_alone() -> None:
    seen: list[str] = []
    before = torch.get_float32_matmul_precision()
    Case(precision="medium").runs(lambda: seen.append(torch.get_float32_matmul_precision()))()
    assert seen == ["medium"] and torch.get_float32_matmul_precision() == before == "highest"


def test_fused_passes_are_left_out_where_a_case_has_none() -> None:
    x, seen = torch.zeros(2, 2), list[bool]()
    for case in (Case(), Case(is_fused=False), Case()):
        case.runs(lambda: seen.append(works_on(x)))()
    assert seen == [True, False, True]


def test_time_is_saved_against_the_same_implementation() -> None:
    found = {name: case.saves_against for name, case in cases(compiled=True, reduced=True).items()}
    assert found["negated, plain"] == "directed, plain" and found["odd, factored"] == "directed, factored"
    assert {name for name, against in found.items() if against is None} >= {
        "negated",
        "negated, compiled",
        "negated, geometry",
        "negated, medium",
        "GNS",
    }
    assert not cases(compiled=True, reduced=True)["directed, factored"].is_fused


def test_without_a_compiler_nothing_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    class Chosen(Exception):
        pass

    def see(compiled: bool, reduced: bool) -> None:
        raise Chosen(compiled)

    monkeypatch.setattr("gpe_pl.benchmarks.speed.cases", see)
    monkeypatch.setattr("gpe_pl.benchmarks.speed.has_cpp_compiler", lambda: False)
    with pytest.raises(Chosen, match="False"):
        run(replace(SMALL, compile=True), {}, {}, tmp_path)
    assert "no C++ compiler" in caplog.text
