"""Loss, learning-rate schedules and weight averaging compared with their formulas."""

from __future__ import annotations

import itertools
import math
import re
from types import SimpleNamespace
from typing import Any

import lightning as L
import pytest
import torch
from torch import nn
from torch_geometric.data import Batch, HeteroData

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.training.callbacks import WarmAverage
from gpe_pl.training.loss_terms import mean_num_neighbors
from gpe_pl.training.module import TrainingError, TrainingModule
from tests import scenes

MATERIALS = ("sand", "snow")


def module(num_steps: int = 1000, **settings: Any) -> TrainingModule:
    build = scenes.builder(MATERIALS, history=1)
    torch.manual_seed(0)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build)
    simulator.acceleration_std.fill_(5.0)
    return TrainingModule(simulator, num_steps, **settings)


def batch(count: int = 2) -> HeteroData:
    graphs = []
    for k in range(count):
        graph = scenes.builder(MATERIALS, history=1)(scenes.state(20 + 6 * k, MATERIALS, seed=k).to_torch())
        for m in MATERIALS:
            graph[m].target = torch.randn(graph[m].x.shape[0], 2, generator=torch.Generator().manual_seed(k))
        graph.trajectory, graph.frame = 7 + k, 30 + k
        graphs.append(graph)
    return Batch.from_data_list(graphs)


def rates(m: TrainingModule, steps: list[int]) -> list[float]:
    return [m.learning_rate * m.learning_rate_factor(s) for s in steps]


def test_the_papers_schedule_decays_geometrically() -> None:
    m = module(1000, schedule="exponential", learning_rate=5e-5, final_learning_rate=1e-6, warmup_steps=100)
    assert rates(m, [0, 500, 1000]) == pytest.approx([5e-5, math.sqrt(5e-5 * 1e-6), 1e-6])
    assert rates(m, [5000]) == pytest.approx([1e-6])
    ratios = [m.learning_rate_factor(s + 1) / m.learning_rate_factor(s) for s in range(0, 1000, 97)]
    assert ratios == pytest.approx([ratios[0]] * len(ratios))


def test_the_cosine_schedule_warms_up_and_ends_at_the_final_rate() -> None:
    m = module(1000, schedule="cosine", learning_rate=1e-3, final_learning_rate=1e-5, warmup_steps=100)
    assert rates(m, [0, 49, 99]) == pytest.approx([1e-5, 5e-4, 1e-3])  # linear
    assert rates(m, [100, 550, 1000, 2000]) == pytest.approx([1e-3, (1e-3 + 1e-5) / 2, 1e-5, 1e-5])
    falling = rates(m, list(range(100, 1001)))
    assert all(a > b for a, b in itertools.pairwise(falling))


def test_the_staircase_falls_by_equal_factors_in_the_second_half() -> None:
    m = module(50_000, schedule="staircase", learning_rate=1e-3, final_learning_rate=1e-3 / 32)
    assert rates(m, [0, 24_999, 25_000, 29_999, 30_000, 35_000, 40_000, 44_999, 45_000, 60_000]) == pytest.approx(
        [1e-3, 1e-3, 5e-4, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5, 6.25e-5, 3.125e-5, 3.125e-5]
    )


@pytest.mark.parametrize("schedule", ["cosine", "exponential", "staircase"])
@pytest.mark.parametrize(("num_steps", "warmup_steps"), [(1, 0), (1, 100), (100, 100), (50, 100), (10, 0)])
def test_every_rate_is_positive_and_at_most_the_initial_one(schedule: Any, num_steps: int, warmup_steps: int) -> None:
    m = module(num_steps, schedule=schedule, warmup_steps=warmup_steps)
    assert all(0 < m.learning_rate_factor(s) <= 1 for s in range(num_steps + 1))


def test_the_optimizer_follows_the_schedule() -> None:
    m = module(10, schedule="exponential", learning_rate=1e-2, final_learning_rate=1e-4)
    configured = m.configure_optimizers()
    optimizer, scheduler = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    assert configured["lr_scheduler"]["interval"] == "step"
    seen = []
    for _ in range(10):
        seen.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    assert seen == pytest.approx(rates(m, list(range(10))))
    assert {id(p) for g in optimizer.param_groups for p in g["params"]} == {id(p) for p in m.simulator.parameters()}


def test_the_loss_is_the_mean_over_all_nodes_and_axes_of_both_materials() -> None:
    m, data = module(), batch()
    predicted = m.simulator(data).acceleration
    errors = [
        float((predicted[t][i, d].detach() - data[t].target[i, d] / 5.0) ** 2)
        for t in MATERIALS
        for i in range(data[t].x.shape[0])
        for d in (0, 1)
    ]
    assert len(errors) == 2 * (20 + 26)
    assert m.loss(data).item() == pytest.approx(sum(errors) / len(errors), rel=1e-5)


