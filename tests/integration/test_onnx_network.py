"""Networks in ONNX compute the steps of their models, and others are refused."""

from __future__ import annotations

from pathlib import Path

import jaxtyping
import pytest

from gpe_pl.export import onnx_network
from gpe_pl.export.agreement import STRESS_TOLERANCE, TOLERANCE
from gpe_pl.export.onnx_network import OnnxError, export_network
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import steps
from gpe_pl.scenes.recorded import recorded_scene
from gpe_pl.scenes.rollouts import middle_values
from gpe_pl.trajectory.state import State

NUM_STEPS = 60
"""Number of steps after which bodies touch walls."""


def starts(simulator: LearnedSimulator, count: int) -> list[State]:
    """Return two states of each of some scenes: at the start, and later."""
    metadata = simulator.builder.metadata
    scene, values = recorded_scene(metadata), middle_values(simulator)
    states = [simulator.standing(scene.sample(values, seed), metadata) for seed in range(count)]
    return [item for state in states for item in (state, [*steps(simulator, state, NUM_STEPS)][-1])]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sand", *(pytest.param(name, marks=pytest.mark.long) for name in ("snow", "fluid", "elastomer", "fem"))])
def test_shipped_networks_equal_their_models(name: str, tmp_path: Path) -> None:
    for package in ("onnx", "onnxruntime", "onnxscript"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    simulator = LearnedSimulator.from_checkpoint(name)
    without_checks = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)  # lengths are symbols while a program is made
    try:
        found = export_network(simulator, tmp_path / "network.onnx", starts(simulator, 3))
    finally:
        jaxtyping.config.update("jaxtyping_disable", without_checks)
    assert 0 <= found <= TOLERANCE
    again = onnx_network.simulator_of(simulator, (tmp_path / "network.onnx").read_bytes())
    position, stress = onnx_network.differences(simulator, again, starts(simulator, 1))
    assert position <= TOLERANCE and stress <= STRESS_TOLERANCE * simulator.stress_std


@pytest.mark.slow
def test_a_network_that_differs_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = LearnedSimulator.from_checkpoint("sand")
    other = LearnedSimulator.from_checkpoint("sand")
    other.acceleration_std.mul_(2)
    monkeypatch.setattr(onnx_network, "_program", lambda *_: b"")
    monkeypatch.setattr(onnx_network, "simulator_of", lambda *_: other)
    with pytest.raises(OnnxError, match=r"one step of the exported network differs from that of the model by .* m, at most 1e-06 m"):
        export_network(simulator, tmp_path / "network.onnx", starts(simulator, 1))
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_network_with_other_stresses_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator, other = (LearnedSimulator.from_checkpoint("fem") for _ in range(2))
    other.stress_std.mul_(2)
    monkeypatch.setattr(onnx_network, "_program", lambda *_: b"")
    monkeypatch.setattr(onnx_network, "simulator_of", lambda *_: other)
    with pytest.raises(
        OnnxError, match=r"one step of the exported network differs from that of the model by .* Pa, at most .* Pa are allowed"
    ):
        export_network(simulator, tmp_path / "network.onnx", starts(simulator, 1))
    assert not any(tmp_path.iterdir())


def test_another_file_type_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.onnx"):
        export_network(LearnedSimulator.from_checkpoint("sand"), tmp_path / "network.pt2", [])
