"""Reader of input decks of Abaqus and CalculiX (``*.inp``): materials, held nodes, and forces on nodes as functions of time.

Only what a trajectory needs is read. Meshes and results come from the result file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.data.importers.source import Refusal

Card = tuple[str, dict[str, str], list[list[str]]]
"""Keyword, parameters in upper case, and data lines of a card."""

LOADS = ("DLOAD", "DSLOAD", "PRESSURE", "DFLUX")
HOLDING = {"ENCASTRE": (1, 3), "PINNED": (1, 3)}
"""Named boundary conditions, as the first and last held axis."""


@dataclass
class Deck:
    """Contents of a deck.

    Attributes:
        density, elastic: density, and Young's modulus with Poisson's ratio, by the name of the material in upper case.
        held: held axes, 1 to 3, by the number of the node.
        forces: amplitude ([time], [factor]) or None for a constant load, and magnitudes by (node, axis), of each card.
        gravity: acceleration [3]; None if there is no gravity.
    """

    density: dict[str, float] = field(default_factory=dict)
    elastic: dict[str, tuple[float, float]] = field(default_factory=dict)
    held: dict[int, set[int]] = field(default_factory=dict)
    forces: list[tuple[tuple[np.ndarray, np.ndarray] | None, dict[tuple[int, int], float]]] = field(default_factory=list)
    gravity: np.ndarray | None = None

    def force(self, node_ids: np.ndarray, times: np.ndarray) -> np.ndarray | None:
        """Return the forces on nodes at times [frame, node, 3]; None if there are none."""
        if not self.forces:
            return None
        row = {int(node): k for k, node in enumerate(node_ids)}
        total = np.zeros((len(times), len(node_ids), 3))
        for amplitude, values in self.forces:
            factor = np.ones(len(times)) if amplitude is None else np.interp(times, *amplitude)
            for (node, axis), magnitude in values.items():
                if node in row:
                    total[:, row[node], axis - 1] += factor * magnitude
        return total


def read(path: Path) -> Deck:
    """Read a deck.

    Raises:
        Refusal: the file is missing or no deck; it has several steps, includes other files, or has pressures or other distributed loads besides gravity.
    """
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except FileNotFoundError:
        raise Refusal(f"{path.name} is missing beside the results") from None
    deck, sets, amplitudes, material = Deck(), dict[str, list[int]](), dict[str, tuple[np.ndarray, np.ndarray]](), ""
    num_steps = 0
    for keyword, parameters, lines in _cards(text):
        try:
            if keyword in ("NODE", "NSET") and "NSET" in parameters:
                sets.setdefault(parameters["NSET"], []).extend(_members(keyword, parameters, lines, sets))
            elif keyword == "AMPLITUDE":
                numbers = np.array([float(x) for line in lines for x in line])
                amplitudes[parameters["NAME"]] = numbers[0::2], numbers[1::2]
            elif keyword == "MATERIAL":
                material = parameters["NAME"]
            elif keyword == "DENSITY":
                deck.density[material] = float(lines[0][0])
            elif keyword == "ELASTIC":
                deck.elastic[material] = float(lines[0][0]), float(lines[0][1])
            elif keyword == "BOUNDARY":
                for node, axes in _held(lines, sets):
                    deck.held.setdefault(node, set()).update(axes)
            elif keyword == "CLOAD":
                deck.forces.append((_amplitude(parameters, amplitudes), dict(_loaded(lines, sets))))
            elif keyword == "DLOAD" and all(line[1].upper() == "GRAV" for line in lines):
                strength, *way = (float(x) for x in lines[0][2:6])
                deck.gravity = strength * np.array(way)
            elif keyword in LOADS:
                raise Refusal(f"{path.name}: *{keyword} is a distributed load; give forces on nodes as *CLOAD")
            elif keyword == "INCLUDE":
                raise Refusal(f"{path.name}: *INCLUDE; write the whole deck into one file")
            elif keyword == "STEP":
                num_steps += 1
        except (ValueError, IndexError, KeyError) as error:
            raise Refusal(f"{path.name}: *{keyword} cannot be read ({error})") from None
    if num_steps != 1:
        raise Refusal(f"{path.name}: has {num_steps} steps, must have one *STEP with *DYNAMIC")
    return deck


def _cards(text: str) -> Iterator[Card]:
    """Yield the cards of a deck."""
    card: Card | None = None
    continues = False
    for line in (line.strip() for line in text.splitlines()):
        if not line or line.startswith("**"):
            continue
        parts = [part.strip() for part in line.split(",")]
        if line.startswith("*"):
            if card is not None:
                yield card
            card = parts[0][1:].upper(), _parameters(parts[1:]), []
        elif card is not None and continues:
            card[1].update(_parameters(parts))
        elif card is not None:
            card[2].append([part for part in parts if part])
        continues = line.endswith(",") and (line.startswith("*") or continues)
    if card is not None:
        yield card


def _parameters(parts: list[str]) -> dict[str, str]:
    pairs = (part.partition("=") for part in parts if part)
    return {name.strip().upper(): value.strip().upper() for name, _, value in pairs}


def _members(keyword: str, parameters: dict[str, str], lines: list[list[str]], sets: dict[str, list[int]]) -> Iterator[int]:
    for line in lines:
        if keyword == "NODE":
            yield int(line[0])
        elif "GENERATE" in parameters:
            first, last, *step = map(int, line)
            yield from range(first, last + 1, step[0] if step else 1)
        else:
            for name in line:
                yield from _nodes(name, sets)


def _nodes(name: str, sets: dict[str, list[int]]) -> list[int]:
    """Return the nodes of a set, or the node with a number."""
    if name.upper() in sets:
        return sets[name.upper()]
    if not name.isdigit():
        raise ValueError(f"unknown set of nodes {name!r}")
    return [int(name)]


def _held(lines: list[list[str]], sets: dict[str, list[int]]) -> Iterator[tuple[int, range]]:
    for name, first, *rest in lines:
        low, high = HOLDING[first.upper()] if not first.isdigit() else (int(first), int(rest[0]) if rest else int(first))
        for node in _nodes(name, sets):
            yield node, range(low, min(high, 3) + 1)


def _amplitude(parameters: dict[str, str], amplitudes: dict[str, tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray] | None:
    return amplitudes[parameters["AMPLITUDE"]] if "AMPLITUDE" in parameters else None


def _loaded(lines: list[list[str]], sets: dict[str, list[int]]) -> Iterator[tuple[tuple[int, int], float]]:
    for name, axis, magnitude in lines:
        for node in _nodes(name, sets):
            yield (node, int(axis)), float(magnitude)
