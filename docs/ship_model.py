"""Add a trained run to the shipped models.

``python docs/ship_model.py RUN_FOLDER NAME COMMIT 'COMMAND'`` writes weights without the optimiser's state, and a model card whose numbers are the run's
own, to ``gpe_pl/learned/pretrained``. COMMAND is what trained it, with the code of COMMIT.

``python docs/ship_model.py RUN_FOLDER/checkpoints/last.ckpt NAME COMMIT 'COMMAND' EVALUATION…`` ships the last checkpoint instead of the best one. The numbers
are those of folders in which ``python -m gpe_pl.evaluate`` evaluated this checkpoint.

``python docs/ship_model.py --verdicts RUN_FOLDER`` takes the results of ``python -m gpe_pl.benchmark suite=acceptance`` or ``suite=stability size=small`` on
shipped models from the suite's folder, stores them beside the checkpoints, and begins the cards with what fails.

``python docs/ship_model.py --static-friction NAME FRACTION`` sets the static friction of a shipped model and says so on its card. Run both suites again.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from gpe_pl.evaluation.metric_rows import LEARNED, Row, read_rows
from gpe_pl.learned import verdicts
from gpe_pl.learned.pretrained import BEST, FOLDER, fingerprint
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.verdicts import Suite
from gpe_pl.reports.domain_table import EVALUATED, NOT_LEARNED
from gpe_pl.reports.finished_runs import Run, rollout_errors, shared_table, table_of, values_by_seed
from gpe_pl.reports.sweep_table import summary

SUITES: tuple[Suite, ...] = ("acceptance", "stability")
BASELINE_NAMES = {"ballistic": "ballistic flight", "stops_at_walls": "nodes that stop at walls", "constant_velocity": "constant velocity"}
TRIED = "The guide's pages on stress tests, acceptance and stability say what failures mean, and what was tried."
REFUSED = "Other frame intervals and spacings are refused."


def card(
    name: str, command: str, commit: str, simulator: LearnedSimulator, rows: list[Row], settings: dict[str, object], is_last: bool = False
) -> str:
    """The model card; ``is_last``: the weights are those after the last step, not those with the best validation."""
    metadata, model = simulator.builder.metadata, type(simulator.model).__name__
    size = sum(p.numel() for p in simulator.parameters())
    ranges = [f"| {kind} | {values} |" for kind, values in simulator.described_training()]
    training = settings["training"]
    assert isinstance(training, dict)
    lines = [
        *_opening(name, verdicts.NOT_MEASURED),
        f"{model} with {size:,} parameters, for {', '.join(metadata.materials)} in {metadata.dim}D: data set `{metadata.dataset}`, "
        f"frames of {1e3 * metadata.frame_dt:g} ms, nodes {metadata.spacing:.4g} m apart. {REFUSED}{_law(simulator)}{_resting(simulator)}",
        "",
        f"Trained with `{command}` (commit {commit}), {training['num_steps']:,} steps of {training['batch_size']} graphs."
        f"{' These are the weights after the last step, not those with the best validation.' if is_last else ''}",
        "",
        "| trained range | |",
        "|---|---|",
        *ranges,
        "",
        f"Values outside are warned of; the errors below say what to expect.{_clamping(settings)} {_against_baselines(rows)}{_bodies(rows)}",
        "",
        "```",
        summary(table_of(rows)),
        "```",
        "",
        "It knows boxes with the obstacles of that data set. Fracture, other contact laws and other materials are beyond it.",
    ]
    return "\n".join(lines) + "\n"


def _law(simulator: LearnedSimulator) -> str:
    """Sentences on a model that is told the form of a law."""
    if not simulator.model.settings.get("elastic"):
        return ""
    return " It is given the form of the solver's elastic law and learned its constants. It cannot be exported as a program, and refuses walls that move."


def _resting(simulator: LearnedSimulator) -> str:
    """Sentence on a model that keeps slow nodes on walls in place."""
    fraction = simulator.static_friction
    if not fraction:
        return ""
    return (
        f" Its static friction is {fraction:g}: a node at rest on a wall moves only if the unbalanced part of gravity exceeds this fraction, and walls push "
        "and rub by Coulomb's law. The errors below were measured without it."
    )


def _clamping(settings: dict[str, object]) -> str:
    """Sentence on an evaluation that did not clamp material parameters, as rollouts do by default."""
    evaluation = settings.get("evaluation")
    is_default = not isinstance(evaluation, dict) or evaluation.get("clamp_parameters", True)
    return "" if is_default else " They were measured with `evaluation.clamp_parameters=false`."


def _against_baselines(rows: list[Row]) -> str:
    """What comparisons ask before they say that a model has learned something, by their rule."""
    run = Run(Path(), {}, table_of(rows))
    learned = shared_table(rollout_errors([run], EVALUATED, "full"))
    trivial = {name: shared_table(values_by_seed([run], name, EVALUATED, "rollout_mse", "full")) for name in BASELINE_NAMES}
    error, name = min((float(table.mean()), name) for name, table in trivial.items() if table.size)
    verdict = "" if learned.mean() * NOT_LEARNED <= error else ": comparisons would call it *not learned*"
    failed = int(
        np.sum([not np.isfinite(v) for seed in values_by_seed([run], LEARNED, EVALUATED, "rollout_mse", "full") for v in seed.values()])
    )
    counted = f" {failed} of {learned.size} failed and count as ballistic flight." if failed else ""
    return f"Whole rollouts of `{EVALUATED}` have {100 * learned.mean() / error:.2g} % of the mean error of {BASELINE_NAMES[name]}{verdict}.{counted}"


def _bodies(rows: list[Row]) -> str:
    """Sentence on how bodies bend and bounce, with medians, because a ratio can be infinite; empty for particles."""
    named = {
        "deformation_ratio": "deformation",
        "strain_energy_ratio": "strain energy",
        "bounce_height_ratio": "bounce height",
        "peak_von_mises_ratio": "peak stress",
    }
    medians = {}
    for metric, name in named.items():
        found = [r.value for r in rows if (r.model, r.metric, r.horizon) == (LEARNED, metric, "full") and r.split == EVALUATED]
        if found:
            medians[name] = f"{name} {np.median(found):.2f}"
    return f" Medians over these rollouts, relative to the ground truth: {', '.join(medians.values())}." if medians else ""


def _opening(name: str, headline: str) -> list[str]:
    """The first lines of a card: what fails, and where the guide says what was tried against it."""
    said = f"**{headline[0].upper()}{headline[1:].replace('|', '/').replace('*', '')}.**"
    return [f"# {name}", "", f"{said}\n{TRIED}" if "ails " in headline else said, ""]


def shipped(run: Path, name: str, commit: str, command: str, *evaluations: str) -> None:
    """Write checkpoint and card of a run's best checkpoint, or of another file in the run's folder ``checkpoints`` that was evaluated.

    Raises:
        ValueError: an evaluation is of another checkpoint, or there is none of this checkpoint.
    """
    checkpoint = run if run.is_file() else run / BEST
    folder, simulator = checkpoint.parent.parent, LearnedSimulator.from_checkpoint(checkpoint)
    if checkpoint.name != BEST.name and not evaluations:
        raise ValueError(f"{checkpoint}: name folders with evaluations of this checkpoint")
    settings, own = json.loads((folder / "config.json").read_text()), [*map(Path, evaluations)]
    for evaluation in own:
        config = json.loads((evaluation / "config.json").read_text())
        if config["checkpoint"] != fingerprint(checkpoint):
            raise ValueError(f"{evaluation}: evaluates {config['checkpoint']}, not {fingerprint(checkpoint)}")
        settings["evaluation"] = config["evaluation"]
    rows = [row for found in own or [folder] for row in read_rows(found / "metrics.csv")]
    simulator.save(FOLDER / f"{name}.ckpt")
    (FOLDER / f"{name}.md").write_text(card(name, command, commit, simulator, rows, settings, checkpoint.name != BEST.name))


def judged(results: Path) -> None:
    """Store results of suites on shipped models beside their checkpoints, and write what fails into their cards.

    Raises:
        SealError: a file of results is damaged.
        ValueError: the results are of another checkpoint.
    """
    for suite in SUITES:
        for path in sorted(results.glob(f"*{verdicts.suffix(suite)}")):
            checkpoint = FOLDER / f"{path.name.removesuffix(verdicts.suffix(suite))}.ckpt"
            measured = verdicts.read(path)
            if measured.checkpoint != verdicts.checksum(checkpoint):
                raise ValueError(f"{path}: of another checkpoint than {checkpoint}; run suite={suite} again")
            target = verdicts.path_beside(checkpoint, suite)
            if suite == "stability":
                measured = verdicts.added(target, measured, {check.name for check in measured.checks})
            verdicts.write(target, measured)
            _write_headline(checkpoint)


def _write_headline(checkpoint: Path) -> None:
    """Begin the card of a shipped model with what fails."""
    about = checkpoint.with_suffix(".md")
    _, _, rest = about.read_text().partition("\n\n")
    if rest.startswith("**"):  # the headline of earlier results
        _, _, rest = rest.partition("\n\n")
    about.write_text("\n".join([*_opening(checkpoint.stem, verdicts.headline(checkpoint)), rest]))


def rested(name: str, fraction: float) -> None:
    """Set the static friction of a shipped model, and say so on its card. Verdicts on the model before are deleted."""
    checkpoint = FOLDER / f"{name}.ckpt"
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    about = checkpoint.with_suffix(".md")
    text = about.read_text().replace(_resting(simulator), "") if simulator.static_friction else about.read_text()
    simulator.static_friction = fraction
    simulator.save(checkpoint)
    for suite in SUITES:
        verdicts.path_beside(checkpoint, suite).unlink(missing_ok=True)
    about.write_text(text.replace(REFUSED, f"{REFUSED}{_resting(simulator)}", 1))
    _write_headline(checkpoint)


def main(arguments: list[str]) -> int:
    """Write checkpoint and card; the exit status."""
    if arguments[0] == "--verdicts":
        judged(Path(arguments[1]))
        return 0
    if arguments[0] == "--static-friction":
        rested(arguments[1], float(arguments[2]))
        return 0
    shipped(Path(arguments[0]), *arguments[1:])
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
