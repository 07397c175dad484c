"""Samples are pure functions of their number, never change stored data, and have the target that the integrator needs."""

from __future__ import annotations

import collections
import copy
import functools
import hashlib
import itertools
import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import h5py
import numpy as np
import pytest
import torch

from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.dataset import CACHE_BYTES, StartKey, StoredTrajectory, WindowDataset, collated, long_enough, open_split, usable
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import NUM_LANES, UNIFORM_FRACTION, BatchSampler, BatchSize, PushForward, StepSampler, probabilities
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.store import StoreError, read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from tests.scenes import assert_equal_graphs

NOISE = Noise(0.0, 0.5)


def dataset(root: Path, history: int = 2, noise: Noise | None = NOISE, seed: int = 3, cache_bytes: int = 2**30) -> WindowDataset:
    stored = open_split(root, "train", cache_bytes)
    return WindowDataset(stored, GraphBuilder(GraphConfig(history=history), stored[0].window(0, 1).metadata), noise, 10.0, seed)


def arrays_of(trajectory: Trajectory) -> dict[str, np.ndarray]:
    owners = {"": trajectory, "boundary.": trajectory.boundary}
    return {f"{prefix}{k}": v for prefix, owner in owners.items() for k, v in vars(owner).items() if isinstance(v, np.ndarray)}


@pytest.mark.slow
@pytest.mark.parametrize("cache_bytes", [0, 2**30])
@pytest.mark.parametrize("noise", [Noise(0.1, 0.0), Noise(0.0, 0.5)])
def test_an_epoch_with_noise_changes_nothing_that_is_stored(store: Path, noise: Noise, cache_bytes: int) -> None:
    def files() -> dict[str, str]:
        return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(store.rglob("*")) if p.is_file()}

    data = dataset(store, noise=noise, cache_bytes=cache_bytes)
    held = [t.cached for t in data.trajectories if t.cached is not None]
    assert len(held) == (2 if cache_bytes else 0)
    on_disk, in_memory = files(), copy.deepcopy([arrays_of(t) for t in held])
    for sample, window in itertools.islice(StepSampler(len(data), 0), len(data)):
        item = data[sample, window]
        for node_store in item.node_stores:  # what comes out may be changed without harm
            node_store.x.zero_()
        item["sand"].material_params.fill_(-1.0)
    assert files() == on_disk
    for trajectory, before in zip(held, in_memory, strict=True):
        for key, value in arrays_of(trajectory).items():
            assert value.tobytes() == before[key].tobytes(), key


def test_held_arrays_cannot_be_written(store: Path) -> None:
    for stored in open_split(store, "train"):
        assert stored.cached is not None
        arrays = arrays_of(stored.cached)
        assert {"pos", "vel", "mass", "boundary.pos", "boundary.friction"} <= set(arrays)
        for key, value in {**arrays, "window": stored.window(1, 3).pos}.items():
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0
            assert not value.flags.writeable, key


def test_a_sample_is_a_pure_function_of_split_seed_and_number(store: Path) -> None:
    data = dataset(store)
    first = data[7, 2]
    for other in (0, 5, 1):
        data[other, other]
    assert_equal_graphs(data[7, 2], first)
    assert_equal_graphs(dataset(store)[7, 2], first)
    for different in (dataset(store, seed=4)[7, 2], data[8, 2], data[7, 3]):
        assert not torch.equal(different["sand"].target, first["sand"].target)
    assert_equal_graphs(data[2], data[2, 2])


@pytest.mark.parametrize("history", [1, 2, 4])
def test_windows_cover_every_frame_with_a_past_and_a_future(store: Path, history: int) -> None:
    data = dataset(store, history)
    places = [data.locate(k) for k in range(len(data))]
    assert places == [(t, frame) for t in (0, 1) for frame in range(history, 5)]
    for k, (number, frame) in enumerate(places):
        assert (data[k].trajectory, data[k].frame) == (number, frame)


