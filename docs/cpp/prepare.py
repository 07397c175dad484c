"""Writes what ``rollout.cpp`` reads: the compiled model and the start of a scene.

    python docs/cpp/prepare.py sand build
    cmake -S docs/cpp -B build -DCMAKE_PREFIX_PATH=$(python -c "import torch; print(torch.utils.cmake_prefix_path)")
    cmake --build build
    build/rollout build/model.pt2 build/scene.pt 100 build/positions.bin

``positions.bin`` then holds the positions of all frames: float64 [frame, node, dim] in m.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from gpe_pl import LearnedSimulator, Scene, State
from gpe_pl.export.compiled_program import export_compiled
from gpe_pl.export.program import scene_of


def prepare(simulator: LearnedSimulator, start: State, bounds: Sequence[tuple[float, float]], folder: Path) -> None:
    """Write ``model.pt2`` and ``scene.pt`` of a model of one material, for a state with velocity history in a box with these ``(low, high)`` per axis [m]."""
    folder.mkdir(parents=True, exist_ok=True)
    own, builder = simulator.builder.metadata, simulator.builder
    export_compiled(simulator, folder / "model.pt2", [start, simulator.step(start)])
    low, high = torch.tensor(bounds, dtype=torch.float64).T
    about = {
        "low": low.contiguous(),
        "high": high.contiguous(),
        "radius": torch.tensor(builder.scales.radius).double(),
        "frame_dt": torch.tensor(own.frame_dt).double(),
    }
    torch.save({"inputs": scene_of(simulator, start), "about": about}, folder / "scene.pt")


if __name__ == "__main__":
    model = LearnedSimulator.from_checkpoint(sys.argv[1])
    scene = Scene(box=(1.0, 1.0)).block(model.builder.spec.materials[0], at=(0.1, 0.0), size=(0.2, 0.4))
    state, metadata = scene.state(model)
    prepare(model, model.standing(state, metadata), metadata.bounds, Path(sys.argv[2]))
