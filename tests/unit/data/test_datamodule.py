"""The data module: endless, resumable training batches, a fixed validation sample, and statistics of the noisy inputs."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule, _set_up_worker
from gpe_pl.data.dataset import CachedGraphs, WindowDataset
from gpe_pl.data.importers import save_dataset
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSize
from gpe_pl.data.statistics import motion
from gpe_pl.files import sealed
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.trajectory.store import StoreError, read_trajectory, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Trajectory


@pytest.fixture
def root(store: Path) -> Path:
    for shard in store.rglob("*.h5"):  # what moves as far as those of the fixture within a frame is taken for damaged
        calmer = [
            replace(t, pos=t.pos[:1] + 0.05 * (t.pos - t.pos[:1])) for t in (read_trajectory(shard, n) for n in trajectory_names(shard))
        ]
        shard.unlink()
        write_shard(shard, calmer)
    return described(store)


def described(root: Path) -> Path:
    """Return the data set, with present statistics of its training trajectories."""
    sealed.write(root / "statistics.json", {"acceleration_std": 50.0, "data_sha256": split_checksum(root, "train")})
    return root


def datamodule(root: Path, step: int = 0, **settings: Any) -> TrajectoryDataModule:
    module = TrajectoryDataModule(root, GraphConfig(history=2), Noise(0.0, 0.5), **{"batch_size": BatchSize(2), "seed": 1, **settings})
    module.trainer = SimpleNamespace(global_step=step)  # type: ignore[assignment]
    return module


def first_batches(module: TrajectoryDataModule, count: int) -> list[Any]:
    return list(itertools.islice(module.train_dataloader(), count))


def _group_and_handlers(results: Any) -> None:
    _set_up_worker(0)
    results.put((os.getpgid(0) == os.getpid(), signal.getsignal(signal.SIGUSR1), signal.getsignal(signal.SIGTERM)))


def test_signals_to_the_group_of_a_training_do_not_reach_its_workers() -> None:
    """Training needs them until it has saved. SIGTERM alone ends a worker, as PyTorch does."""
    context = multiprocessing.get_context("fork")
    results = context.SimpleQueue()
    process = context.Process(target=_group_and_handlers, args=(results,))
    process.start()
    process.join()
    assert results.get() == (True, signal.SIG_IGN, signal.getsignal(signal.SIGTERM))


def test_a_resumed_loader_continues_the_sequence(root: Path) -> None:
    whole = first_batches(datamodule(root), 8)
    resumed = first_batches(datamodule(root, step=3), 5)
    for a, b in zip(whole[3:], resumed, strict=True):
        assert torch.equal(a["sand"].x, b["sand"].x)
        assert torch.equal(a["sand"].target, b["sand"].target)
        assert torch.equal(a["sand", "radius", "sand"].edge_index, b["sand", "radius", "sand"].edge_index)
    places = [(int(t), int(f)) for batch in whole[:3] for t, f in zip(batch.trajectory, batch.frame, strict=True)]
    assert sorted(places) == [(t, f) for t in (0, 1) for f in (2, 3, 4)]  # one pass


@pytest.mark.slow
def test_worker_processes_change_nothing(root: Path) -> None:
    for a, b in zip(first_batches(datamodule(root), 4), first_batches(datamodule(root, num_workers=2), 4), strict=True):
        assert torch.equal(a["sand"].x, b["sand"].x)
        assert torch.equal(a["sand"].target, b["sand"].target)


def test_validation_windows_are_fixed_and_free_of_noise(root: Path) -> None:
    module = datamodule(root)
    for _ in range(2):
        frames = torch.cat([b.frame for b in module.val_dataloader()]).tolist()
        assert frames == [2, 3, 4]
    batch = next(iter(module.val_dataloader()))
    clean = torch.cat([module.val_set[k]["sand"].target for k in range(3)])
    assert module.val_set.noise is None
    assert torch.equal(batch["sand"].target, clean)
    few = datamodule(root, num_val_windows=2)
    assert [b.frame.tolist() for b in few.val_dataloader()] == [[2, 4]]


@pytest.mark.slow
def test_validation_batches_keep_the_budget_of_nodes_and_change_no_value(root: Path) -> None:
    plain = list(datamodule(root).val_dataloader())
    assert [b["sand"].num_nodes for b in plain] == [36]
    for max_nodes, sizes in ((30, [24, 12]), (24, [24, 12]), (23, [12] * 3), (5, [12] * 3)):
        batches = list(datamodule(root, batch_size=BatchSize(2, max_nodes)).val_dataloader())
        assert [b["sand"].num_nodes for b in batches] == sizes
        for key in ("x", "target"):
            assert torch.equal(torch.cat([b["sand"][key] for b in batches]), plain[0]["sand"][key])


def test_the_nodes_of_a_validation_batch_are_shared_by_the_ranks(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.system.ranks.num_ranks", lambda: 2)
    module = datamodule(root, batch_size=BatchSize(2, 24))
    assert [b.frame.tolist() for b in module.val_dataloader()] == [[2], [4]]
    monkeypatch.setattr("gpe_pl.system.ranks.rank", lambda: 1)
    assert [b.frame.tolist() for b in module.val_dataloader()] == [[3]]


def test_validation_graphs_are_built_when_asked_for_and_held_within_a_limit(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module, built = datamodule(root), list[int]()
    read = WindowDataset.__getitem__

    def read_and_note(self: WindowDataset, window: int) -> Any:
        built.append(window)
        return read(self, window)

    monkeypatch.setattr(WindowDataset, "__getitem__", read_and_note)
    loader = module.val_dataloader()
    assert built == []
    first, again = list(loader), list(loader)
    assert built == [0, 1, 2] and torch.equal(first[0]["sand"].x, again[0]["sand"].x)
    size = sum(v.nbytes for s in module.val_set[0].stores for v in s.values() if isinstance(v, torch.Tensor))
    built.clear()
    graphs = CachedGraphs(module.val_set, cache_bytes=size + size // 2)  # room for one of about this size
    for _ in range(2):
        for window in (0, 1):
            assert torch.equal(graphs[window]["sand"].x, first[0]["sand"].x[12 * window : 12 * window + 12])
    assert built == [0, 1, 1] and graphs.free_bytes >= 0


def test_statistics_are_those_of_noisy_inputs(root: Path) -> None:
    module = datamodule(root, num_statistics_windows=4)
    sample = list(module.statistics_sample())
    assert len(sample) == 4
    assert [int(s.frame) for s in sample] == [module.train_set.locate(k)[1] for k in (0, 2, 3, 5)]
    assert module.train_set.velocity_unit == pytest.approx(50.0 * module.metadata.frame_dt)
    clean = TrajectoryDataModule(root, GraphConfig(history=2), Noise(0.0, 0.0), BatchSize(2), num_statistics_windows=4)
    assert not torch.equal(sample[0]["sand"].x, next(iter(clean.statistics_sample()))["sand"].x)


def test_parameter_ranges_cover_what_the_sample_of_windows_leaves_out(root: Path) -> None:
    def other(trajectory: Trajectory) -> Trajectory:
        return replace(trajectory, material_params=trajectory.material_params + 7.0)

    module = datamodule(with_another(root, other), num_statistics_windows=1)
    (sample,) = module.statistics_sample()
    known = sample["sand"].material_params
    low, high = module.parameter_ranges()["sand"]
    assert float(low) == known.min()
    assert float(high) == pytest.approx(float(known.max()) + 7.0)


FRAMES, BLOCK = 4, 0.05 * np.stack(np.meshgrid(np.arange(3), np.arange(3)), -1).reshape(-1, 2)


def scene(seed: int, *materials: tuple[str, float], gap: float = 0.5) -> Trajectory:
    """Return nine nodes of each material, with its parameter, in random motion; the materials are far apart unless a distance is given."""
    rng = np.random.default_rng(seed)
    first = np.concatenate([BLOCK + np.array([gap * k, 0.0]) for k in range(len(materials))])
    pos = first + np.cumsum(rng.normal(scale=2e-3, size=(FRAMES, *first.shape)), axis=0)
    names = [name for name, _ in materials for _ in BLOCK]
    return Trajectory.from_numpy(pos, 0.005, names, dict(materials), bounds=((-1, 2), (-1, 2)), spacing=0.05)


def imported(folder: Path, train: list[Trajectory]) -> TrajectoryDataModule:
    """Return a data set with these training trajectories of one window each; the sample for statistics takes eight."""
    save_dataset(folder, "made", train=train, val=[scene(1001, ("fluid", 1e-3))], test=[scene(1002, ("fluid", 1e-3))])
    return TrajectoryDataModule(folder / "made" / "imported", GraphConfig(history=2), Noise(), BatchSize(2), num_statistics_windows=8)


def with_statistics(data: TrajectoryDataModule) -> LearnedSimulator:
    simulator = LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=4), data.builder)
    simulator.fit_statistics(data.statistics_sample(), data.parameter_ranges())
    return simulator


@pytest.mark.slow
def test_a_rare_material_is_standardised_like_any_other(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Sand is in two of twelve trajectories, which the eight windows skip; snow is in a third, far from the fluid."""
    train = [scene(k, ("fluid", 1e-3)) for k in range(12)]
    skipped = sorted({*range(12)} - {*np.linspace(0, 11, 8).round().astype(int).tolist()})
    for place, angle in zip(skipped[:2], (15.0, 40.0), strict=True):
        train[place] = scene(place, ("sand", angle))
    train[skipped[2]] = scene(0, ("fluid", 1e-3), ("snow", 7.0))
    data = imported(tmp_path, train)
    statistics = with_statistics(data).standardizer.state_dict()
    assert float(statistics["params.sand.mean"]) == pytest.approx(27.5)
    assert float(statistics["params.sand.std"]) == pytest.approx(12.5)
    graphs = [data.train_set[k] for k in skipped[:2]]
    x = torch.cat([graph["sand"].x for graph in graphs])
    torch.testing.assert_close(statistics["node.sand.mean"], x.double().mean(dim=0).float())
    odd = torch.cat([graph["sand", "radius", "sand"].odd for graph in graphs])
    torch.testing.assert_close(statistics["odd.sand__radius__sand.std"], odd.double().square().mean(dim=0).sqrt().float())
    assert float(statistics["params.snow.mean"]) == 7.0
    missing = [r.message for r in caplog.records]
    assert missing == ["not in the training windows that statistics are taken from: snow–radius–fluid; its features are not standardised"]


