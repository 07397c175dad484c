"""Importer of the bending beam of ThermodynamicsGNN: viscoelastic beams that are clamped at one end and bent by a growing force.

``source`` is a folder with files ``beam_{number}.pt`` from 1 on, written by ``torch.save``. A file is a list of graphs, one for each step. A graph has the
states ``x`` before and ``y`` after the step [node, 12], the forces ``f`` [node, 3] during the step, the mask ``n`` [node, 2] of free and of clamped nodes,
and ``edge_index`` [2, edge]. A state has position, velocity and the Cauchy stress xx, yy, zz, xy, xz, yz. Steps take 1/20 s.

What becomes of them:

- Nodes form a lattice, whose boxes along the edges become hexahedra.
- ``f`` become forces on nodes, and clamped nodes become nodes whose motion is given.
- A frame before the first has the positions from which the first velocities lead to the first frame. Otherwise a model, which learns from positions, would not
  know these velocities.
- The splits are those of the source with its published seed: a shuffled list of the files is cut at 80 % and 90 %.

Nothing of a file is run: ``torch.load`` reads tensors and attributes only. Masses and constants of the material are not in the files.

Source: Hernández, Badías, Chinesta, Cueto 2022, "Thermodynamics-informed graph neural networks", and the layout of the data of
github.com/quercushernandez/ThermodynamicsGNN.
"""

from __future__ import annotations

import pickle
import re
import zipfile
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpe_pl.data.importers.source import Facts, ImportFailure, ImportSettings, Item, Loaded, Nodes, Refusal, Source, build
from gpe_pl.files import regular_files
from gpe_pl.learned.checkpoint_archive import check_archive

FRAME_DT = 1 / 20
"""Time between frames [s]; it is not in the files."""
SPLIT_SEED, SPLIT_ENDS = 1, (0.8, 0.9)
"""Seed of the published split, and fractions of the shuffled files at which it is cut."""
STATE, DIM = 12, 3
COMPONENTS = [6, 9, 10, 7, 11, 8]
"""Columns of the stress in a state, in the order xx, xy, xz, yy, yz, zz."""
MATERIAL = "elastomer"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
"""Corners of a hexahedron in the order of VTK."""
LATTICE_TOLERANCE = 1e-4
"""Coordinates that differ by less than this fraction of the beam's longest side are the same."""
MOST_STEPS, MOST_NODES = 100_000, 10_000_000


class _Attributes:
    """Takes the attributes of a graph or of its storage, and nothing else."""

    def __setstate__(self, state: Any) -> None:
        vars(self).update(state if isinstance(state, dict) else {})


NAMES = ("data.Data", "data.DataEdgeAttr", "data.DataTensorAttr", "storage.GlobalStorage")
CLASSES: list[Any] = [(_Attributes, f"torch_geometric.data.{name}") for name in NAMES]
"""What stands for the classes that files name."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no files ``beam_1.pt``, ``beam_2.pt``, …, or some are missing between them, so that the published split is unknown.
    """
    found = (
        {int(file.stem[5:]): file for file in path.iterdir() if re.fullmatch(r"beam_[0-9]{1,6}\.pt", file.name)} if path.is_dir() else {}
    )
    files = [found[number] for number in sorted(found)]
    if not files:
        raise ImportFailure(f"{path}: {'holds no beam_1.pt, beam_2.pt, …' if path.is_dir() else 'no such folder'}")
    if gaps := sorted({*range(1, max(found) + 1)} - {*found}):
        missing = ", ".join(f"beam_{number}.pt" for number in gaps[:5]) + ", …" * (len(gaps) > 5)
        raise ImportFailure(f"{path}: lacks {missing}; the published split needs all files up to beam_{max(found)}.pt")
    notes = (
        "frame_dt = 1/20 s is the format's, not in the files",
        f"splits are those of the source, with its seed {SPLIT_SEED}",
        "a frame before the first follows from the first velocities",
        "masses are not in the files; 1 kg is stored for every node, so f/m are forces per node rather than accelerations",
    )
    facts = Facts(FRAME_DT, gravity=(0.0,) * DIM, notes=notes).overridden(settings)
    return Source(facts, {split: [Item(file.name, partial(_load, file)) for file in own] for split, own in published_split(files).items()})