def test_the_logarithmic_loss_is_the_square_of_small_errors_and_the_logarithm_of_large_ones() -> None:
    data = batch()
    square, logarithm = (module(loss=name) for name in ("square", "log"))
    error = (square.simulator(data).acceleration["sand"] - data["sand"].target / 5.0).detach()
    data["snow"].target = 5.0 * square.simulator(data).acceleration["snow"].detach()
    assert square.loss(data).item() == pytest.approx(error.square().sum().item() / (2 * 46), rel=1e-5)
    assert logarithm.loss(data).item() == pytest.approx(0.01 * (1 + 100.0 * error.square()).log().sum().item() / (2 * 46), rel=1e-5)


def test_the_root_loss_and_weights_by_neighbours_follow_their_formulas() -> None:
    m, data = module(loss="root", neighbor_weight=0.7, mean_neighbors=3.0), batch()
    predicted = m.simulator(data).acceleration
    neighbors = {t: [0] * data[t].x.shape[0] for t in MATERIALS}
    for source, name, target in data.edge_types:
        if name == "radius" and source in MATERIALS:
            for j, i in data[source, name, target].edge_index.T.tolist():
                neighbors[source][j] += 1
                neighbors[target][i] += 1
    least = 6.3e-4 * scenes.SPACING / 0.005**2 / 5.0  # of a position, in units of the acceleration scale times the squared frame interval
    errors = [
        math.exp(-0.7 * neighbors[t][i] / 3.0)
        * (float((predicted[t][i].detach() - data[t].target[i] / 5.0).square().sum()) + least**2) ** 0.25
        for t in MATERIALS
        for i in range(data[t].x.shape[0])
    ]
    assert len({n for t in MATERIALS for n in neighbors[t]}) > 3
    assert m.loss(data).item() == pytest.approx(sum(errors) / len(errors), rel=1e-5)
    counts = [n for t in MATERIALS for n in neighbors[t]]
    assert mean_num_neighbors([data], MATERIALS) == pytest.approx(sum(counts) / len(counts))


@pytest.mark.parametrize("loss", ["square", "log", "root"])
def test_errors_along_given_axes_do_not_count(loss: str) -> None:
    m, data = module(loss=loss), batch()
    for material in MATERIALS:
        held = torch.zeros_like(data[material].target, dtype=torch.bool)
        held[::2, 1] = True
        data[material].prescribed = held
    before = m.loss(data)
    for material in MATERIALS:
        data[material].target = torch.where(data[material].prescribed, 100.0, data[material].target)
    torch.testing.assert_close(m.loss(data), before)
    data["sand"].target = data["sand"].target + 1.0
    assert not torch.isclose(m.loss(data), before)


