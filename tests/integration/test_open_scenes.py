"""``simulate``, ``fit``, ``evaluate`` and ``benchmark suite=channel`` with channels whose nodes enter and leave."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.generation import generate
from gpe_pl.data.validate import validate
from gpe_pl.evaluation.metric_rows import LEARNED, read_rows
from gpe_pl.fit import fit
from gpe_pl.trajectory.store import shards
from tests.runs import RUN, compose

CHANNEL = (
    *("size=tiny", "data=channel", "dimension=2"),
    *(
        f"++data.sizes.tiny.{key}={value}"
        for key, value in {"num_train": 2, "num_val": 1, "num_test": 1, "num_test_unseen": 2, "num_frames": 24}.items()
    ),
)


@pytest.mark.slow
def test_a_model_is_trained_and_evaluated_on_channels(tmp_path: Path) -> None:
    data, runs = tmp_path / "data", tmp_path / "runs"
    folder = generate(data, dataset_spec(compose("simulate", *CHANNEL)), 1)
    assert not validate([path for split in ("train", "val", "test", "test_unseen") for path in shards(folder, split)]).violations
    push = ("training.push_fraction=0.5", "training.push_steps=3", "training.num_steps=4", "training.val_interval=2")
    fit(compose("fit", *CHANNEL, *RUN, *push, "training.sampling=activity", f"paths.data={data}", f"paths.runs={runs}", "name=channel"))
    rows = [*read_rows(runs / "channel" / "metrics.csv")]
    found = {row.metric for row in rows if row.model == LEARNED}
    assert {"one_step_nmse", "rollout_mse", "mass_error", "outflow_error", "energy_distance"} <= found
    assert all(row.value == 0.0 or row.value > 0.0 for row in rows if row.metric == "mass_error")
