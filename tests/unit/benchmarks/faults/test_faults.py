"""The faults suite in small numbers: faults are refused, and the suite notices when they are not."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import runpy
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from gpe_pl.benchmarks.faults import checkpoints, configs, field_values, isolation, outside, pairs, runs, scenes, side_files, stores, suite
from gpe_pl.benchmarks.faults.isolation import CANARY, Ended, verdicts
from gpe_pl.benchmarks.faults.suite import report
from gpe_pl.benchmarks.faults.verdict import GOOD, Fault, Verdict, verdict_of
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import Simulator
from gpe_pl.system import early_interrupts
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import read_trajectory, stored_arrays, write_shard
from tests.conftest import make_trajectory


@pytest.fixture(scope="module")
def spec() -> DatasetSpec:
    return dataset("data=sand", "size=tiny", "data.sizes.tiny.d2.num_particles=40")


def bad(faults: list[Fault], folder: Path) -> list[tuple[str, str, Verdict]]:
    """Return the faults with a bad outcome."""
    found = []
    for k, fault in enumerate(faults):
        own = folder / str(k)
        own.mkdir()
        verdict = fault.attack(own)
        if verdict.status not in GOOD:
            found.append((fault.kind, fault.name, verdict))
    return found


# --- what is wrong is refused ---------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.long)])
def test_damaged_and_wrong_shards(shard: Path, tmp_path: Path, step: int) -> None:
    faults = stores.faults(shard, 16)
    assert len(faults) > 100
    assert not bad(faults[::step], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("step", [8, pytest.param(1, marks=pytest.mark.long)])
def test_damaged_wrong_and_hostile_checkpoints(checkpoint: Path, tmp_path: Path, step: int) -> None:
    faults = checkpoints.faults(checkpoint, 16)
    assert len(faults) > 100
    assert not bad(faults[::step], tmp_path)


def test_a_system_that_does_not_fork_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])  # as on Windows
    with pytest.raises(GpeError, match="suite=faults needs to fork processes"):
        next(verdicts([]), None)


def test_every_bit_of_a_weight_counts(checkpoint: Path, tmp_path: Path) -> None:
    """PyTorch does not compare the checksums of the archive that it writes."""
    weights = torch.load(checkpoint, weights_only=True)["state_dict"]
    sought = max(weights.values(), key=lambda w: w.numel()).numpy().tobytes()
    where = checkpoint.read_bytes().index(sought)
    verdict = checkpoints.load_damaged(checkpoint, lambda data: data[:where] + bytes([data[where] ^ 1]) + data[where + 1 :], tmp_path)
    assert verdict.status == "refused"
    assert "checksum mismatch" in verdict.detail


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True], ids=["solver", "model"])
def test_impossible_scenes(spec: DatasetSpec, tmp_path: Path, learned: bool) -> None:
    every = [f for f in scenes.faults({"sand": spec}, 1) if ("model" in f.name) is learned]
    assert {f.kind.removeprefix("scene, ") for f in every} == set(scenes.CHANGES)
    assert not bad(every, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True], ids=["solver", "model"])
@pytest.mark.parametrize("name", sorted(scenes.STEPPED))
def test_scenes_that_a_guard_would_reject_are_stepped(
    spec: DatasetSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, learned: bool
) -> None:
    steps, before = [], scenes.step_scenes

    def counted(simulator: Simulator, *arguments: Any) -> Iterator[Any]:
        def step(state: State) -> State:
            steps.append(state)
            return simulator.step(state)

        return before(SimpleNamespace(step=step), *arguments)

    monkeypatch.setattr(scenes, "step_scenes", counted)
    assert scenes.simulated(spec, name, learned, 0, tmp_path).status in GOOD
    assert steps
    if name == scenes.INSIDE:
        shapes = [shape for shape in steps[0].boundary.shapes if shape.kind != "wall"]
        depth = -np.min([shape.signed_distance(np.asarray(steps[0].pos)) for shape in shapes], axis=0)
        assert (depth > 1e-4).sum() >= steps[0].num_nodes // 4 and depth.max() < 1.2 * spec.scene.spacing
        assert all((np.asarray(steps[0].pos)[:, k] > low - 1e-6).all() for k, (low, _) in enumerate(spec.scene.bounds))


@pytest.mark.slow
@pytest.mark.parametrize("step", [23, pytest.param(1, marks=pytest.mark.long)])
def test_values_that_break_a_rule(shard: Path, tmp_path: Path, step: int) -> None:
    faults = field_values.faults({"sand": shard})
    assert {f.kind.removeprefix("value, ") for f in faults} == set(field_values.WAYS)
    assert len(faults) > 200
    assert not bad(faults[::step], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("step", [19, pytest.param(1, marks=pytest.mark.long)])
def test_small_files_and_archives(tmp_path: Path, step: int) -> None:
    side_files.raw_arrays(tmp_path / "raw")
    faults = side_files.faults(tmp_path / "raw")
    assert len(faults) > 100
    assert not bad(faults[::step], tmp_path)


# --- and it is seen when it is not ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drifting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with two trajectories that move steadily, which nothing refuses."""
    path = tmp_path_factory.mktemp("drifting") / "shard-00000.h5"
    way = 1e-3 * np.arange(6, dtype=np.float32)[:, None, None]
    write_shard(path, [replace(t, pos=t.pos[:1] + way, vel=np.full_like(t.vel, 0.1)) for t in map(make_trajectory, (0, 1))])
    return path


