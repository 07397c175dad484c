"""Reader of the result files of CalculiX (``*.frd``), in their text format.

A file has blocks: ``2C`` nodes, ``3C`` elements, and one ``100C`` block per time and result. Lines of a block have fixed columns and begin with -1; -2 begins
lines that continue them, and -3 ends the block. The manual of CalculiX GraphiX describes the format.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.data.importers.source import Refusal

KINDS = {1: "hexahedron", 2: "wedge", 3: "tetrahedron", 7: "triangle", 9: "quadrilateral", 11: "line"}
"""Kinds of cells by their number in the file. The others are quadratic."""
VALUE = 12
"""Width of a number with decimals."""
ID_WIDTH = {"0": 5, "1": 10}
"""Width of node and element numbers by the digit at the end of a block's first line. Others are binary formats."""


@dataclass
class Results:
    """Mesh and results of a computation.

    Attributes:
        node_ids: numbers of the nodes in the file [node].
        rest_pos: their positions before the computation [node, 3], in the unit of length of the file.
        cells: nodes of each cell by kind [cell, corner], as rows of ``rest_pos``.
        material: number of the material of each cell by kind [cell].
        material_names: names of the materials by their numbers.
        times: times of the results [frame].
        fields: results by name, such as ``DISP`` and ``STRESS``, each [frame, node, component].
        partial: number of a node without values, by the names of results that do not have all nodes. Their values are 0 there.
    """

    node_ids: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    rest_pos: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    cells: dict[str, np.ndarray] = field(default_factory=dict)
    material: dict[str, np.ndarray] = field(default_factory=dict)
    material_names: dict[int, str] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)
    fields: dict[str, list[np.ndarray]] = field(default_factory=dict)
    partial: dict[str, int] = field(default_factory=dict)


def read(path: Path) -> Results:
    """Read a file.

    Raises:
        Refusal: the file is missing, binary, damaged or has quadratic elements.
    """
    try:
        lines = iter(path.read_bytes().decode("ascii").splitlines())
    except FileNotFoundError:
        raise Refusal(f"{path.name} is missing; run CalculiX: ccx -i {path.stem}") from None
    except UnicodeDecodeError:
        raise Refusal(f"{path.name} is binary; let CalculiX write text with *NODE FILE and *EL FILE") from None
    found = Results()
    try:
        for line in lines:
            if line[:9].strip() == "1UMAT":
                found.material_names[int(line[9:14])] = line[14:].strip()
            elif line[:6].strip() == "2C":
                _add_nodes(found, _block(lines), _id_width(line))
            elif line[:6].strip() == "3C":
                _add_cells(found, _block(lines), _id_width(line))
            elif line[:6].strip() == "100C":
                _add_result(found, float(line[12:24]), lines, _id_width(line))
    except (ValueError, IndexError, StopIteration, KeyError) as error:
        raise Refusal(f"{path.name} is damaged or of another format ({error})") from None
    if not len(found.node_ids) or not found.cells:
        raise Refusal(f"{path.name} has no {'nodes' if not len(found.node_ids) else 'elements'}")
    return found


def _id_width(line: str) -> int:
    digit = line.split()[-1]
    if digit not in ID_WIDTH:
        raise ValueError("binary values; let CalculiX write text")
    return ID_WIDTH[digit]


def _block(lines: Iterator[str]) -> list[str]:
    """Return the lines up to the end of a block."""
    found = list[str]()
    for line in lines:
        if line[:3] == " -3":
            return found
        found.append(line)
    raise ValueError("it ends within a block")


def _table(lines: list[str], start: int, count: int) -> np.ndarray:
    """Return numbers [line, count] of the widths ``VALUE`` from a column on."""
    return np.array([[float(line[start + k * VALUE : start + (k + 1) * VALUE]) for k in range(count)] for line in lines])


def _ids(lines: list[str], width: int) -> np.ndarray:
    return np.array([int(line[3 : 3 + width]) for line in lines], int)


def _add_nodes(found: Results, lines: list[str], width: int) -> None:
    found.node_ids, found.rest_pos = _ids(lines, width), _table(lines, 3 + width, 3)


def _add_cells(found: Results, lines: list[str], width: int) -> None:
    row = {int(node): k for k, node in enumerate(found.node_ids)}
    cells: dict[str, list[list[int]]] = {}
    material: dict[str, list[int]] = {}
    kind = ""
    for line in lines:
        if line[:3] == " -1":
            number, code = line[3 : 3 + width], int(line[3 + width : 8 + width])
            if code not in KINDS:
                raise Refusal(
                    f"element {number.strip()} is quadratic or of an unknown type ({code}); mesh with linear elements, such as C3D8 or C3D4"
                )
            kind = KINDS[code]
            material.setdefault(kind, []).append(int(line[13 + width : 18 + width]))
        else:
            nodes = [int(line[k : k + width]) for k in range(3, len(line.rstrip()), width)]
            cells.setdefault(kind, []).append([row[node] for node in nodes])
    found.cells = {kind: np.array(rows) for kind, rows in cells.items()}
    if "wedge" in cells:  # VTK numbers the triangles of wedges the other way round
        found.cells["wedge"] = found.cells["wedge"][:, [0, 2, 1, 3, 5, 4]]
    found.material = {kind: np.array(numbers) for kind, numbers in material.items()}


def _add_result(found: Results, time: float, lines: Iterator[str], width: int) -> None:
    block = _block(lines)
    (head, *_), values = [line for line in block if line[:3] == " -4"], [line for line in block if line[:3] == " -1"]
    named = [line for line in block if line[:3] == " -5"]
    count = min(6, sum(line.split()[1] != "ALL" for line in named))  # ALL is computed from the others
    if not found.times or time > found.times[-1]:
        found.times.append(time)
    row = {int(node): k for k, node in enumerate(found.node_ids)}
    result, there = np.zeros((len(found.node_ids), count)), np.zeros(len(found.node_ids), bool)
    rows = [row[node] for node in _ids(values, width)]
    result[rows], there[rows] = _table(values, 3 + width, count), True
    name = head.split()[1]
    found.fields.setdefault(name, []).append(result)
    if not there.all():
        found.partial.setdefault(name, int(found.node_ids[there.argmin()]))
