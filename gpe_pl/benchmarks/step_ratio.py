"""Time of a rollout step of the shipped models over the time of its matrix products.

The step is a frame of a rollout as ``evaluate`` makes it: search, features, network, integration, containment, guard and recording. The scene is a
trajectory of the solver, at a frame with contacts. For comparison, the same step is timed with two other networks, with the same search and features.
"""

from __future__ import annotations

import copy
import logging
import time
from math import inf
from typing import Any, cast

import torch

from gpe_pl.benchmarks.matrix_products import product_rate, products
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gns import GNS
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

log = logging.getLogger(__name__)

FRAME = 60
"""Frame at which rollouts start."""
NUM_STEPS = 5
"""Number of frames of a timed rollout."""
NOTE = (
    "Rollout step: search, features, network, integration, containment, guard and recording, in the scene of a shipped model. Products: those of the factored "
    "network at the rate measured for its nodes. Both are the shortest of all rounds. Faster than plain: the time with the same model and weights by PyG's "
    "operations (`implementation=plain`), over that of the step. Than GNS: the time with an untrained GNS of the same width and depth, over that of the step. "
    "Both have the same search and features."
)


class StepError(GpeError, RuntimeError):
    """Raised when a rollout that is timed stops early."""


def start_of(simulator: LearnedSimulator, spec: DatasetSpec) -> tuple[State, Metadata]:
    """Return the state of a test scene at ``FRAME``, and the metadata of the scene."""
    truth = generate_trajectory(spec, "test", 0, num_frames=FRAME + 1)
    return simulator.initial_state(truth, FRAME), truth.metadata


def step_records(specs: dict[str, DatasetSpec], num_rounds: int) -> list[dict[str, Any]]:
    """Return records of every shipped model: the time of a step [s], that of its products [s], and their ratio ``step_ratio``.

    Two more records divide other times by that of the step: ``step_speedup_vs_plain`` that of the same model computed with PyG's operations, and
    ``step_speedup_vs_gns`` that of GNS of the same width and depth. Times are the shortest of all rounds, because other work on the machine only makes them
    longer.

    Args:
        specs: data set of each shipped model, by its name.
        num_rounds: number of timed rollouts.
    """
    records: list[dict[str, Any]] = []
    for name, spec in specs.items():
        simulator = LearnedSimulator.from_checkpoint(name)
        state, metadata = start_of(simulator, spec)
        model, graph = cast(GPE, simulator.model), simulator.builder(state)
        simulators = {"model": simulator} | _others(simulator)
        steps, rate = dict.fromkeys(simulators, inf), 0.0
        for k in range(num_rounds + 1):
            for which, other in simulators.items():
                seconds = _seconds_per_frame(other, state, metadata)
                steps[which] = min(steps[which], seconds) if k else inf  # the first round loads compiled code
            rate = max(rate, product_rate(model, graph))
        step, floor = steps.pop("model"), products(model, graph) / rate
        log.info("%s: a step takes %.2f ms, %.1f times its products", name, 1e3 * step, step / floor)
        values = {"step_time": (step, "s"), "product_time": (floor, "s"), "step_ratio": (step / floor, "1")}
        values |= {f"step_speedup_vs_{which}": (seconds / step, "1") for which, seconds in steps.items()}
        records += [{"metric": metric, "case": name, "value": value, "unit": unit} for metric, (value, unit) in values.items()]
    return records


def _others(simulator: LearnedSimulator) -> dict[str, LearnedSimulator]:
    """Return simulators with the same search and features: the same model by PyG's operations, and GNS of the same width and depth."""
    model = cast(GPE, simulator.model)
    plain = GPE(model.spec, **(model.settings | {"implementation": "plain"}))
    plain.load_state_dict(model.state_dict())
    sizes = {key: model.settings[key] for key in ("num_message_passing_steps", "hidden_channels")}
    gns = GNS(model.spec, **sizes)
    torch.nn.init.zeros_(cast(torch.nn.Linear, gns.decoder[-1]).weight)  # an untrained model would throw the nodes about
    found = {}
    for name, network in (("plain", plain), ("gns", gns)):
        found[name] = copy.deepcopy(simulator)
        found[name].model = network.eval()
        found[name].skips = simulator.skips
    return found


def _seconds_per_frame(simulator: LearnedSimulator, state: State, metadata: Metadata) -> float:
    """Return the time of a frame of a short rollout [s]."""
    margin = max(high - low for low, high in metadata.bounds)
    guard = Guard(max_speed=1e3, bounds=metadata.bounds, margin=margin, spacing=metadata.spacing)
    started = time.perf_counter()
    stop = rollout(Contained(simulator, metadata.frame_dt), state, NUM_STEPS, metadata, guard).termination
    if stop is not None:
        raise StepError(
            f"{metadata.dataset}: a rollout of {NUM_STEPS} frames stopped and was not timed ({stop.message}); check the checkpoint"
        )
    return (time.perf_counter() - started) / NUM_STEPS


def step_table(records: list[dict[str, Any]]) -> str:
    """Return a Markdown table of these records."""
    values: dict[str, dict[str, float]] = {}
    for record in records:
        values.setdefault(record["case"], {})[record["metric"]] = record["value"]
    lines = [
        table_row(
            [name, f"{1e3 * v['step_time']:.2f}", f"{1e3 * v['product_time']:.2f}"]
            + [f"{v[key]:.1f}" for key in ("step_ratio", "step_speedup_vs_plain", "step_speedup_vs_gns")]
        )
        for name, v in values.items()
    ]
    header = table_row(["shipped model", "rollout step [ms]", "its products [ms]", "ratio", "faster than plain", "than GNS"])
    return "\n".join([header, "|---|---|---|---|---|---|", *lines, "", NOTE])