@pytest.mark.slow
@pytest.mark.parametrize("num_touching", [2, 12])
def test_a_rare_contact_is_standardised_like_any_other(tmp_path: Path, caplog: pytest.LogCaptureFixture, num_touching: int) -> None:
    """Sand and fluid are in all trajectories, and touch in two that the eight windows skip; or in all, of which the eight windows tell enough."""
    data = (("fluid", 1e-3), ("sand", 30.0))
    sampled = np.linspace(0, 11, 8).round().astype(int).tolist()
    touching = (sorted({*range(12)} - {*sampled}) + sampled)[:num_touching]
    module = imported(tmp_path, [scene(k, *data, gap=0.15 if k in touching else 0.5) for k in range(12)])
    statistics = with_statistics(module).standardizer.state_dict()
    graphs = [module.train_set[k] for k in (touching if num_touching == 2 else sampled)]
    odd = torch.cat([graph["sand", "radius", "fluid"].odd for graph in graphs])
    assert len(odd)
    torch.testing.assert_close(statistics["odd.sand__radius__fluid.std"], odd.double().square().mean(dim=0).sqrt().float())
    x = torch.cat([module.train_set[k]["sand"].x for k in sampled])
    torch.testing.assert_close(statistics["node.sand.mean"], x.double().mean(dim=0).float())
    assert not caplog.records


