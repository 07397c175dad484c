"""The example in C++ rolls a model out as Python does, with containment."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch

from gpe_pl.export import compiled_program
from gpe_pl.export.compiled_program import CompiledProgramError, export_compiled
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import rollout
from tests import scenes
from tests.unit.export.test_program import simulator

EXAMPLE = Path(__file__).parents[2] / "docs" / "cpp"
NUM_STEPS = 6


def run(*command: str) -> None:
    child = subprocess.run(command, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stdout + child.stderr


@pytest.mark.long
@pytest.mark.skipif(not (shutil.which("cmake") and shutil.which("g++")), reason="needs cmake and g++")
def test_the_example_moves_particles_as_python_does(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("prepare", EXAMPLE / "prepare.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    learned = simulator(config={"history": 2, "islands": True}, island_momentum="angular", num_message_passing_steps=1)
    state = scenes.state(history=2, low=0.03, high=0.9).to_torch()
    fast = state.vel + torch.tensor([0.0, -4.0], dtype=torch.float64)  # so that containment has to act
    state = replace(state, vel=fast, velocity_history=torch.stack([fast, fast], dim=1))
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)  # lengths are symbols during export
    try:
        example.prepare(learned, state, learned.builder.metadata.bounds, tmp_path)
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    run("cmake", "-S", str(EXAMPLE), "-B", str(tmp_path / "build"), prefix, "-DCMAKE_CXX_FLAGS=-O0")
    run("cmake", "--build", str(tmp_path / "build"))
    run(str(tmp_path / "build" / "rollout"), *(str(tmp_path / n) for n in ("model.pt2", "scene.pt")), str(NUM_STEPS), str(tmp_path / "out"))
    metadata = learned.builder.metadata
    expected = rollout(Contained(learned, metadata.frame_dt), state, NUM_STEPS, metadata)
    free = rollout(learned, state, NUM_STEPS, metadata)
    found = np.fromfile(tmp_path / "out").reshape(expected.pos.shape)
    np.testing.assert_allclose(found, expected.pos, rtol=0, atol=1e-6)
    assert np.abs(free.pos - expected.pos).max() > 0.01


@pytest.mark.parametrize("moved_by", [1.0, np.nan])
def test_a_compiled_program_that_differs_is_not_written(moved_by: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned = simulator(config={"history": 2})
    state = scenes.state(history=2).to_torch()

    class Inductor:
        @staticmethod
        def aoti_compile_and_package(program: object, package_path: str, inductor_configs: object) -> None:
            Path(package_path).write_bytes(b"program")

        @staticmethod
        def aoti_load_package(path: str) -> object:
            return lambda scene: ({"pos.sand": scene["pos.sand"] + moved_by}, {})

    monkeypatch.setattr(torch, "_inductor", Inductor)
    monkeypatch.setattr(torch.export, "load", lambda _: None)
    monkeypatch.setattr(compiled_program, "export_model", lambda *_: None)
    with pytest.raises(CompiledProgramError, match=r"differs from that of the model by .* m, at most 1e-06 m are allowed"):
        export_compiled(learned, tmp_path / "model.pt2", [state])
    assert not [*tmp_path.iterdir()]
    with pytest.raises(ValueError, match=r"ends in \.pt2"):
        export_compiled(learned, tmp_path / "model.so", [state])