@pytest.mark.slow
@pytest.mark.parametrize("history", [1, 3])
def test_without_noise_the_target_is_the_integrators_acceleration(store: Path, history: int) -> None:
    data = dataset(store, history, noise=None)
    for k in range(len(data)):
        number, frame = data.locate(k)
        trajectory = read_trajectory(store / "train" / "shard-00000.h5", f"{number:05d}")
        dt, pos = trajectory.metadata.frame_dt, trajectory.pos.astype(np.float64)
        vel = integrators.velocities(pos[frame - 1 : frame + 2], dt)
        expected = integrators.acceleration(vel[1], vel[0], dt) - np.array(trajectory.metadata.gravity)
        graph = data[k]["sand"]
        np.testing.assert_allclose(graph.target, expected[graph.node_id], rtol=1e-6)


def test_with_noise_graph_and_target_belong_to_the_same_window(store: Path) -> None:
    """Velocity noise: last velocity plus target is the true next velocity, in the units of the features."""
    noisy, clean = dataset(store), dataset(store, noise=None)
    scales, gravity = noisy.builder.scales, torch.tensor([0.0, -9.81])
    for k in range(len(noisy)):
        a, b = noisy[k]["sand"], clean[k]["sand"]
        assert (a.x[:, :2] != b.x[:, :2]).all()
        after = [s.x[:, :2] * scales.velocity + (s.target + gravity) * scales.frame_dt for s in (a, b)]
        torch.testing.assert_close(after[0], after[1], rtol=1e-4, atol=1e-3)


def test_windows_read_from_disk_equal_held_ones(store: Path) -> None:
    held, read = dataset(store), dataset(store, cache_bytes=0)
    assert len(held) == len(read)
    assert all(t.cached is None for t in read.trajectories)
    for k in range(len(held)):
        assert_equal_graphs(held[k + 5, k], read[k + 5, k])


def test_trajectories_that_are_too_short_are_skipped(
    tmp_path: Path, new_trajectory: Callable[..., Trajectory], caplog: pytest.LogCaptureFixture
) -> None:
    lengths = (3, 6, 4, 5)
    write_shard(tmp_path / "train" / "shard-00000.h5", [new_trajectory(k, num_frames=n) for k, n in enumerate(lengths)])
    data = dataset(tmp_path, history=3)
    assert [data.locate(k) for k in range(len(data))] == [(1, 3), (1, 4), (3, 3)]
    assert caplog.messages == [f"{tmp_path / 'train'}: 2 of 4 trajectories have fewer than 5 frames and give no window"]
    with pytest.raises(StoreError, match=r"no trajectory has the 7 frames that a start at frame 5 needs .*; the longest has 6"):
        dataset(tmp_path, history=5)


@pytest.mark.parametrize("cache_bytes", [0, 2**30])
def test_a_position_that_is_not_finite_is_named(store: Path, cache_bytes: int) -> None:
    path = store / "train" / "shard-00000.h5"
    sound, other = (read_trajectory(path, f"{k:05d}") for k in range(2))
    pos = other.pos.copy()
    pos[4, 7, 1] = np.nan
    write_shard(path, [sound, replace(other, pos=pos)])
    data = dataset(store, noise=None, cache_bytes=cache_bytes)
    assert torch.isfinite(data[0]["sand"].x).all()
    with pytest.raises(StoreError, match=r"shard-00000.h5:00001: field 'pos': frame 4, node 7, dim 1: not finite"):
        data[5]


@pytest.mark.parametrize("num_windows", [1, 7, 10])
def test_step_sampler_covers_each_epoch_once_in_another_order(num_windows: int) -> None:
    drawn = list(itertools.islice(StepSampler(num_windows, seed=5), 3 * num_windows))
    assert [sample for sample, _ in drawn] == list(range(3 * num_windows))
    epochs = [[w for _, w in drawn[k * num_windows : (k + 1) * num_windows]] for k in range(3)]
    assert all(sorted(e) == list(range(num_windows)) for e in epochs)
    if num_windows > 1:
        assert epochs[0] != epochs[1]
        assert epochs[0] != [w for _, w in itertools.islice(StepSampler(num_windows, seed=6), num_windows)]