def published_split(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return the files of each split, in the order of the published code."""
    order = list(range(len(files)))
    np.random.RandomState(SPLIT_SEED).shuffle(order)
    first, second = (int(fraction * len(files)) for fraction in SPLIT_ENDS)
    numbers = {"train": order[:first] or order, "val": order[first:second], "test": order[second:] if first else []}
    return {split: [files[number] for number in own] for split, own in numbers.items() if own}


def graphs_in(path: Path) -> list[dict[str, Any]]:
    """Return the tensors of each graph in a file.

    Raises:
        Refusal: the file is not a list of graphs, or is damaged.
    """
    try:
        regular_files.check(path)
        check_archive(path, check=lambda _: None)  # PyTorch refuses everything that is not in CLASSES
        with torch.serialization.safe_globals(CLASSES):
            values = torch.load(path, map_location="cpu", weights_only=True)
        graphs = [vars(vars(graph)["_store"])["_mapping"] for graph in values[: MOST_STEPS + 1]]
    except (OSError, EOFError, ValueError, KeyError, TypeError, IndexError, AttributeError, RuntimeError, MemoryError) as error:
        raise Refusal(f"is not a list of graphs ({_first_line(error)})") from None
    except (zipfile.BadZipFile, pickle.UnpicklingError) as error:
        named = re.search(r"GLOBAL (\S+)", str(error))
        raise Refusal(f"has more than tensors ({named[1][:100] if named else _first_line(error)}), or is damaged") from None
    if not graphs or len(graphs) > MOST_STEPS or not all(isinstance(graph, dict) for graph in graphs):
        raise Refusal(f"has {len(graphs)} graphs, expected 1 to {MOST_STEPS} with tensors")
    return graphs


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0][:200]


def _load(path: Path, facts: Facts) -> Loaded:
    graphs = graphs_in(path)
    count = graphs[0]["x"].shape[0] if isinstance(graphs[0].get("x"), torch.Tensor) and graphs[0]["x"].ndim == 2 else 0
    if not 0 < count <= MOST_NODES:
        raise Refusal(f"has no x [node, {STATE}] of at most {MOST_NODES} nodes", 0)
    shapes: dict[str, tuple[int | None, ...]] = {
        "x": (count, STATE),
        "y": (count, STATE),
        "f": (count, DIM),
        "n": (count, 2),
        "edge_index": (2, None),
    }
    steps = [{name: _array(graph, name, shape, k) for name, shape in shapes.items()} for k, graph in enumerate(graphs)]
    for k, (before, after) in enumerate(pairwise(steps)):
        if not np.array_equal(before["y"], after["x"]):
            raise Refusal("does not begin where the step before ended", k + 1)
    states = np.stack([steps[0]["x"], *(step["y"] for step in steps)]).astype(np.float64)
    pos, vel, stress = states[..., :DIM], states[..., DIM : 2 * DIM], states[..., COMPONENTS]
    assert facts.frame_dt is not None
    force = np.stack([0.0 * steps[0]["f"], *(step["f"] for step in steps), steps[-1]["f"]])
    return build(
        Nodes(
            np.concatenate([pos[:1] - facts.frame_dt * vel[:1], pos]),
            np.full(count, MATERIAL, "U16"),
            vel=np.concatenate([vel[:1], vel]),
            cells={"hexahedron": _hexahedra(pos[0], steps[0]["edge_index"])},
            rest_pos=pos[0],
            prescribed=steps[0]["n"][:, 1] == 1,
            force=force,
            stress=np.concatenate([stress[:1], stress]),
        ),
        facts,
    )


def _array(graph: Mapping[str, Any], name: str, shape: tuple[int | None, ...], step: int) -> np.ndarray:
    """Return a tensor of a graph as an array of the given shape, in which None stands for any length."""
    tensor = graph.get(name)
    if not isinstance(tensor, torch.Tensor) or tensor.layout != torch.strided or tensor.ndim != len(shape):
        raise Refusal(f"has no tensor {name} {list(shape)}", step)
    if any(known not in (None, own) for own, known in zip(tensor.shape, shape, strict=True)):
        raise Refusal(f"{name} is {list(tensor.shape)}, expected {list(shape)}", step)
    if tensor.untyped_storage().nbytes() < tensor.numel() * tensor.element_size():
        raise Refusal(f"{name} has fewer values than its shape says", step)
    if tensor.dtype not in ((torch.int64,) if name == "edge_index" else (torch.float32, torch.float64)):
        raise Refusal(f"{name} is {tensor.dtype}", step)
    return tensor.numpy()


def _hexahedra(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the boxes [cell, 8] of a lattice of nodes [node, 3] whose sides are among the edges [2, edge]."""
    tolerance = LATTICE_TOLERANCE * np.ptp(pos, axis=0).max()
    levels = [_levels(axis, tolerance) for axis in pos.T]
    shape = [int(level.max()) + 1 for level in levels]
    if np.prod(shape, dtype=np.float64) > 2 * len(pos):
        raise Refusal("its nodes do not form a lattice along the axes", 0)
    at = np.full(shape, -1)
    at[tuple(levels)] = np.arange(len(pos))
    origin = np.argwhere(np.ones([size - 1 for size in shape], bool))
    corners = origin[:, None] + CORNERS
    cells = at[tuple(corners[..., axis] for axis in range(DIM))]
    if edges.size and not 0 <= edges.min() <= edges.max() < len(pos):
        raise Refusal(f"edge_index names a node that is not among the {len(pos)} nodes", 0)
    known = np.unique(np.concatenate([edges[0] * len(pos) + edges[1], edges[1] * len(pos) + edges[0]]))
    sides = [(a, b) for a in range(8) for b in range(a) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
    whole = (cells >= 0).all(axis=1)
    for a, b in sides:
        whole &= np.isin(cells[:, a] * len(pos) + cells[:, b], known)
    if not whole.any():
        raise Refusal("its edges enclose no hexahedron along the axes", 0)
    return cells[whole]


def _levels(values: np.ndarray, tolerance: float) -> np.ndarray:
    """Return for each coordinate [node] its rank among the coordinates that differ by more than the tolerance."""
    order = np.argsort(values, kind="stable")
    rank = np.concatenate([[0], np.cumsum(np.diff(values[order]) > tolerance)])
    levels = np.empty(len(values), dtype=np.int64)
    levels[order] = rank
    return levels
