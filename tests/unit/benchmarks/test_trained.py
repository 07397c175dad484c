import pytest

from gpe_pl.benchmarks.trained import checkpoint_label


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
