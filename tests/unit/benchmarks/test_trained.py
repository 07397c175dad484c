from pathlib import Path

import pytest

from gpe_pl.benchmarks.trained import StrideError, checkpoint_label, of_stored_frames
from gpe_pl.learned.simulator import LearnedSimulator


@pytest.mark.parametrize(
    ("checkpoint", "label"),
    [
        ("runs/sand", "sand"),
        ("runs/sweep/training.learning_rate=0.001", "training.learning_rate=0.001"),
        ("runs/sweep/training.learning_rate=0.001/checkpoints/best.ckpt", "training.learning_rate=0.001"),
        ("copies/sand.v2.ckpt", "sand.v2"),
        ("sand", "sand"),
    ],
)
def test_a_model_is_called_by_its_run_or_file(checkpoint: str, label: str) -> None:
    assert checkpoint_label(checkpoint) == label


def test_models_with_longer_frames_than_stored_ones_are_refused(checkpoint: Path, tmp_path: Path) -> None:
    assert of_stored_frames(checkpoint).stride == 1
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    simulator.stride = 4
    simulator.save(tmp_path / "longer.ckpt")
    with pytest.raises(StrideError, match=r"longer.ckpt: was trained with data.stride=4, and suites run models on stored frames; choose"):
        of_stored_frames(tmp_path / "longer.ckpt")
