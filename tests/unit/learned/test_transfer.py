"""Simulators that start from one of other materials, features, parameters or another domain."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.learned.transfer import check_model, keep_rollout_settings, keep_trained_ranges, source_materials
from gpe_pl.models.base import LayersError, Model
from gpe_pl.models.cconv import ContinuousConvNet
from gpe_pl.models.dpinet import DPINet
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.blocks import Standardize
from gpe_pl.nn.elastic_motion import Constants
from gpe_pl.nn.elastic_touch import BodyLayer
from gpe_pl.schema import node_code, param_names
from gpe_pl.training.optimizer import train_only
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata
from tests import scenes

LAW: dict[str, Any] = {"elastic": True, "body_layer": 1.0, "decoder": "contact", "only_contacts": True}
"""Settings of GPE with the elastic law, for graphs of ``CELLS``."""
CELLS = GraphConfig(history=1, islands=True, mesh=True, cells=True)
E, NU = "youngs_modulus", "poisson_ratio"


def simulator(
    metadata: Metadata, seed: int = 0, config: GraphConfig | None = None, model: type[Model] = GPE, **settings: Any
) -> LearnedSimulator:
    """Return a simulator with random weights, and with statistics of one random graph."""
    torch.manual_seed(seed)
    builder = GraphBuilder(config or GraphConfig(history=1, islands=True), metadata)
    size = {} if model is ContinuousConvNet else {"hidden_channels": 8}
    size |= {"num_message_passing_steps": 2} if model in (GPE, GNS) else {}
    made = LearnedSimulator(model(builder.spec, **{**size, **settings}), builder)
    drawn = scenes.state(60, metadata.materials, history=builder.config.history, seed=seed, dim=metadata.dim)
    if builder.config.cells:
        drawn = scenes.mesh_state("tetrahedra" if metadata.dim == 3 else "triangles", metadata.materials, seed=seed)
    num_further = len(metadata.param_names) - len(param_names(metadata.materials))
    further = np.random.default_rng(seed).uniform(0.1, 0.4, (drawn.num_nodes, num_further))
    drawn = replace(drawn, material_params=np.concatenate([drawn.material_params, further], axis=1), param_names=metadata.param_names)
    graph = builder(drawn.to_torch())
    for material in metadata.materials:
        graph[material].target = (1.0 + seed) * torch.randn(graph[material].num_nodes, metadata.dim)
    made.fit_statistics([graph])
    return made.eval()


def acceleration(trained: LearnedSimulator, state: State) -> Tensor:
    """Return the acceleration of the only material [node, dim] in m/s²."""
    (values,) = trained(trained.builder(state)).acceleration.values()
    return values * trained.acceleration_std


def with_material(state: State, material: str, value: float) -> State:
    node_type = torch.full_like(state.node_type, node_code(material))
    return replace(state, node_type=node_type, material_params=torch.full_like(state.material_params, value))


def test_a_new_material_moves_as_the_known_one_whatever_its_parameter(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    sand, snow = simulator(scenes.metadata(("sand",))), simulator(scenes.metadata(("snow",)), seed=1)
    sand.clamps_parameters = snow.clamps_parameters = False
    transfer = snow.start_from(sand)
    state = replace(scenes.state(seed=5), mass=scenes.state(seed=5).mass * 0 + 1.0).to_torch()
    mean = float(sand.state_dict()["standardizer.params.sand.mean"])
    known = acceleration(sand, with_material(state, "sand", mean))
    for value in (4.0, 11.0):
        torch.testing.assert_close(acceleration(snow, with_material(state, "snow", value)), known, rtol=1e-4, atol=1e-4)
    assert (known - acceleration(sand, with_material(state, "sand", 2 * mean))).abs().max() > 1e-3
    assert [*transfer.new] == ["material_embedding.snow.theta.weight"]
    assert "snow from sand; new: material_embedding.snow.theta.weight" in caplog.text


def test_a_further_parameter_leaves_what_is_known_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = scenes.metadata(("sand",)), replace(scenes.metadata(("sand",)), param_names=("friction_angle", "cohesion"))
    trained, new = simulator(one), simulator(one, seed=1)
    builder = GraphBuilder(GraphConfig(history=1, islands=True), two)
    new = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=2, hidden_channels=8), builder).eval()
    new.state_dict()["standardizer.params.sand.mean"].copy_(torch.tensor([1.0, 500.0]))
    trained.clamps_parameters = new.clamps_parameters = False
    transfer = new.start_from(trained)
    state = scenes.state(seed=5).to_torch()
    both = torch.cat([state.material_params, torch.full((state.num_nodes, 1), 800.0)], dim=1)
    known = acceleration(trained, state)
    torch.testing.assert_close(acceleration(new, replace(state, material_params=both)), known, rtol=1e-4, atol=1e-4)
    assert float(new.state_dict()["standardizer.params.sand.mean"][1]) == 500.0
    assert transfer.num_weights - transfer.num_copied == 8


def test_other_features_start_with_new_encoders(caplog: pytest.LogCaptureFixture) -> None:
    metadata = scenes.metadata()
    trained, new = simulator(metadata), simulator(metadata, 1, GraphConfig(history=3, islands=True))
    before = {name: value.clone() for name, value in new.named_buffers()}
    transfer = new.start_from(trained)
    assert [*transfer.new] == ["node_encoder.sand.0.weight"]
    assert "choose these to continue it unchanged" in caplog.text and "graph.history=1" in caplog.text
    now, there = new.state_dict(), trained.state_dict()
    assert torch.equal(now["standardizer.node.sand.mean"], before["standardizer.node.sand.mean"])
    assert torch.equal(now["standardizer.node.boundary.mean"], there["standardizer.node.boundary.mean"])
    assert torch.equal(now["model.convs.1.sand__radius__sand.lin_in.weight"], there["model.convs.1.sand__radius__sand.lin_in.weight"])


@pytest.mark.parametrize("change", [{"frame_dt": 0.01}, {"spacing": 0.1}, {"dim": 3}])
def test_other_scales_have_their_own_statistics(change: dict[str, Any], caplog: pytest.LogCaptureFixture) -> None:
    metadata = scenes.metadata(dim=change.get("dim", 2))
    trained = simulator(scenes.metadata())
    new = simulator(replace(metadata, **{k: v for k, v in change.items() if k != "dim"}), seed=1)
    before, weight = {name: value.clone() for name, value in new.standardizer.state_dict().items()}, "model.updates.0.sand.0.weight"
    new.start_from(trained)
    torch.testing.assert_close(new.standardizer.state_dict(), before, rtol=0, atol=0)
    assert torch.equal(new.state_dict()[weight], trained.state_dict()[weight])
    assert float(new.acceleration_std) > 1.5 * float(trained.acceleration_std)
    assert "statistics are those of the new data" in caplog.text


def test_another_network_is_refused_and_nothing_is_changed() -> None:
    trained, new = simulator(scenes.metadata()), simulator(scenes.metadata(("snow",)), seed=1, hidden_channels=4)
    before = {name: value.clone() for name, value in new.state_dict().items()}
    with pytest.raises(CheckpointError, match="choose model.hidden_channels=8$"):
        new.start_from(trained)
    torch.testing.assert_close(new.state_dict(), before, rtol=0, atol=0)


def assert_refused(new: LearnedSimulator, trained: LearnedSimulator, message: str) -> None:
    before = {name: value.clone() for name, value in new.state_dict().items()}
    for start in (check_model, LearnedSimulator.start_from):
        with pytest.raises(CheckpointError, match=message):
            start(new, trained)
    torch.testing.assert_close(new.state_dict(), before, rtol=0, atol=0)


SAND = scenes.metadata(("sand",))
WITH_COHESION = replace(SAND, param_names=("friction_angle", "cohesion"))


@pytest.mark.parametrize("model", [GNS, DPINet, ContinuousConvNet])
@pytest.mark.parametrize(
    ("before", "now", "config", "message"),
    [
        (scenes.metadata(("snow", "fluid")), scenes.metadata(("sand", "snow")), None, "materials differ: snow, fluid of .* sand, snow of"),
        (
            SAND,
            scenes.metadata(("snow",)),
            None,
            "materials differ: sand of the model to start from, snow of the new one; .* model=gpe_tuned",
        ),
        (SAND, WITH_COHESION, None, "parameters differ: friction_angle of sand of .*, friction_angle of sand, cohesion of sand of"),
        (SAND, scenes.metadata(("sand",), dim=3), None, "dimensions differ: 2 of the model"),
        (SAND, SAND, GraphConfig(history=3, islands=True), "channels of nodes differ: .* and loads, with graph.history=1, or train"),
        (
            SAND,
            SAND,
            GraphConfig(history=1, islands=True, features="paper"),
            "channels of edges differ: .* with graph.features=contact, or",
        ),
    ],
)
def test_models_whose_weights_have_places_start_on_the_same_layout_only(
    model: type[Model], before: Metadata, now: Metadata, config: GraphConfig | None, message: str
) -> None:
    trained = simulator(before, model=model)
    assert_refused(simulator(now, 1, config, model), trained, f"{model.__name__} places its weights .* and {message}")
    assert simulator(replace(before, frame_dt=0.01), 1, model=model).start_from(trained).new == {}


def law(trained: LearnedSimulator, young: float) -> dict[str, Tensor]:
    """Return λ and μ in Pa and η in Pa s of a material with a Young's modulus, and the logarithms of the layer between bodies, which have no unit."""
    (material,), dt = trained.builder.spec.materials, trained.frame_dt
    standardized = cast(Standardize, trained.standardizer.params[material])
    params = standardized.mean.clone()[None]
    params[0, 0] = math.log(young)
    params = standardized(params).float()
    bodies = cast(GPE, trained.model).elastic_bodies
    unit = float(trained.standardizer.mass) * trained.spacing ** (2 - bodies.dim) / dt**2
    constants = cast(Constants, bodies.constants[material])(params)
    layer = cast(BodyLayer, bodies.body_layer[material]).logarithm
    return {
        "constants": torch.cat([unit * constants[0], unit * constants[1], unit * dt * constants[2]]),
        "layer": torch.nn.functional.linear(params, layer["weight"], layer["bias"]),
    }