def test_the_statistics_of_what_is_common_are_those_of_the_sample(root: Path) -> None:
    """Bit for bit, as with one material."""
    data = datamodule(root)
    plain = LearnedSimulator(GPE(data.builder.spec, num_message_passing_steps=1, hidden_channels=4), data.builder)
    plain.fit_statistics(list(data.statistics_sample()), data.parameter_ranges())
    for a, b in zip(plain.standardizer.buffers(), with_statistics(data).standardizer.buffers(), strict=True):
        assert torch.equal(a, b)


def test_validation_trajectories_come_from_the_validation_split(root: Path) -> None:
    assert [t.metadata.split for t in datamodule(root).val_trajectories(3)] == ["val"]


@pytest.mark.slow
@pytest.mark.parametrize("content", [None, "", "{"])
def test_missing_statistics_are_a_readable_error(root: Path, content: str | None) -> None:
    path = root / "statistics.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(StoreError, match=r"statistics.json: .*; generate or import the data again"):
        datamodule(root)


def test_a_missing_split_is_named(root: Path) -> None:
    (root / "val" / "shard-00000.h5").unlink()
    with pytest.raises(StoreError, match="has no split 'val' but test, test_unseen, train"):
        datamodule(root)


def with_another(root: Path, change: Callable[[Trajectory], Trajectory], num_sound: int = 6, num_changed: int = 1) -> Path:
    """Return the data set with other training trajectories, which swing to and fro; the last of them are changed."""
    shard = root / "train" / "shard-00000.h5"
    jumping = read_trajectory(shard, trajectory_names(shard)[0])
    swing = 1e-3 * np.sin(np.arange(jumping.num_frames))[:, None, None]
    sound = replace(jumping, pos=(jumping.pos[:1] + swing).astype(np.float32))
    shard.unlink()
    write_shard(shard, [*[sound] * num_sound, *[change(sound)] * num_changed])
    return described(root)