def test_the_validation_error_is_relative_to_predicting_free_fall() -> None:
    m, data = module(), batch()
    with torch.no_grad():
        for p in m.simulator.model.parameters():
            p.zero_()
    m.validation_step(data, 0)
    assert float(m.val_nmse.compute()) == pytest.approx(1.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_names_step_trajectories_and_frames(value: float, caplog: pytest.LogCaptureFixture) -> None:
    m, data = module(), batch()
    data["sand"].target[3, 1] = value
    m._trainer = SimpleNamespace(global_step=41)  # type: ignore[assignment]
    named = rf"step 41: the loss is {value} for \(trajectory, frame\) = \(7, 30\), \(8, 31\)"
    for _ in range(2):
        assert m.training_step(data, 0) is None
    assert all(re.search(rf"{named}; training continues without this batch", r.message) for r in caplog.records)
    assert len(caplog.records) == 2
    with pytest.raises(TrainingError, match=rf"{named}, as in 2 other batches since step 41\. Lower training.learning_rate"):
        m.training_step(data, 0)


def test_a_batch_of_nodes_without_neighbours_teaches_nothing() -> None:
    """With forces between pairs, such nodes fall freely for any weights."""
    build = scenes.builder(MATERIALS, history=1)
    simulator = LearnedSimulator(GPE(build.spec, decoder="pair", num_message_passing_steps=1, hidden_channels=8), build)
    m = TrainingModule(simulator, 10)
    m._trainer = SimpleNamespace(global_step=0, log_every_n_steps=50)  # type: ignore[assignment]
    alone = batch()
    for relation in alone.edge_types:
        for name in ("edge_index", "edge_attr", "odd", "even"):
            if name in alone[relation]:
                alone[relation][name] = alone[relation][name][..., :0] if name == "edge_index" else alone[relation][name][:0]
    loss = m.training_step(alone, 0)
    assert loss is not None and loss > 0
    loss.backward()
    assert all(p.grad is not None and not p.grad.any() for p in simulator.parameters())


def test_many_bad_batches_end_a_run() -> None:
    m, data = module(), batch()
    data["sand"].target[3, 1] = torch.nan
    for step in range(0, 50, 5):
        m._trainer = SimpleNamespace(global_step=step)  # type: ignore[assignment]
        assert m.training_step(data, 0) is None
    m._trainer = SimpleNamespace(global_step=50)  # type: ignore[assignment]
    with pytest.raises(TrainingError, match="as in 10 other batches since step 0"):
        m.training_step(data, 0)


@pytest.mark.slow
def test_bad_batches_far_apart_do_not_add_up() -> None:
    m, data = module(), batch()
    data["sand"].target[3, 1] = torch.nan
    for step in range(0, 1000, 11):
        m._trainer = SimpleNamespace(global_step=step)  # type: ignore[assignment]
        assert m.training_step(data, 0) is None


# --- weight averaging ----------------------------------------------------------------------------------------------------------------------


def averaging(model: Network, decay: float) -> WarmAverage:
    callback = WarmAverage(decay)
    callback.setup(L.Trainer(logger=False, enable_checkpointing=False), model, "fit")
    return callback


def update(callback: WarmAverage, model: Network, step: int) -> None:
    callback.on_train_batch_end(SimpleNamespace(global_step=step), model, None, None, step - 1)  # type: ignore[arg-type]


class Network(L.LightningModule):
    """Module with weights, a constant of another precision, and an integer."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.weight = nn.Parameter(torch.randn(2, 3))
        self.register_buffer("scale", torch.tensor(2.0, dtype=torch.float64))
        self.register_buffer("count", torch.tensor(3))


def test_averaging_constant_weights_changes_nothing() -> None:
    model = Network()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    callback = averaging(model, 0.999)
    for step in range(1, 20):
        update(callback, model, step)
    assert callback._average_model is not None
    for key, value in callback._average_model.module.state_dict().items():
        assert torch.equal(value, before[key]), key


def test_the_average_follows_the_weights_to_another_device() -> None:
    model = Network()
    callback = averaging(model, 0.999)
    model.to("meta")  # Lightning moves the weights after ``setup``
    callback.on_fit_start(L.Trainer(logger=False, enable_checkpointing=False), model)
    assert callback._average_model is not None
    assert {p.device.type for p in callback._average_model.module.parameters()} == {"meta"}


def test_rollouts_during_a_validation_have_the_averaged_weights() -> None:
    m, callback = module(), WarmAverage(0.9)
    callback.setup(L.Trainer(logger=False, enable_checkpointing=False), m, "fit")
    with torch.no_grad():
        for parameter in m.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)), alpha=0.1)
    state, simulator = scenes.state(20, MATERIALS, history=1).to_torch(), m.simulator.eval()
    found = [simulator.step(state).pos]
    for _ in range(2):
        callback._swap_models(m)
        found.append(simulator.step(state).pos)
    assert torch.equal(found[0], found[2]) and not torch.equal(found[0], found[1])
    expected = module().simulator.eval().step(state).pos  # the averages are still the weights of the start
    torch.testing.assert_close(found[1], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("decay", [0.0, 0.3, 0.999])
def test_the_decay_warms_up(decay: float) -> None:
    model = Network()
    callback = averaging(model, decay)
    expected = None
    for step in range(1, 30):
        with torch.no_grad():
            model.weight.fill_(float(step))
        update(callback, model, step)
        n = step - 1  # averages so far; the first is a copy
        d = min(decay, (1 + n) / (10 + n))
        expected = float(step) if expected is None else d * expected + (1 - d) * step
        assert callback._average_model is not None
        torch.testing.assert_close(callback._average_model.module.weight, torch.full((2, 3), expected), rtol=1e-5, atol=1e-6)
    assert expected is not None
    assert expected == 29 if decay == 0 else 1 < expected < 29


@pytest.mark.parametrize(("clip", "norm"), [(None, 5.0), (2.0, 2.0)])
def test_gradients_are_clipped_only_if_that_is_wanted(clip: float | None, norm: float) -> None:
    m = module()
    first = next(p for p in m.simulator.parameters() if p.requires_grad)
    first.grad = torch.zeros_like(first)
    first.grad.view(-1)[:2] = torch.tensor([3.0, 4.0])
    m.configure_gradient_clipping(torch.optim.Adam(m.parameters()), clip)
    assert float(first.grad.norm()) == pytest.approx(norm)


def test_a_gradient_that_is_not_finite_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    """An infinite slope at a finite loss: the weights must not see it."""
    m = module()
    parameter = next(p for p in m.simulator.parameters() if p.requires_grad)
    before = parameter.detach().clone()
    parameter.grad = torch.full_like(parameter, float("nan"))
    m._windows = [(3, 17)]
    optimizer = torch.optim.Adam(m.parameters())
    m.configure_gradient_clipping(optimizer, 1.0)
    optimizer.step()
    assert "gradient norm is nan for (trajectory, frame) = (3, 17)" in caplog.text
    assert torch.equal(parameter, before)


def test_numbers_of_graphs_that_were_built_on_a_gpu_meet_errors_there() -> None:
    m, data, other = module(), HeteroData(), torch.device("meta")  # a device that every machine has, with shapes and without values
    m._device = other
    data.weight, data["sand"].batch = torch.ones(2), torch.zeros(5, dtype=torch.int64, device=other)
    (weighted,) = m._weighted(data, ["sand"], [torch.zeros(5, 2, device=other)])
    assert weighted.device == other and weighted.shape == (5, 2)