SOLID = scenes.metadata(("solid",))


@pytest.mark.parametrize(
    ("before", "now"),
    [
        (SOLID, SOLID),
        (SOLID, replace(SOLID, param_names=(E, NU))),
        (replace(SOLID, param_names=(E, NU)), SOLID),
        (SOLID, replace(SOLID, frame_dt=2 * SOLID.frame_dt)),
        (SOLID, replace(SOLID, spacing=2 * SOLID.spacing)),
        (SOLID, scenes.metadata(("solid",), dim=3)),
        (scenes.metadata(("solid",), dim=3), replace(scenes.metadata(("solid",), dim=3), spacing=0.1, param_names=(E, NU))),
        (SOLID, scenes.metadata(("elastomer",))),
    ],
)
def test_the_elastic_law_stays_the_same_in_pascal(before: Metadata, now: Metadata) -> None:
    """Whatever other parameters the data have, and whatever their scales and statistics."""
    trained = simulator(before, config=CELLS, **LAW)
    with torch.no_grad():
        for name, parameter in trained.model.named_parameters():
            if "logarithm" in name:
                parameter.add_(0.1 * torch.randn_like(parameter))
    new = simulator(now, 1, CELLS, **LAW)
    new.start_from(trained)
    for young in (5.0, 20.0):
        torch.testing.assert_close(law(new, young), law(trained, young), rtol=1e-4, atol=1e-6)
    assert abs(float((law(trained, 5.0)["constants"] / law(trained, 20.0)["constants"])[1].log())) > 1e-2