@pytest.mark.parametrize("start", [0, 1, 6, 7, 8, 20])
def test_step_sampler_starts_anywhere(start: int) -> None:
    whole = list(itertools.islice(StepSampler(7, seed=5), 40))
    assert list(itertools.islice(StepSampler(7, seed=5, start=lambda: start), 15)) == whole[start : start + 15]


def test_step_sampler_asks_for_its_start_when_iteration_begins() -> None:
    consumed = [0]
    sampler = StepSampler(7, seed=5, start=lambda: consumed[0])
    consumed[0] = 12
    assert next(iter(sampler))[0] == 12


def test_opening_a_split_reads_no_frames_that_are_not_held(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.data.dataset.read_trajectory", lambda *_, **__: pytest.fail("read a trajectory"))
    stored = open_split(store, "train", cache_bytes=0)
    assert [(type(s), s.name, s.num_frames, s.num_nodes) for s in stored] == [
        (StoredTrajectory, "00000", 6, 12),
        (StoredTrajectory, "00001", 6, 12),
    ]


def test_batches_of_a_node_budget_hold_as_many_nodes_as_fit(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    sizes = (5, 30, 12, 8)
    write_shard(tmp_path / "train" / "shard-00000.h5", [new_trajectory(k, num_nodes=n) for k, n in enumerate(sizes)])
    data = dataset(tmp_path)
    order = list(itertools.islice(StepSampler(len(data), seed=4), 200))
    batches = list(itertools.islice(BatchSize(2, max_nodes=40).batches(data, seed=4, step=0), 30))
    taken = [sample for batch in batches for sample in batch]
    assert taken == order[: len(taken)]  # the order of any other batches, over the ends of epochs too
    assert len(taken) > 2 * len(data)
    nodes = [[sizes[data.locate(window)[0]] for _, window in batch] for batch in batches]
    assert all(sum(batch) <= 40 < sum(batch) + following[0] for batch, following in itertools.pairwise(nodes))
    assert len({len(batch) for batch in batches}) > 1
    assert list(itertools.islice(BatchSize(2, max_nodes=40).batches(data, seed=4, step=17), 13)) == batches[17:]
    assert [len(b) for b in itertools.islice(BatchSize(2, max_nodes=1).batches(data, seed=4, step=0), 20)] == [1] * 20


def test_batches_of_a_number_of_graphs_are_cut_from_the_order(store: Path) -> None:
    data = dataset(store)
    order = list(itertools.islice(StepSampler(len(data), seed=4), 24))
    assert list(itertools.islice(BatchSize(4).batches(data, seed=4, step=2), 4)) == [order[k : k + 4] for k in (8, 12, 16, 20)]


@pytest.mark.slow
def test_a_split_that_is_not_held_takes_the_memory_of_a_window(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    write_shard(tmp_path / "train" / "shard-00000.h5", [new_trajectory(0, num_frames=3000, num_nodes=60)])
    size = read_trajectory(tmp_path / "train" / "shard-00000.h5", "00000").pos.nbytes
    data = dataset(tmp_path, cache_bytes=0)
    data[0]  # what the first one loads stays
    tracemalloc.start()
    for sample, window in itertools.islice(StepSampler(len(data), 0), 12):
        data[sample, window]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < size
    data = dataset(tmp_path)  # held: reading it takes more, which the test could not see otherwise
    assert sum(t.cached.pos.nbytes for t in data.trajectories if t.cached is not None) == size


# --- what is drawn, and where samples start ---------------------------------------------------------------------------------------------


def test_activity_is_the_size_of_the_targets(store: Path) -> None:
    data = dataset(store, noise=None)
    targets = [torch.cat([data[k]["sand"].target.double()]) for k in range(len(data))]
    assert data.activity() == pytest.approx([float(t.square().mean().sqrt()) for t in targets], rel=1e-5)


def test_windows_are_drawn_by_their_probability_and_weighed_by_its_inverse(store: Path) -> None:
    data = dataset(store)
    assert "weight" not in data[0]
    activity = np.arange(len(data), dtype=float)
    data.probability = probabilities(activity)
    assert data.probability.sum() == pytest.approx(1)
    assert data.probability[-1] / data.probability[1] > 2
    drawn = [w for batch in itertools.islice(BatchSize(4).batches(data, seed=0, step=0), 2500) for _, w in batch]
    fraction = np.bincount(drawn, minlength=len(data)) / len(drawn)
    assert fraction == pytest.approx(data.probability, abs=0.02)
    weights = np.array([data[0, k].weight for k in range(len(data))])
    assert (data.probability * weights).sum() == pytest.approx(1)
    assert weights.max() <= 1 / UNIFORM_FRACTION
    later = list(itertools.islice(BatchSize(4).batches(data, seed=0, step=3), 20))
    assert later == list(itertools.islice(BatchSize(4).batches(data, seed=0, step=0), 23))[3:]


def test_where_nothing_happens_all_windows_are_drawn_alike() -> None:
    assert probabilities(np.zeros(4)) == pytest.approx(np.full(4, 0.25))


def test_the_velocity_at_the_frame_is_stored_and_has_the_noise_of_the_mean_velocity(store: Path) -> None:
    clean, noisy = (dataset(store, noise=noise)[StartKey(0, 1, 0)].state for noise in (None, NOISE))
    trajectory, frame = dataset(store).locate(1)
    stored = dataset(store).trajectories[trajectory].window(frame, frame + 1).vel[0]
    torch.testing.assert_close(clean.frame_velocity, torch.from_numpy(stored).double())
    assert clean.frame_velocity is not None and noisy.frame_velocity is not None
    change = noisy.vel - clean.vel
    assert bool(change.any())
    torch.testing.assert_close(noisy.frame_velocity - clean.frame_velocity, change)


@pytest.mark.parametrize("noise", [None, Noise(0.0, 0.5, 0.3), Noise(0.01, 0.0), Noise(0.01, 0.5, 0.3)])
def test_a_start_without_unroll_is_the_usual_sample(store: Path, noise: Noise | None) -> None:
    data = dataset(store, noise=noise)
    start = data[StartKey(5, 1, 0)]
    assert start.num_steps == 0
    graph, usual = start.graph(data.builder, start.state, 0), data[5, 1]
    assert torch.allclose(graph["sand"].target, usual["sand"].target, rtol=1e-5, atol=1e-3)
    graph["sand"].target = usual["sand"].target
    assert_equal_graphs(graph, usual)


@pytest.mark.parametrize("correction", [0.2, 1.0])
def test_the_target_after_an_unroll_leads_back(store: Path, correction: float) -> None:
    """The target removes the given fractions of the deviations from the true velocity and position of its frame."""
    data = dataset(store, noise=Noise(0.0, 0.5, 0.25))
    start, dt = data[StartKey(5, 0, 2, correction=correction)], data.builder.metadata.frame_dt
    assert start.num_steps == 2 == data[StartKey(5, 0, 9)].num_steps  # the trajectory ends there
    before, truth = (start.truth[2] - start.truth[1]) / dt, (start.truth[3] - start.truth[2]) / dt
    astray = replace(start.state, pos=start.truth[2] + 0.01, vel=before + 1.0)
    target = start.graph(data.builder, astray, 2)["sand"].target.double()
    next_vel = astray.vel + (target + astray.gravity) * dt
    assert torch.allclose(next_vel, truth + (1 - correction) - 0.25 * 0.01 / dt, atol=1e-5)


def test_late_batches_ask_for_unrolls(store: Path) -> None:
    data = dataset(store)
    push = PushForward(3, 4, correction=0.3)
    keys = list(itertools.islice(BatchSampler(data, BatchSize(2), 0, lambda: 0, push), 3 + 6 * NUM_LANES))
    plain = list(itertools.islice(BatchSampler(data, BatchSize(2), 0, lambda: 0), 60))
    assert keys[:3] == plain[:3]
    late = cast(list[list[StartKey]], keys[3:])
    assert [[key[:2] for key in batch] for batch in late[:NUM_LANES]] == plain[3 : 3 + NUM_LANES]
    assert {key.correction for batch in late for key in batch} == {0.3}
    assert collections.Counter(batch[0].num_steps for batch in late[: 5 * NUM_LANES]) == dict.fromkeys(range(5), NUM_LANES)
    following = iter(cast(list[tuple[int, int]], batch) for batch in plain[3 + NUM_LANES :])
    for before, after in zip(late, late[NUM_LANES:], strict=False):  # of the same lane
        assert {key.lane for key in (*before, *after)} == {before[0].lane}
        if before[0].num_steps == push.max_steps:
            assert [key[:3] for key in after] == [(sample, window, 0) for sample, window in next(following)]
        else:
            assert after == [key._replace(num_steps=key.num_steps + 1) for key in before]
    for first in (2, 3, 4, 17, 60):
        resumed = BatchSampler(data, BatchSize(2), 0, functools.partial(int, first), push)
        assert list(itertools.islice(resumed, 10)) == keys[first : first + 10]
    starts = collated([data[key] for key in keys[5]])
    assert isinstance(starts, list) and len(starts) == 2


def edited(store: Path, key: str) -> None:
    """Return the data set after its first training trajectory was changed in place, with the old digest."""
    with h5py.File(next((store / "train").iterdir()), "r+") as file:
        group = file["00000"]
        if key == "metadata":
            text = json.dumps(json.loads(group.attrs[key]) | {"gravity": [0.0, -1.62]}, sort_keys=True)
            group.attrs[key] = np.bytes_(text.encode())
        else:
            group[key][...] = group[key][...] + np.float32(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["pos", "mass", "metadata"])
@pytest.mark.parametrize("cache_bytes", [0, CACHE_BYTES])
def test_what_was_changed_without_its_digest_is_not_learned_from(store: Path, key: str, cache_bytes: int) -> None:
    edited(store, key)
    with pytest.raises(StoreError, match=r"shard-00000.h5:00000: SHA-256 digest does not match the content"):
        usable(open_split(store, "train", cache_bytes))
    with pytest.raises(StoreError, match=r"shard-00000.h5:00000: SHA-256 digest does not match the content"):
        list(long_enough(store, "train", 2))


def test_a_split_whose_shards_are_empty_is_named(tmp_path: Path) -> None:
    write_shard(tmp_path / "train" / "shard-00000.h5", [])
    with pytest.raises(StoreError, match=r"train: its shards hold no trajectories; generate or import the data again"):
        usable(open_split(tmp_path, "train"))


def test_changed_metadata_are_other_data_though_no_array_is_read(store: Path) -> None:
    before = split_checksum(store, "train")
    edited(store, "metadata")
    assert split_checksum(store, "train") != before


def test_position_noise_is_a_fraction_of_each_trajectorys_own_domain(tmp_path: Path) -> None:
    """The first trajectory has a domain a quarter as long as the second one."""
    still = np.random.default_rng(0).uniform(0.2, 0.8, (1, 400, 2)) + np.zeros((8, 1, 1))
    write_shard(
        tmp_path / "train" / "shard-00000.h5",
        [
            Trajectory.from_numpy(
                still, 0.01, "sand", {"sand": 30.0}, bounds=((0.0, side), (0.0, 1.0)), periodic=(True, False), spacing=0.1
            )
            for side in (1.0, 4.0)
        ],
    )
    data = dataset(tmp_path, noise=Noise(1e-3, 0.0))
    numbers = [data.locate(window)[0] for window in range(len(data))]
    starts = [data[StartKey(0, numbers.index(number), 1)].state.pos.numpy() for number in range(2)]
    sizes = [np.std(start - still[0]) for start in starts]
    assert sizes == pytest.approx([1e-3, 4e-3], rel=0.1)