@pytest.mark.parametrize("way", field_values.WAYS)
@pytest.mark.parametrize("key", ["pos", "mass"])
def test_a_sound_trajectory_is_accepted(drifting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str, key: str) -> None:
    monkeypatch.setattr(field_values, "spoilt", lambda arrays, *_: dict(arrays))
    verdict = field_values.brought_in(way, drifting, key, float("nan"), 0, tmp_path)
    assert verdict == Verdict("accepted", "no error, and nothing was left out")


def test_every_wrong_value_of_a_rollout_reaches_its_state(shard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = stored_arrays(read_trajectory(shard, "00000"))
    states: list[State] = []

    def noted(_: LearnedSimulator, state: State, *__: object) -> State:
        states.append(state)
        return state

    monkeypatch.setattr(LearnedSimulator, "_checked", noted)
    monkeypatch.setattr(field_values, "rollout", lambda *_: SimpleNamespace(termination=None))
    faults = [fault for seed in range(5) for fault in field_values.faults({"sand": shard}, 100 * seed) if fault.kind == "value, rollout"]
    assert {fault.name.split()[1] for fault in faults} == {f"{key}:" for key in arrays}
    for fault in faults:
        assert fault.attack(tmp_path).status == "accepted"
    monkeypatch.setattr(field_values, "spoilt", lambda sound, *_: dict(sound))
    faults[0].attack(tmp_path)
    *wrong, sound = map(_values, states)
    missed = [fault.name for fault, values in zip(faults, wrong, strict=True) if values == sound]
    assert not missed


def _values(state: State) -> list[bytes]:
    """Return the arrays of a state from which a rollout starts, as bytes."""
    b = state.boundary
    walls = (b.pos, b.vel, b.normal, b.friction, b.restitution)
    nodes = (state.pos, state.velocity_history, state.frame_velocity, state.node_type, state.mass, state.material_params)
    return [np.asarray(values).tobytes() for values in (*walls, *nodes)]


@pytest.mark.parametrize("text", ["positions are float64", "field 'rest_pos': not finite", "position"])
def test_a_part_of_a_word_names_no_field(shard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setitem(field_values.WAYS, "rollout", lambda *_: text)
    assert field_values.brought_in("rollout", shard, "pos", 0.0, 0, tmp_path).status == "accepted"
    monkeypatch.setitem(field_values.WAYS, "rollout", lambda *_: "field 'pos': not finite")
    assert field_values.brought_in("rollout", shard, "pos", 0.0, 0, tmp_path).status == "refused"


@pytest.mark.slow
def test_a_refused_command_releases_its_folder(tmp_path: Path) -> None:
    ended = isolation.run("fit", ["seed=-1", f"paths.runs={tmp_path}", f"paths.data={tmp_path}"])
    assert ended.code == 2 and "seed=-1" in ended.output
    assert runs.leftovers(tmp_path) == []


def test_a_verdict_tells_what_came_of_an_action() -> None:
    def fails(error: Exception) -> None:
        raise error

    assert verdict_of(lambda: 1, lambda x: x == 1).status == "harmless"
    assert verdict_of(lambda: 2, lambda x: x == 1).status == "accepted"
    assert verdict_of(lambda: fails(GpeError("file, reason")), lambda _: True) == Verdict("refused", "file, reason")
    assert verdict_of(lambda: fails(GpeError("")), lambda _: True).status == "traceback"
    assert verdict_of(lambda: fails(KeyError("x")), lambda _: True) == Verdict("traceback", "KeyError: 'x'")


def test_a_changed_value_with_a_fitting_checksum_is_accepted(shard: Path, tmp_path: Path) -> None:
    def rewrite(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file["00001"]["pos"][2, 3, 1] += np.float32(0.1)

    assert stores.read_rewritten(shard, rewrite, tmp_path).status == "accepted"


def test_bytes_without_meaning_may_change(shard: Path, tmp_path: Path) -> None:
    same, other = tmp_path / "same.h5", tmp_path / "other.h5"
    same.write_bytes(shard.read_bytes() + b"beyond the end")
    shutil.copy(shard, other)
    with h5py.File(other, "r+") as file:
        file["00000"]["pos"][0, 0, 0] += 0.5
    assert runs._have_equal_content(shard, same)
    assert not runs._have_equal_content(shard, other)
    assert not runs._have_equal_content(shard, tmp_path / "missing.h5")


def test_payloads_work_where_they_are_let(tmp_path: Path) -> None:
    for kind in checkpoints.PAYLOADS:
        folder = tmp_path / kind
        folder.mkdir()
        torch.save(checkpoints.payload(kind, folder), folder / "evil.ckpt")
        torch.load(folder / "evil.ckpt", weights_only=False)
        assert (folder / checkpoints.TRACE).exists(), kind


@pytest.mark.parametrize(
    ("code", "output", "status"),
    [
        (0, "", "harmless"),
        (2, "some text\nerror: name=1: must be a name\n", "refused"),
        (1, "Traceback (most recent call last):\n  …\nKeyError: 1\n", "traceback"),
        (2, "", "traceback"),  # no message
        (-11, "", "died"),
        (None, "", "hung"),
    ],
)
def test_the_verdict_of_a_command_follows_from_its_last_words(code: int | None, output: str, status: str) -> None:
    assert Ended(code, output).verdict().status == status


def test_every_kind_of_wrong_configuration_is_made_of_a_value() -> None:
    values = dict(configs.leaves({"a": {"b": 1, "c": 0.5, "d": True}, "e": "text", "f": [1, 2], "paths": {"data": "x"}}))
    assert values == {"a.b": 1, "a.c": 0.5, "a.d": True, "e": "text", "f": [1, 2]}
    for key, value in values.items():
        kinds = {kind for kind, _, _ in configs.mutations(key, value)}
        assert kinds >= {"unknown key", "missing key", "wrong type"}
    assert ("wrong type", "a.b=banana", True) in list(configs.mutations("a.b", 1))


def test_a_wrong_configuration_has_data_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where data exist with other settings, a command refuses any setting, and the data belong to other faults, too."""
    data, own = tmp_path / "data", tmp_path / "own"
    data.mkdir()
    (data / "dataset.json").touch()
    given: list[list[str]] = []

    def run(_: str, arguments: list[str], *__: float) -> Ended:
        given.append(arguments)
        return Ended(0, "seed: 0\n")

    monkeypatch.setattr(configs, "run", run)
    for command, found in ((runs.Command("one", "simulate", ()), []), (runs.Command("other", "fit", (), str(data)), ["dataset.json"])):
        fault = configs.faults(command, {}, 1)[0]
        shutil.rmtree(own, ignore_errors=True)
        own.mkdir()
        fault.attack(own)
        assert {f"paths.data={own / 'data'}", f"paths.runs={own / 'runs'}"} <= set(given[-1])
        assert [path.name for path in own.glob("data/*")] == found


@pytest.mark.parametrize(
    ("found", "must_fail", "status"), [("1", False, "harmless"), ("2", False, "changed"), ("1", True, "accepted"), ("2", True, "accepted")]
)
def test_a_setting_is_harmless_if_results_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: str, must_fail: bool, status: str
) -> None:
    monkeypatch.setattr(configs, "run", lambda *_: Ended(0, ""))
    monkeypatch.setattr(runs, "digests", lambda _: {"a": found})
    assert configs.started(runs.Command("one", "fit", ()), "~seed", must_fail, {"a": "1"}, 1.0, tmp_path).status == status


@pytest.mark.parametrize(
    ("left", "code", "status"),
    [
        ({}, 2, "refused"),
        ({}, 0, "unread"),  # succeeds without the file
        ({"best.ckpt": "sound"}, 0, "harmless"),  # writes it again
        ({"table.md": "wrong"}, 0, "accepted"),  # and another result is wrong
    ],
)
def test_a_damaged_file_that_no_command_reads_is_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: dict[str, str], code: int, status: str
) -> None:
    sound, own = tmp_path / "sound", tmp_path / "own"
    (sound / "runs").mkdir(parents=True)
    own.mkdir()
    for name in ("best.ckpt", "table.md"):
        (sound / "runs" / name).write_text("sound")

    def run(*_: object) -> Ended:
        for name, text in left.items():
            (own / "runs" / name).write_text(text)
        return Ended(code, "error: damaged" if code else "")

    def load(path: Path) -> dict[str, str]:
        if path.read_text() != "sound":
            raise GpeError("best.ckpt: damaged")
        return dict.fromkeys(runs.SAVED, "sound")

    monkeypatch.setattr(isolation, "run", run)
    monkeypatch.setattr(runs, "load_checkpoint", load)
    command = runs.Command("one", "fit", ())
    assert runs.damaged_file(command, sound, "runs/best.ckpt", lambda data: data[:2], 1.0, own).status == status


def _finds(_: Path) -> Verdict:
    return Verdict("refused", "found")


def _hangs(_: Path) -> Verdict:
    time.sleep(600)
    return Verdict("harmless")


def _dies(_: Path) -> Verdict:
    os._exit(3)


def _raises(_: Path) -> Verdict:
    raise KeyError("by mistake")


@pytest.mark.long
def test_what_hangs_or_dies_costs_only_itself() -> None:
    attacks: dict[str, Callable[[Path], Verdict]] = {
        "refused": _finds,
        "hung": _hangs,
        "died": _dies,
        "traceback": _raises,
        "harmless": partial(_sleeps, 0.01),
    }
    faults = [Fault("kind", name, attack) for name, attack in attacks.items()] * 2
    assert [v.status for v in verdicts(faults, limit=20.0)] == [f.name for f in faults]


def _sleeps(seconds: float, _: Path) -> Verdict:
    time.sleep(seconds)
    return Verdict("harmless")


def _writes_outside(path: str, own: Path) -> Verdict:
    (own.parent / CANARY / path).write_text("changed")
    return Verdict("harmless")


@pytest.mark.parametrize("path", ["checkpoints/best.ckpt", "new"])
def test_what_changes_a_folder_beside_its_own_is_outside(tmp_path: Path, path: str) -> None:
    verdict = isolation._watched(Fault("kind", "name", partial(_writes_outside, path)), tmp_path / "own", tmp_path / CANARY)
    assert verdict.status == "outside" and path in verdict.detail


def test_what_takes_longer_than_it_may_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolation, "HANG", 0.05)
    fault = Fault("kind", "name", partial(_sleeps, 0.2))
    assert isolation._watched(fault, tmp_path / "own", tmp_path / CANARY).status == "hung"
    assert isolation._watched(replace(fault, seconds=30.0), tmp_path / "own", tmp_path / CANARY).status == "harmless"


@dataclass
class Ends:
    """A command that has already ended."""

    exitcode: int

    def kill(self) -> None:
        pass

    def join(self, _: float = 0.0) -> None:
        pass


HELD = "error: runs/fit: another command writes to it (process 7 on here, since noon: fit); wait until it has ended"


def ends_at_once(monkeypatch: pytest.MonkeyPatch, codes: tuple[int, ...], said: str, found: dict[str, str]) -> None:
    """Let commands end with these codes, print this if the code is not 0, and leave files with these digests."""
    ended = iter(codes)

    def start(module: str, arguments: list[str], output: Path) -> Ends:
        code = next(ended)
        output.write_text(said if code else "")
        return Ends(code)

    monkeypatch.setattr(isolation, "start", start)
    monkeypatch.setattr(runs, "digests", lambda _: found)


COMMANDS = [runs.Command(name, "fit", ()) for name in ("one", "other")]


@pytest.mark.parametrize(
    ("codes", "said", "left", "status"),
    [
        ((0, 2), HELD, "first", "refused"),
        ((0, 2), HELD, "second", "different"),  # of the one that was refused
        ((0, 2), HELD, "both", "different"),
        ((0, 0), "", "both", "harmless"),
        ((0, 0), "", "first", "different"),  # the other said that it succeeded
        ((2, 2), HELD, "", "different"),
        ((0, 1), "Traceback (most recent call last):", "first", "traceback"),
        ((2, 0), "error: something is in the way", "second", "accepted"),  # of whom?
        ((2, 0), HELD, "second", "refused"),
        ((2, 0), "error: own/imported: exists already", "second", "refused"),  # the other has put its results there and is about to end
        ((2, 0), "error: own/imported: exists already", "first", "different"),
        ((2, 0), HELD.replace("fit)", f"fit {'x' * 400})"), "second", "refused"),
    ],
)
def test_the_verdict_of_two_commands_follows_from_what_they_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codes: tuple[int, int], said: str, left: str, status: str
) -> None:
    expected = ({"a": "1", "b": "2"}, {"a": "1", "c": "3"})
    ends_at_once(monkeypatch, codes, said, {"first": expected[0], "second": expected[1], "both": expected[0] | expected[1], "": {}}[left])
    assert pairs.together(COMMANDS, expected, 0.0, 10.0, tmp_path).status == status


@pytest.mark.parametrize(
    ("module", "found", "said", "status"),
    [
        ("convert", "1", "error: exists already", "harmless"),
        ("convert", "2", "error: exists already", "different"),
        ("convert", "1", "Traceback (most recent call last):", "different"),
        ("fit", "1", "error: exists already", "different"),
    ],
)
def test_an_import_that_is_done_need_not_be_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, found: str, said: str, status: str
) -> None:
    monkeypatch.setattr(isolation, "run", lambda *_: Ended(2, said))
    monkeypatch.setattr(runs, "digests", lambda _: {"a": found})
    assert runs.finished(runs.Command("one", module, ()), tmp_path, {"a": "1"}, 1.0).status == status


@pytest.mark.parametrize(("found", "status"), [("1", "harmless"), ("2", "different")])
@pytest.mark.parametrize("state", outside.STATES)
def test_a_path_in_a_checkpoint_must_not_change_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str, found: str, status: str
) -> None:
    last, before = tmp_path / "last.ckpt", {"best_step": 2, "lowest": [0.5]}
    torch.save({"callbacks": {"Checkpoints": before}}, last)
    monkeypatch.setattr(outside, "interrupted", lambda *_: last)
    monkeypatch.setattr(isolation, "run", lambda *_: Ended(0, ""))
    monkeypatch.setattr(runs, "digests", lambda _: {"a": found})
    verdict = outside.resumed(runs.Command("one", "fit", ()), state, "{canary}/best.ckpt", {"a": "1"}, 1.0, tmp_path)
    assert verdict.status == status
    after = torch.load(last, weights_only=True)["callbacks"]["Checkpoints"]
    assert CANARY in str(after)
    assert all(after[key] == before[key] or CANARY in str(after[key]) for key in before)  # another number would change results, too


def test_the_measured_cost_of_rollouts_is_no_result_that_repeats(tmp_path: Path) -> None:
    path, found = tmp_path / "runs" / "fit" / "rollout_cost.json", []
    path.parent.mkdir(parents=True)
    for text in ('{"seconds_per_step": 1.0, "sha256": "a"}', '{"seconds_per_step": 2.0, "sha256": "b"}', "{}"):
        path.write_text(text)
        found.append(runs.digests(tmp_path))
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize("attack", [runs.full_disk, runs.file_limit])
def test_a_command_that_succeeds_on_a_full_disk_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, attack: Callable[..., Verdict]
) -> None:
    monkeypatch.setattr(runs, "small_disk", lambda *_: contextlib.nullcontext(False))
    monkeypatch.setattr(isolation, "run", lambda *_: Ended(0, ""))
    assert attack(runs.Command("one", "fit", ()), 1000, {}, 1.0, tmp_path).status == "accepted"


def test_a_disk_that_would_not_fill_up_is_no_fault(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for name, size in (("best.ckpt", 3000), ("metrics.csv", 2000)):
        (tmp_path / "runs" / name).write_bytes(bytes(size))
    command = runs.Command("one", "fit", ())
    found = runs.disk_faults(command, [100, 2999], tmp_path, {}, 1.0)
    assert [fault.kind for fault in found] == ["disk full", "disk full", "file too large", "folder not writable", "folder not writable"]
    with pytest.raises(GpeError, match="disk_sizes of one: 3000 bytes have room for its largest file, of 3000 bytes"):
        runs.disk_faults(command, [100, 3000], tmp_path, {}, 1.0)


def test_details_do_not_say_where_the_package_lies() -> None:
    records: list[dict[str, object]] = []
    suite._note(records, "kind", "name", Verdict("refused", f"/tmp/faults-x1/runs/fit or {suite.HERE}/gpe_pl: no room"))
    assert records[0]["detail"] == "runs/fit or …/gpe_pl: no room"


def test_a_traceback_is_shown_where_more_was_printed_after_it() -> None:
    text = "a\nException ignored in: <x>\nTraceback (most recent call last):\n  File 'a'\n    b()\nKeyboardInterrupt\nruns/fit\n"
    found = runs.TRACEBACK.search(text)
    assert found is not None
    assert found.group() == text[2:-10]


def test_a_command_that_is_killed_at_once_has_printed_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Context:
        def Process(self, **_: object) -> Context:
            return self

        def start(self) -> None:
            pass

    monkeypatch.setattr(isolation, "forks", Context)
    isolation.start("fit", [], tmp_path / "output")
    assert (tmp_path / "output").read_bytes() == b""


def test_an_early_interrupt_is_one_line_in_a_forked_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A forked command behaves like one that ``python -m`` starts."""
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(os, "dup2", lambda *_: None)
    caught: list[object] = []
    monkeypatch.setattr(runpy, "run_module", lambda *_, **__: caught.append(signal.getsignal(signal.SIGINT)))
    monkeypatch.setattr("sys.argv", [])
    try:
        isolation._run_command("fit", [], str(tmp_path / "output"), None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert caught == [early_interrupts._end_process]


def test_the_time_of_a_command_is_that_without_compilation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, takes = [0.0], iter([60.0, 2.0])

    def run(*_: object) -> Ended:
        clock[0] += next(takes)
        return Ended(0, "")

    monkeypatch.setattr(isolation, "run", run)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    settings = suite.Settings(cases={}, data=[], commands={"simulate": suite.Attacked("simulate", [])})
    assert suite._prepared(settings, tmp_path)["simulate"].seconds == 2.0


def test_the_matrix_counts_and_shows_what_is_bad() -> None:
    records = [{"kind": "shard, truncated", "fault": f"{k}", "status": "refused", "detail": "x"} for k in range(3)]
    records += [{"kind": "shard, truncated", "fault": "7|8", "status": "accepted", "detail": "no error"}]
    records += [{"kind": "file", "fault": "a pipe", "status": "hung", "detail": "12 s"}]
    records += [
        {"kind": "fit killed", "fault": "", "status": status, "detail": "SIGKILL after 1 s"}
        for status in ("harmless", "harmless", "different")
    ]
    assert "| fault | number | refused | harmless | unread |" in report([*records[:3], *records[-2:], {**records[0], "status": "unread"}])
    text = report(records)
    assert text.startswith(
        "5 corrupted or hostile inputs: 0 tracebacks without a typed error, 1 silent acceptances, 0 executed payloads, "
        "0 paths outside, 1 hangs over 10 s, 0 other failures. 3 kills: 2 "
    )
    assert "| fault | number | refused | harmless | accepted | different | hung |" in text
    assert "| shard, truncated | 4 | 3 | 0 | 1 | 0 | 0 |" in text
    assert "| fit killed | 3 | 0 | 2 | 0 | 1 | 0 |" in text
    assert "- shard, truncated, 7\\|8: accepted: no error" in text
    assert "**3 failures**" in text
