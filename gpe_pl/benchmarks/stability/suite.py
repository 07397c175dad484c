"""The suite of stress tests for trained models. Each model is tested in the domain of its training.

The criteria were fixed before the measurements, except that test 22 allows twice the solver's own drift since the solver was seen to exceed the former limit.
"""

from __future__ import annotations

import json
import logging
import math
import multiprocessing
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field

from gpe_pl.benchmarks.finished_parts import PARTS, FinishedParts
from gpe_pl.benchmarks.stability import conservation, geometry, horizon, inputs, invariances, precision
from gpe_pl.benchmarks.stability.subject import Outcome, StressTest, Subject
from gpe_pl.benchmarks.trained import Case, checkpoint_label, fingerprint_of, of_stored_frames, runs_in, trained_on
from gpe_pl.data.ground_truth import DatasetSpec, generate_trajectory
from gpe_pl.errors import GpeError
from gpe_pl.files.markdown import table_row
from gpe_pl.learned import verdicts
from gpe_pl.learned.pretrained import FOLDER, checkpoint_path
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.verdicts import Check, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

RESUMES = True
"""``run`` takes a folder and continues where an earlier run was stopped."""

GROUPS = {
    "invariances": invariances.TESTS,
    "conservation": conservation.TESTS,
    "degenerate geometry": geometry.TESTS,
    "inputs": inputs.TESTS,
    "long horizon": horizon.TESTS,
    "precision and performance": precision.TESTS,
}


class ReplacedError(GpeError, ValueError):
    """Raised when a checkpoint is replaced while the suite runs; the message names it."""


class NothingToTestError(GpeError, ValueError):
    """Raised when there is no model for any data set, or two models of a data set have one name; the message says what to do."""


@dataclass(frozen=True)
class Settings:
    """Settings of the suite.

    Attributes:
        cases: data sets, by name.
        runs: folders of finished runs; their models take part in the case whose data set they were trained on, with one seed of each.
        checkpoints: further models, as files or names of shipped models; they take part in the case whose data set they were trained on.
        gating: settings of the models that must pass, which are those of the shipped configuration.
        num_scenes: number of scenes of the split ``test``, per data set.
        horizon_factors: lengths of long rollouts, as multiples of the number of frames of a scene.
        num_rest_steps: number of frames over which a pile at rest is observed.
        tests: numbers of the tests to run; an empty list runs all.
        num_workers: number of processes; each takes whole data sets.
        num_threads: threads of PyTorch in each process; the solvers use one.
    """

    cases: dict[str, Case]
    runs: list[str] = field(default_factory=list)
    checkpoints: list[str] = field(default_factory=list)
    gating: dict[str, str] = field(default_factory=dict)
    num_scenes: Annotated[int, Field(ge=1)] = 5
    horizon_factors: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=1)] = field(default_factory=lambda: [1.0, 3.0, 10.0])
    num_rest_steps: Annotated[int, Field(ge=1)] = 1000
    tests: list[Annotated[int, Field(ge=1, le=31)]] = field(default_factory=list)
    num_workers: Annotated[int, Field(ge=1)] = 2
    num_threads: Annotated[int, Field(ge=1, le=1024)] = 1