def test_a_law_that_goes_on_is_not_changed() -> None:
    trained, new = simulator(SOLID, config=CELLS, **LAW), simulator(SOLID, 1, CELLS, **LAW)
    new.start_from(trained)
    torch.testing.assert_close(new.model.state_dict(), trained.model.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("decoder", ["node", "pair"])
def test_a_known_material_moves_as_before_beside_a_heavier_new_one(decoder: str) -> None:
    trained, new = simulator(SAND, decoder=decoder), simulator(scenes.metadata(("sand", "fluid")), 1, decoder=decoder)
    new.standardizer.mass.mul_(3.0)
    trained.clamps_parameters = new.clamps_parameters = False
    with torch.no_grad():
        for parameter in trained.model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    new.start_from(trained)
    state, names = scenes.state(seed=5).to_torch(), new.builder.metadata.param_names
    params = torch.full((state.num_nodes, len(names)), torch.nan, dtype=torch.float64)
    params[:, names.index("friction_angle")] = state.material_params[:, 0]
    known = acceleration(trained, state)
    found = new(new.builder(replace(state, material_params=params))).acceleration["sand"] * new.acceleration_std
    assert float(known.detach().abs().max()) > 0.1
    torch.testing.assert_close(found, known, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("others", [("elastomer",), ("elastomer", "sand")])
def test_the_law_of_a_known_material_beside_new_ones_keeps_its_motion_and_stress(others: tuple[str, ...]) -> None:
    with_stress = {**LAW, "stress": True, "only_contacts": False, "island_momentum": "linear"}
    trained = simulator(SOLID, config=CELLS, **with_stress)
    new = simulator(scenes.metadata(("solid", *others)), 1, CELLS, **with_stress)
    new.standardizer.mass.mul_(3.0)
    trained.stress_std.fill_(50.0)
    new.stress_std.fill_(2e4)
    trained.clamps_parameters = new.clamps_parameters = False
    for one in (trained, new):
        one.set_units_of(one.model)
    with torch.no_grad():
        for parameter in trained.model.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    new.start_from(trained)
    state = scenes.mesh_state("triangles", ("solid",), seed=5)
    state = replace(state, pos=state.pos + 1e-3 * np.random.default_rng(0).normal(size=state.pos.shape)).to_torch()
    names = new.builder.metadata.param_names
    params = torch.full((state.num_nodes, len(names)), torch.nan, dtype=torch.float64)
    params[:, names.index(E)] = state.material_params[:, 0]
    before, after = trained.step(state), new.step(replace(state, material_params=params))
    assert before.stress is not None and after.stress is not None and float(before.stress.node.abs().max()) > 1.0
    torch.testing.assert_close(after.vel, before.vel, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(after.stress.node, before.stress.node, rtol=1e-3, atol=1e-4 * float(before.stress.node.abs().max()))


def test_ranges_of_known_parameters_cover_both_trainings() -> None:
    """Also if the data store other parameters besides."""
    trained = simulator(SAND)
    trained.get_buffer("trained_sand").copy_(torch.tensor([[10.0], [40.0]]))
    new = simulator(WITH_COHESION, 1)
    own = torch.tensor([[20.0, 1.0], [50.0, 2.0]], dtype=torch.float64)
    new.get_buffer("trained_sand").copy_(own)
    new.start_from(trained)
    assert new.get_buffer("trained_sand").tolist() == [[10.0, 1.0], [50.0, 2.0]]
    keep_trained_ranges(new, trained)
    assert new.get_buffer("trained_sand").tolist() == [[10.0, 1.0], [40.0, 2.0]]
    fewer = simulator(SAND, 1)
    fewer.get_buffer("trained_sand").copy_(own[:, :1])
    fewer.start_from(new)
    assert fewer.get_buffer("trained_sand").tolist() == [[10.0], [50.0]]


@pytest.mark.parametrize("model", [GPE, GNS])
@pytest.mark.parametrize("scales", ["dimensional", "dimensionless"])
def test_ranges_of_scales_cover_both_trainings(model: type[Model], scales: Literal["dimensional", "dimensionless"]) -> None:
    config = GraphConfig(history=1, islands=True, scales=scales)
    trained, new = (simulator(SAND, seed, config, model) for seed in (0, 1))
    trained.trained_scales.copy_(torch.tensor([[0.05, 0.005], [0.1, 0.01]]))
    new.trained_scales.copy_(torch.tensor([[0.02, 0.005], [0.05, 0.02]]))
    both = torch.stack([new.trained_scales[0], torch.tensor([0.1, 0.02])])
    new.start_from(trained)
    torch.testing.assert_close(new.trained_scales, both.double(), check_dtype=False)
    keep_trained_ranges(new, trained)
    assert torch.equal(new.trained_scales, trained.trained_scales)


@pytest.mark.parametrize("change", [{"frame_dt": 0.01}, {"spacing": 0.1}])
def test_several_scales_relative_to_others_are_refused(change: dict[str, Any]) -> None:
    config, other = GraphConfig(history=1, islands=True, scales="dimensionless"), replace(SAND, **change)
    here = f"{other.spacing:g} m and {other.frame_dt:g} s"
    message = rf"spacing=0.05 m and frame_dt=0.005 s \(graph.scales=dimensionless\), those of the new one to {here}; .*gpe_pl.evaluate"
    assert_refused(simulator(other, 1, config), simulator(SAND, config=config), message)
    assert_refused(simulator(other, 1), simulator(SAND, config=config), message)


@pytest.mark.parametrize("model", [GPE, GNS])
@pytest.mark.parametrize(("scale", "other", "read"), [(None, "linear", "the logarithm"), ("linear", None, "the value")])
def test_another_scale_of_a_copied_parameter_is_refused(model: type[Model], scale: Any, other: Any, read: str) -> None:
    fluid, sand = scenes.metadata(("fluid",)), SAND
    before, now = (GraphConfig(history=1, islands=True, parameter_scale=s) for s in (scale, other))
    message = f"reads {read} of kinematic_viscosity of fluid; choose graph.parameter_scale={scale or 'null'}$"
    assert_refused(simulator(fluid, 1, now, model), simulator(fluid, config=before, model=model), message)
    simulator(sand, 1, now, model).start_from(simulator(sand, config=before, model=model))  # its parameter has no logarithmic scale


def test_materials_take_the_weights_of_their_kind() -> None:
    assert source_materials(("snow", "elastomer"), ("sand", "solid")) == {"snow": "sand", "elastomer": "solid"}
    assert source_materials(("snow", "sand"), ("sand", "snow")) == {"snow": "snow", "sand": "sand"}
    assert source_materials(("elastomer",), ("sand", "snow")) == {"elastomer": "sand"}


def test_only_early_layers_and_new_weights_are_trained() -> None:
    sand, snow = simulator(scenes.metadata(("sand",))), simulator(scenes.metadata(("snow",)), seed=1)
    model, new = snow.model, snow.start_from(sand).new
    train_only(model, model.early_layers(1), new.values())
    trained = {name.split(".")[0] + "." + name.split(".")[1] for name, p in model.named_parameters() if p.requires_grad}
    assert trained == {"material_embedding.snow", "node_encoder.snow", "node_encoder.boundary", "edge_encoder.boundary__radius__snow",
                       "edge_encoder.snow__radius__snow", "convs.0", "updates.0"}  # fmt: skip
    train_only(model, model.early_layers(0), [dict(model.named_parameters())["node_decoder.snow.0.weight"]])
    assert {name for name, p in model.named_parameters() if p.requires_grad and "encoder" not in name} == {
        "material_embedding.snow.theta.weight", "material_embedding.snow.theta.bias", "node_decoder.snow.0.weight"
    }  # fmt: skip


@pytest.mark.parametrize("model", [GNS, ContinuousConvNet, DPINet])
def test_early_layers_of_other_models(model: Any) -> None:
    made = model(scenes.builder(history=1).spec)
    if model is DPINet:
        with pytest.raises(LayersError, match="choose training.early_layers=null"):
            made.early_layers(1)
        return
    count = [sum(p.numel() for layer in made.early_layers(n) for p in layer.parameters()) for n in (0, 1, 2, 99)]
    assert 0 < count[0] < count[1] < count[2] <= count[3] <= sum(p.numel() for p in made.parameters())


def test_a_model_that_is_not_trained_keeps_its_rollout_settings() -> None:
    trained, wide = simulator(scenes.metadata(("sand",))), replace(scenes.metadata(("sand",)), spacing=2 * scenes.SPACING)
    trained.static_friction, trained.mirror_average, trained.least_distance = 0.3, True, 0.01
    new = simulator(wide, seed=1)
    new.start_from(trained)
    assert (new.static_friction, new.mirror_average, new.least_distance) == (0.0, False, 0.0)
    keep_rollout_settings(new, trained)
    assert (new.static_friction, new.mirror_average, new.least_distance) == (0.3, True, 0.02)
    for k, each in enumerate((trained, new)):
        dict(each.trained_ranges())["sand"].copy_(torch.tensor([[20.0 + 20 * k], [40.0 + 20 * k]]))
        each.trained_mass.copy_(torch.tensor([[1.0 + k], [2.0 + k]]))
    keep_trained_ranges(new, trained)
    assert dict(new.trained_ranges())["sand"].tolist() == [[20.0], [40.0]]
    assert new.trained_mass.tolist() == [[1.0], [2.0]]
    without_islands = simulator(scenes.metadata(("sand",)), config=GraphConfig(history=1))
    keep_rollout_settings(without_islands, trained)
    assert without_islands.static_friction == 0.0 and without_islands.least_distance == 0.01
