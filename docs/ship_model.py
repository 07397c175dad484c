"""Make a trained run one of the models that come with the package.

``python docs/ship_model.py RUN_FOLDER NAME COMMIT 'COMMAND' DATA_FOLDER`` writes weights without the optimiser's state, with the static friction that suits
the data set, and a model card with its errors on the data set's test splits to ``gpe_pl/pretrained``. COMMAND is what trained it, with the code of COMMIT.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from gpe_pl.containment import Contained
from gpe_pl.data.dataset import long_enough
from gpe_pl.evaluation import EvaluationSettings, Row, evaluate
from gpe_pl.learned_simulator import LearnedSimulator
from gpe_pl.metrics import displacement
from gpe_pl.pretrained import FOLDER
from gpe_pl.report import summary
from gpe_pl.rollout import Start, rollouts
from gpe_pl.schema import MATERIALS

STATIC_FRICTIONS = (0.01, 0.0075, 0.005, 0.003)
"""In rest spacings per frame; the first that costs no accuracy is taken."""
MAX_COST = 1.01
"""Mean rollout error with static friction over that without."""


def static_friction(simulator: LearnedSimulator, root: Path) -> float:
    """The largest static friction that leaves rollouts of the validation split as accurate as they are without; 0 where liquid flows, which has none."""
    if "fluid" in simulator.builder.metadata.materials:
        return 0.0
    simulator.static_friction = 0.0
    limit = MAX_COST * rollout_error(simulator, root)
    for speed in STATIC_FRICTIONS:
        simulator.static_friction = speed
        if rollout_error(simulator, root) <= limit:
            return speed
    return 0.0


def rollout_error(simulator: LearnedSimulator, root: Path) -> float:
    """Mean squared distance [m²] from the validation split, over whole rollouts."""
    history = simulator.builder.config.history
    truths = list(long_enough(root, "val", history))
    starts = [Start(simulator.initial_state(t, history), t.num_frames - 1 - history, t.metadata, None) for t in truths]
    results = rollouts(Contained(simulator, simulator.builder.metadata.frame_dt), starts)
    errors = [
        np.square(displacement(r.pos, t.pos[history:], t.metadata)).sum(axis=-1).mean()
        if r.num_frames == t.num_frames - history
        else np.inf
        for r, t in zip(results, truths, strict=True)
    ]
    return float(np.mean(errors))


def card(name: str, command: str, commit: str, simulator: LearnedSimulator, rows: list[Row], settings: dict[str, object]) -> str:
    """The model card."""
    metadata, model = simulator.builder.metadata, type(simulator.model).__name__
    size = sum(p.numel() for p in simulator.parameters())
    ranges = []
    for material, count in simulator.builder.spec.param_channels.items():
        low, high = simulator.get_buffer(f"trained_{material}").tolist() if count else ([], [])
        ranges += [
            f"| {MATERIALS[material].name} of {material} | {a:g} – {b:g} {MATERIALS[material].unit} |"
            for a, b in zip(low, high, strict=True)
        ]
    speed = simulator.static_friction
    held = f"what lies on walls and is slower than {speed:g} spacings per frame is held" if speed else "none"
    training = settings["training"]
    assert isinstance(training, dict)
    lines = [
        f"# {name}",
        "",
        f"{model} with {size:,} parameters, for {', '.join(metadata.materials)} in {metadata.dim}D: data set `{metadata.dataset}`, "
        f"frames of {1e3 * metadata.frame_dt:g} ms, nodes {metadata.spacing:.4g} m apart. Other frame intervals and spacings are refused.",
        "",
        f"Trained with `{command}` (commit {commit}), {training['num_steps']:,} steps of {training['batch_size']} graphs.",
        "",
        "| trained range | |",
        "|---|---|",
        *ranges,
        "",
        f"Static friction (`evaluation.static_friction`): {held}.",
        "",
        "Values outside are warned of; the errors below say what to expect.",
        "",
        "```",
        summary(rows),
        "```",
        "",
        "It knows boxes with the obstacles of that data set. Fracture, other contact laws and other materials are beyond it.",
    ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> int:
    """Write checkpoint and card; the exit status."""
    run, (name, commit, command, data) = Path(arguments[0]), arguments[1:]
    simulator = LearnedSimulator.from_checkpoint(run / "checkpoints" / "best.ckpt")
    settings = json.loads((run / "config.json").read_text())
    simulator.static_friction = static_friction(simulator, Path(data))
    simulator.save(FOLDER / f"{name}.ckpt")
    with tempfile.TemporaryDirectory() as folder:
        rows = evaluate(simulator, Path(data), EvaluationSettings(num_pictures=0, num_uncontained=0), Path(folder))
    (FOLDER / f"{name}.md").write_text(card(name, command, commit, simulator, rows, settings))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