def run(settings: Settings, specs: dict[str, DatasetSpec], folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return a record per test and model, and a Markdown table per domain. Data sets without a model are not tested.

    Tests that had finished when an earlier run was stopped are not repeated. ``folder`` keeps their records until the suite ends. The
    verdict on each checkpoint is written beside it, or to ``folder`` for a shipped model; tests that were not run keep their earlier results.

    Raises:
        NothingToTestError: no data set has a model, or two models of a data set have one name.
        CheckpointError: a checkpoint of ``settings`` cannot be loaded. It is raised before the first test.
        ReplacedError: a checkpoint was replaced while the suite ran.
    """
    parts = FinishedParts(folder / PARTS)
    records: list[dict[str, Any]] = []
    checkpoints = {name: _checkpoints(spec, settings) for name, spec in specs.items()}  # looked up once: runs may finish meanwhile
    untested = [name for name, models in checkpoints.items() if not models]
    chosen = {path for models in checkpoints.values() for path, _ in models.values()}
    unfit = [checkpoint for checkpoint in settings.checkpoints if checkpoint_path(checkpoint) not in chosen]
    if unfit:
        log.warning("%s: not tested, trained on none of the data sets of the suite (suite.cases, size)", ", ".join(unfit))
    tested = [(name, specs[name], models) for name, models in checkpoints.items() if models]
    if min(settings.num_workers, len(tested)) > 1:
        with ProcessPoolExecutor(settings.num_workers, multiprocessing.get_context("spawn"), _show_progress) as pool:
            for found in pool.map(_test_domain, *zip(*tested, strict=True), repeat(settings), repeat(parts)):
                records += found
    else:
        for domain in tested:
            records += _test_domain(*domain, settings, parts)
    if not records:
        raise NothingToTestError(
            f"{', '.join([*settings.runs, *settings.checkpoints]) or 'suite.runs and suite.checkpoints are empty'}: no model that was trained on one of "
            f"{', '.join(f'{s.name} {s.size}' for s in specs.values())}; train with `python -m gpe_pl.fit data={untested[0]} model=gpe_tuned` or set "
            "suite.runs or suite.checkpoints"
        )
    short = _shortened(settings)
    for name, _, models in tested:
        for label, (path, checksum) in models.items():
            own = [r for r in records if (r["domain"], r["model"]) == (name, label) and int(r["test"].split()[0]) not in short]
            _write_verdict(path, checksum, own, folder)
    parts.clear()
    return records, report(records, untested, unfit)


def _shortened(settings: Settings) -> set[int]:
    """Return the numbers of tests that are shorter than their criterion says. The table has them, and no verdict."""
    return {
        *({21} if max(settings.horizon_factors) < horizon.FULL_HORIZON else ()),
        *({22} if settings.num_rest_steps < horizon.FULL_REST else ()),
    }


def _write_verdict(path: Path, checksum: str, records: Sequence[dict[str, Any]], folder: Path) -> None:
    """Write the verdict on a checkpoint. Tests that do not apply are left out."""
    checks = [
        Check(r["test"], r["status"] == "passed", r["measured"], "", r["criterion"]) for r in records if r["status"] != "not_applicable"
    ]
    target = folder / f"{path.stem}{verdicts.suffix('stability')}" if path.parent == FOLDER else verdicts.path_beside(path, "stability")
    verdicts.write(target, verdicts.added(target, Verdict(checksum, checks), {r["test"] for r in records}))


def _show_progress() -> None:
    """Configure logging to the terminal, because a worker process does not inherit it."""
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s][%(name)s][%(levelname)s] - %(message)s")


def _test_domain(
    name: str, spec: DatasetSpec, checkpoints: dict[str, tuple[Path, str]], settings: Settings, parts: FinishedParts
) -> list[dict[str, Any]]:
    """Return the records of all models of a data set, given their checkpoints and the checksums of these by name."""
    torch.set_num_threads(settings.num_threads)
    for path, checksum in checkpoints.values():
        if verdicts.checksum(path) != checksum:
            raise ReplacedError(f"{path}: was replaced while the suite ran; start it again when no training writes there")
    models = {label: of_stored_frames(path) for label, (path, _) in checkpoints.items()}
    return [record for subject in subjects(name, spec, models, settings) for record in test(subject, settings.tests, parts)]


def test(subject: Subject, numbers: Sequence[int] = (), parts: FinishedParts | None = None) -> Iterator[dict[str, Any]]:
    """Yield the records of all tests of one model, or of those with these numbers; a test that crashes has failed.

    Args:
        subject: the model with its test data.
        numbers: numbers of the tests; all if empty.
        parts: records of finished tests, which are not repeated.
    """
    identity = _identity(subject)
    for group, tests in GROUPS.items():
        for stress_test in tests:
            if numbers and stress_test.number not in numbers:
                continue
            known = {**identity, "test": stress_test.number}
            if parts is not None and (stored := parts.get(known)) is not None:
                yield from stored
            else:
                started = time.perf_counter()
                outcome = _outcome(stress_test, subject)
                seconds = time.perf_counter() - started
                log.info("%s, %s: test %d took %.1f s", subject.domain, subject.name, stress_test.number, seconds)
                record = {
                    "test": f"{stress_test.number} {stress_test.name}",
                    "group": group,
                    "model": subject.name,
                    "domain": subject.domain,
                    "criterion": stress_test.criterion,
                    "measured": outcome.measured,
                    "status": {True: "passed", False: "failed", None: "not_applicable"}[outcome.passed],
                    "gating": subject.is_gating,
                    "curves": {
                        k: [float(f"{v:.5g}") if math.isfinite(v) else None for v in values] for k, values in outcome.curves.items()
                    },
                }
                if parts is not None:
                    parts.put(known, [record])
                yield record


test.__test__ = False  # type: ignore[attr-defined]


def _identity(subject: Subject) -> dict[str, Any]:
    """Return everything that the outcomes of a subject depend on."""
    return {
        "model": subject.name,
        "domain": subject.domain,
        "weights": {name: fingerprint_of(peer) for name, peer in {**subject.peers, subject.name: subject.simulator}.items()},
        "gating": subject.is_gating,
        "data": subject.spec.as_dict(),
        "num_scenes": len(subject.scenes),
        "horizon_factors": list(subject.horizon_factors),
        "num_rest_steps": subject.num_rest_steps,
    }


def _outcome(stress_test: StressTest, subject: Subject) -> Outcome:
    try:
        return stress_test(subject)
    except Exception as error:
        log.warning("%s, %s: test %d crashed", subject.domain, subject.name, stress_test.number, exc_info=not isinstance(error, GpeError))
        return Outcome(False, f"crashed: {type(error).__name__}: {' '.join(str(error).split())[:200]}")


# --- what is tested -------------------------------------------------------------------------------------------------------------------------


def subjects(domain: str, spec: DatasetSpec, models: dict[str, LearnedSimulator], settings: Settings) -> list[Subject]:
    """Return the models of a data set with their test data, the gating ones first."""
    scenes = [generate_trajectory(spec, "test", k) for k in range(settings.num_scenes)]
    speed = horizon.max_speed(spec, generate_trajectory, settings.num_scenes)
    found = [
        Subject(
            name,
            domain,
            simulator,
            spec,
            scenes,
            speed,
            is_gating(simulator, settings.gating),
            models,
            settings.horizon_factors,
            settings.num_rest_steps,
        )
        for name, simulator in models.items()
    ]
    return sorted(found, key=lambda s: not s.is_gating)


def is_gating(simulator: LearnedSimulator, gating: dict[str, str]) -> bool:
    """Tell whether a model has all of these settings; false if there are none."""
    own = simulator.description()["settings"]
    return bool(gating) and all(own.get(key) == value for key, value in gating.items())


def _checkpoints(spec: DatasetSpec, settings: Settings) -> dict[str, tuple[Path, str]]:
    """Return the checkpoints of all models of a data set and their checksums, by name. Each checkpoint has been loaded once."""
    found = {name: checkpoint_path(run.folder) for name, (_, run) in trained_on(spec, runs_in(settings.runs)).items()}
    for checkpoint in settings.checkpoints:
        metadata, label = of_stored_frames(checkpoint).builder.metadata, checkpoint_label(checkpoint)
        if (metadata.dataset, metadata.spacing) == (spec.name, spec.scene.spacing):
            if label in found:
                raise NothingToTestError(
                    f"two models of {spec.name} are called {label}; copy one of the checkpoints to a file of another name"
                )
            found[label] = checkpoint_path(checkpoint)
    return {label: (path, verdicts.checksum(path)) for label, path in found.items()}


def failures(records: Sequence[dict[str, Any]]) -> list[str]:
    """Return the failures of gating models, by which the suite fails."""
    return [f"{r['domain']}, {r['model']}: {r['test']}" for r in records if r["gating"] and r["status"] == "failed"]


# --- the table ------------------------------------------------------------------------------------------------------------------------------


MARKS = {"passed": "passed", "failed": "**failed**", "not_applicable": "–"}


def report(records: Sequence[dict[str, Any]], untested: Sequence[str] = (), unfit: Sequence[str] = ()) -> str:
    """Return counts, also for each model, and a table per domain with a row per test and a column per model."""
    gating = [r for r in records if r["gating"]]
    lines = [
        f"Gating configurations: {sum(r['status'] == 'passed' for r in gating)} passed, {len(failures(records))} failed, "
        f"{sum(r['status'] == 'not_applicable' for r in gating)} do not apply. Criteria were fixed before the first "
        "measurement, except the solver's drift in test 22.",
    ]
    if untested:
        lines += ["", f"Not tested, for want of a model: {', '.join(untested)}."]
    if unfit:
        lines += ["", f"Checkpoints that were not tested, because they were trained on none of these data sets: {', '.join(unfit)}."]
    lines += ["", table_row(["domain", "model", "passed", "failed", "do not apply"]), "|" + "---|" * 5]
    for domain, model in dict.fromkeys((r["domain"], r["model"]) for r in records):
        counts = Counter(r["status"] for r in records if (r["domain"], r["model"]) == (domain, model))
        lines.append(table_row([domain, model, *(str(counts[status]) for status in MARKS)]))
    for domain in dict.fromkeys(r["domain"] for r in records):
        own = [r for r in records if r["domain"] == domain]
        models = {r["model"]: r["gating"] for r in own}
        header = ["test", "criterion", *(f"{m}{' (gating)' if is_gating else ''}" for m, is_gating in models.items())]
        lines += ["", f"### {domain}", "", table_row(header), "|" + "---|" * len(header)]
        for name in dict.fromkeys(r["test"] for r in own):
            row = {r["model"]: r for r in own if r["test"] == name}
            first = next(iter(row.values()))
            cells = [f"{MARKS[row[m]['status']]}: {row[m]['measured']}".rstrip(": ") if m in row else "" for m in models]
            lines.append(table_row([_cell(c) for c in (name, first["criterion"], *cells)]))
    return "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def figures(records: list[dict[str, Any]]) -> dict[str, Figure]:
    """Draw figures per domain: energy and momentum over a long rollout, valid and surviving frames, and growth of a perturbation."""
    from gpe_pl.benchmarks.stability.figures import long_horizon_figure, perturbation_figure

    found = {}
    for domain in dict.fromkeys(r["domain"] for r in records):
        curves = {
            number: {
                r["model"]: _with_infinities(r["curves"])
                for r in records
                if r["domain"] == domain and r["test"].startswith(f"{number} ") and r["curves"]
            }
            for number in (21, 23)
        }
        if curves[21]:
            found[f"long_horizon_{domain}"] = long_horizon_figure(curves[21])
        if curves[23]:
            found[f"perturbation_{domain}"] = perturbation_figure(curves[23])
    return found


def _with_infinities(curves: dict[str, list[float | None]]) -> dict[str, np.ndarray]:
    return {k: np.array([np.inf if v is None else v for v in values]) for k, values in json.loads(json.dumps(curves)).items()}
