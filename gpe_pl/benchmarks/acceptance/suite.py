"""The suite of acceptance scenes: small scenes that a person would look at before using a model. Solver and model simulate each scene.

Every check has a criterion from physics or from the solver's own uncertainty. A model that ignores its material parameter fails the checks in which a quantity
has to change with the parameter.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field

from gpe_pl.benchmarks.acceptance import bodies, flight, liquid, particles
from gpe_pl.benchmarks.acceptance.trial import Candidate, Result
from gpe_pl.benchmarks.finished_parts import PARTS, FinishedParts
from gpe_pl.benchmarks.trained import Case, checkpoint_label, of_stored_frames, refuse_same_names
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.learned import verdicts
from gpe_pl.learned.pretrained import FOLDER, checkpoint_path
from gpe_pl.learned.verdicts import Check, Verdict
from gpe_pl.viz.saving import save_figure

log = logging.getLogger(__name__)

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""

SCENES: dict[str, dict[str, Callable[[Candidate], Result]]] = {
    "beam": {m: partial(bodies.dropped, 20, 4, "flat beam") for m in ("solid", "elastomer")},
    "square": {m: partial(bodies.dropped, 12, 10, "square block") for m in ("solid", "elastomer")},
    "placed": {m: partial(bodies.placed, 12, 10) for m in ("solid", "elastomer")},
    "column": {"sand": particles.column},
    "pile": {"sand": particles.pile},
    "slump": {"sand": particles.slump},
    "cylinder": {"snow": particles.ball_on_cylinder},
    "released": dict.fromkeys(("sand", "snow"), particles.released),
    "pool": {"fluid": liquid.pool_at_rest},
    "dam_break": {"fluid": liquid.dam_break},
    "flight": dict.fromkeys(("sand", "snow", "elastomer", "fluid", "solid"), flight.free_flight),
}
"""Scenes by name, each with the materials that it has."""


class AcceptanceError(GpeError, ValueError):
    """Raised when there are no acceptance scenes for a checkpoint, or it was replaced while the suite ran; the message names it."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets, by name; each checkpoint must have been trained on one of them.
        checkpoints: models as paths of checkpoints, folders of runs, or names of shipped models.
        num_threads: threads of PyTorch; the solvers use one.
    """

    cases: dict[str, Case]
    checkpoints: Annotated[list[str], Field(min_length=1)] = field(default_factory=lambda: ["sand"])
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1


def run(settings: Settings, specs: dict[str, DatasetSpec], folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per check and a Markdown table.

    The results of each checkpoint are written to ``folder``, and beside the checkpoint unless it is a shipped model.

    Raises:
        AcceptanceError: there are no acceptance scenes for a checkpoint, or it was replaced while the suite ran.
        SameNameError: two checkpoints have the same name.
    """
    torch.set_num_threads(settings.num_threads)
    candidates = _candidates(settings.checkpoints, specs)
    parts, records = FinishedParts(folder / PARTS), list[dict[str, Any]]()
    for candidate, path, checksum in candidates:
        own = [record for scene in _scenes(candidate) for record in _measured(candidate, checksum, scene, folder, parts)]
        if verdicts.checksum(path) != checksum:
            raise AcceptanceError(f"{path}: was replaced while the suite ran; start it again when no training writes there")
        records += own
        checks = [Check(**{key: r[key] for key in ("name", "passed", "measured", "solver", "limit")}) for r in own]
        verdict = Verdict(checksum, checks)
        verdicts.write(folder / f"{candidate.name}{verdicts.suffix('acceptance')}", verdict)
        if path.parent != FOLDER:
            verdicts.write(verdicts.path_beside(path, "acceptance"), verdict)
    parts.clear()
    return records, report(records)


def _candidates(checkpoints: Sequence[str], specs: dict[str, DatasetSpec]) -> list[tuple[Candidate, Path, str]]:
    """Return the models with the paths and checksums of their checkpoints, all loaded first, so that a wrong name is reported at once."""
    found = []
    refuse_same_names(checkpoints)
    for checkpoint in checkpoints:
        checksum = verdicts.checksum(checkpoint_path(checkpoint))
        simulator = of_stored_frames(checkpoint)
        own = simulator.builder.metadata
        fitting = [s for s in specs.values() if s.name == own.dataset and abs(s.scene.spacing / own.spacing - 1) < 0.01]
        if not fitting or len(own.materials) > 1:
            raise AcceptanceError(
                f"{checkpoint}: was trained on {own.dataset} ({', '.join(own.materials)}, spacing {own.spacing:g} m); acceptance scenes are for one material "
                f"in {', '.join(f'{s.name} {s.size} ({s.scene.spacing:g} m)' for s in specs.values())}; choose its size=… or add a data set to suite.cases"
            )
        found.append((Candidate(checkpoint_label(checkpoint), simulator, fitting[0]), checkpoint_path(checkpoint), checksum))
    return found


def _scenes(candidate: Candidate) -> list[str]:
    (material,) = candidate.spec.scene.materials
    return [name for name, materials in SCENES.items() if material in materials]


def _measured(candidate: Candidate, checksum: str, scene: str, folder: Path, parts: FinishedParts) -> list[dict[str, Any]]:
    """Return the records of a scene: those of a stopped suite, or new ones, whose figure is written first."""
    spec = candidate.spec
    (material,) = spec.scene.materials
    identity = {"scene": scene, "model": candidate.name, "checkpoint": checksum, "data": spec.as_dict()}
    if (stored := parts.get(identity)) is not None:
        return stored
    log.info("%s: %s", candidate.name, scene)
    result = SCENES[scene][material](candidate)
    if result.shown:
        save_figure(result.figure(), folder / f"acceptance_{candidate.name}_{scene}.png", dpi=150)
    for check in result.checks:
        log.info("%s: %s", candidate.name, check)
    records = [{"model": candidate.name, "domain": spec.name, "scene": scene, **asdict(check)} for check in result.checks]  # type: ignore[call-overload]
    parts.put(identity, records)
    return records


def failures(records: Sequence[dict[str, Any]]) -> list[str]:
    """Return the failed checks, by which the suite fails."""
    return [f"{r['model']}: {r['name']} {r['measured']}" for r in records if not r["passed"]]


def report(records: Sequence[dict[str, Any]]) -> str:
    """Return a line per model, and a table of its checks; failures come first."""
    lines = []
    for model in dict.fromkeys(r["model"] for r in records):
        own = sorted((r for r in records if r["model"] == model), key=lambda r: r["passed"])
        failed = sum(not r["passed"] for r in own)
        lines += [f"### {model}", "", f"{len(own) - failed} of {len(own)} checks passed.", ""]
        lines += [table_row(["", "check", "model", "solver", "limit"]), "|" + "---|" * 5]
        lines += [table_row(["pass" if r["passed"] else "**FAIL**", r["name"], r["measured"], r["solver"], r["limit"]]) for r in own]
        lines.append("")
    return "\n".join(lines).rstrip()
