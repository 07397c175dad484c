"""The lines in the package's docstring, as they stand there, on a smaller data set."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest
import torch

import gpe_pl
from gpe_pl.config import ConfigError
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.models.gpe import GPE

CHECKPOINT = "runs/sand/checkpoints/best.ckpt"


def example() -> str:
    assert gpe_pl.__doc__ is not None
    block = gpe_pl.__doc__.split("::\n\n")[1].split("\n\n")[0]
    return textwrap.dedent(block).replace("size=small", "size=tiny")


@pytest.mark.slow
def test_five_lines_from_a_checkpoint_to_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = gpe_pl.dataset("data=sand", "size=tiny")
    metadata = gpe_pl.generate_trajectory(spec, "test", 0, num_frames=3).metadata
    builder = GraphBuilder(GraphConfig(), metadata)
    torch.manual_seed(0)
    gpe_pl.LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder).save(tmp_path / CHECKPOINT)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    assert len(example().splitlines()) == 5
    exec(example(), names)
    assert (tmp_path / "rollout.png").stat().st_size > 1000
    truth, prediction = names["truth"], names["prediction"]
    assert isinstance(truth, gpe_pl.Trajectory) and isinstance(prediction, gpe_pl.Trajectory)
    assert (truth.material_params == 27.5).all() and prediction.num_frames == 101


def test_a_data_set_that_does_not_exist_is_explained() -> None:
    with pytest.raises(ConfigError, match="valid keys"):
        gpe_pl.dataset("data=sand", "sise=tiny")
    assert gpe_pl.dataset("data=snow", "size=tiny").name == "snow"
