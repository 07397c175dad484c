"""The Python example in the package's docstring runs as written."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

import gpe_pl
from gpe_pl.config.entry_point import ConfigError


def example() -> str:
    assert gpe_pl.__doc__ is not None
    block = gpe_pl.__doc__.split("::\n\n")[1].split("\n\n")[0]
    return textwrap.dedent(block)


@pytest.mark.slow
def test_five_lines_from_a_shipped_model_to_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
