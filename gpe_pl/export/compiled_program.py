"""Export of a trained model as a compiled program that C++ runs with LibTorch, without Python.

``export.program`` writes a program that Python loads. This module compiles it with PyTorch's AOTInductor for the processor of this machine. The package takes
and returns the same tensors, in the order of ``export.program.describe``: inputs as ``scene_of`` returns them; outputs as positions and velocity histories of
each material, then accelerations and stresses. ``docs/cpp`` has a caller. Compiling takes about a minute and needs a C++ compiler.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gpe_pl.errors import GpeError
from gpe_pl.export.agreement import excess, largest_difference
from gpe_pl.export.program import EVERYTHING, export_model, scene_of
from gpe_pl.files.atomic import replace_bytes
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.trajectory.state import State

INDUCTOR = {"aot_inductor.precompile_headers": False}
"""Settings of the compiler. To compile headers beforehand takes longer than it saves for one program, and 300 MB on the disk."""


class CompiledProgramError(GpeError):
    """Raised when a compiled program moves nodes elsewhere than its model, or stresses them otherwise."""


def export_compiled(simulator: LearnedSimulator, path: Path | str, states: Sequence[State]) -> float:
    """Compile a simulator's step and write it as a package for LibTorch, which appears complete or not at all.

    Args:
        simulator: simulator whose step ``export_model`` can write.
        path: file that ends in ``.pt2``.
        states: states with velocity history from which the compiled program and the simulator make a step, at least one.

    Returns:
        The largest difference of a position after these steps [m].

    Raises:
        CompiledProgramError: the compiled program moves a node elsewhere or stresses it otherwise, by more than ``agreement.excess`` allows; nothing is
            written.
        ValueError: ``path`` has another file type, or there are no states.
        CellError, MirrorAverageError, LeastDistanceError, NodeLoadError, RigidBodyError, OpenSceneError: as ``export_model`` and ``scene_of`` raise them.
    """
    if Path(path).suffix != ".pt2":
        raise ValueError(f"{path}: a compiled program ends in .pt2")
    if not states:
        raise ValueError("states: give at least one, in which the compiled program is compared with the model")
    scenes = [scene_of(simulator, state) for state in states]
    with tempfile.TemporaryDirectory(prefix="gpe_") as folder, torch.no_grad():
        plain, compiled = Path(folder) / "plain.pt2", Path(folder) / "compiled.pt2"
        export_model(simulator, plain)
        inductor = torch._inductor
        inductor.aoti_compile_and_package(torch.export.load(plain), package_path=str(compiled), inductor_configs=INDUCTOR)
        step = inductor.aoti_load_package(str(compiled))
        positions, stresses = list[tuple[Tensor, Tensor]](), list[tuple[Tensor, Tensor]]()
        for state, scene in zip(states, scenes, strict=True):
            moved, predicted = step(scene)
            expected = _positions_and_stresses(simulator, state)
            positions += [(values, expected[name]) for name, values in moved.items() if name.startswith("pos.")]
            stresses += [(values, expected[name]) for name, values in predicted.items() if name.startswith("stress.")]
        position = largest_difference(positions)
        if wrong := excess(position, largest_difference(stresses), states, simulator.stress_std):
            raise CompiledProgramError(f"one step of the compiled program differs from that of the model {wrong}")
        replace_bytes(Path(path), compiled.read_bytes())
    return position


def _positions_and_stresses(simulator: LearnedSimulator, state: State) -> dict[str, Tensor]:
    """Return positions and stresses after a step of the simulator by the names that programs give them."""
    rows, new = simulator.builder.topology(state).rows, simulator.configured(skips=EVERYTHING).step(state)
    found = {f"pos.{material}": new.pos[r] for material, r in rows.items()}
    if new.stress is not None:
        found |= {f"stress.{material}": new.stress.node[r] for material, r in rows.items()}
    return found