def moved(frame: int, to: float) -> Callable[[Trajectory], Trajectory]:
    def change(trajectory: Trajectory) -> Trajectory:
        pos = trajectory.pos.copy()
        pos[frame] = to
        return replace(trajectory, pos=pos)

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (moved(3, np.nan), r"field 'pos': frame 3, node 0, dim 0 and \d+ more: not finite"),
        (moved(3, 1e9), r"the position of node 0 in frame 3 lies outside the domain by more than its width"),
        (moved(4, 0.5), r"node \d+ jumps by .* m between frames 3 and 4"),
        (moved(0, 0.5), r"node \d+ jumps by .* m between frames 0 and 1"),
        (lambda t: replace(t, mass=0 * t.mass), r"field 'mass': node 0 and \d+ more: must be positive and finite, is 0"),
        (
            lambda t: replace(t, material_params=np.nan * t.material_params),
            r"field 'material_params': friction_angle: node 0 and \d+ more: NaN",
        ),
        (lambda t: replace(t, metadata=replace(t.metadata, frame_dt=-1.0)), r"frame_dt is -1.0, must be positive"),
    ],
)
def test_a_damaged_trajectory_is_left_out_by_name(
    root: Path, change: Callable[[Trajectory], Trajectory], message: str, caplog: pytest.LogCaptureFixture
) -> None:
    sound = datamodule(with_another(root, lambda t: t))
    assert len(sound.train_set.trajectories) == 7
    assert not caplog.records
    module = datamodule(with_another(root, change))
    assert [t.name for t in module.train_set.trajectories] == [t.name for t in sound.train_set.trajectories[:6]]
    assert re.search(rf"shard-00000.h5:{sound.train_set.trajectories[6].name}: left out, {message}", caplog.text)
    spread = np.concatenate([v.ravel() for key, v in motion(module.train_set.trajectories[0].window(0, 100)) if key == "acceleration"])
    assert module.train_set.velocity_unit == pytest.approx(
        float(np.sqrt(np.square(spread).mean())) * module.metadata.frame_dt
    )  # without it
    assert sound.train_set.velocity_unit == 50.0 * module.metadata.frame_dt


def test_many_damaged_trajectories_are_an_error(root: Path) -> None:
    with pytest.raises(StoreError, match="train: 2 of 4 trajectories cannot be used"):
        datamodule(with_another(root, moved(3, np.nan), 2, 2))


def test_one_damaged_trajectory_is_never_too_many_unless_it_is_all(root: Path) -> None:
    assert len(datamodule(with_another(root, moved(3, np.nan), 1)).train_set.trajectories) == 1
    with pytest.raises(StoreError, match="train: 1 of 1 trajectories cannot be used"):
        datamodule(with_another(root, moved(3, np.nan), 0))


@pytest.mark.slow
@pytest.mark.parametrize("num_static", [0, 5])
def test_what_is_fast_is_no_jump(root: Path, num_static: int, caplog: pytest.LogCaptureFixture) -> None:
    """A projectile among things at rest, farther in a frame than neighbours see."""

    def thrown(trajectory: Trajectory) -> Trajectory:
        pos = np.broadcast_to(trajectory.pos[:1], trajectory.pos.shape).copy()
        pos[:, 0, 0] = -0.9 + 0.32 * np.arange(len(pos)) % 2.8
        return replace(trajectory, pos=pos[:9])

    assert len(datamodule(with_another(root, thrown, num_static)).train_set.trajectories) == num_static + 1
    assert not caplog.records


def test_what_is_evaluated_is_not_damaged(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Rollouts of the validation split, and those of an evaluation."""
    shard = root / "val" / "shard-00000.h5"
    (name,) = trajectory_names(shard)
    sound = read_trajectory(shard, name)
    shard.unlink()
    write_shard(shard, [moved(3, np.nan)(sound), sound])
    (kept,) = datamodule(root).val_trajectories(4)
    assert np.array_equal(kept.pos, sound.pos)
    assert re.search(r"val/shard-00000.h5:00000: left out, field 'pos': frame 3, node 0, dim 0 and \d+ more: not finite", caplog.text)
