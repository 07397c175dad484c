"""Reader of input decks of Abaqus and CalculiX (``*.inp``): materials, held nodes, and forces and pressures as functions of time.

Only what a trajectory needs is read. Meshes and results come from the result file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gpe_pl.data.importers.pressures import CORNERS, FACES, corner_areas, kind_of
from gpe_pl.data.importers.source import Refusal

Amplitude = tuple[np.ndarray, np.ndarray]
"""Times [s] and factors of a load."""
Face = tuple[int, ...]
"""Numbers of the nodes of a face."""
Pull = tuple[set[int], np.ndarray]
"""Numbers of elements, and an acceleration [3] that gravity gives them."""
Card = tuple[str, dict[str, str], list[list[str]]]
"""Keyword, parameters in upper case, and data lines of a card."""

LOADS = ("PRESSURE", "DFLUX")
UNSEEN = {
    **dict.fromkeys(
        ("EQUATION", "MPC", "TIE", "COUPLING", "KINEMATIC", "DISTRIBUTING", "DISTRIBUTINGCOUPLING", "RIGIDBODY"), "couples nodes"
    ),
    **dict.fromkeys(("CYCLICSYMMETRYMODEL", "CONTACTPAIR", "CONTACT", "GAP", "PRE-TENSIONSECTION", "NETWORKMPC"), "couples nodes"),
    **dict.fromkeys(("SPRING", "DASHPOT", "MASS"), "adds forces or masses to nodes"),
    **dict.fromkeys(("INITIALCONDITIONS", "TEMPERATURE"), "moves or strains bodies without a force"),
    **dict.fromkeys(
        ("PLASTIC", "CYCLICHARDENING", "DEFORMATIONPLASTICITY", "CREEP", "USERMATERIAL", "DEPVAR"),
        "gives a material another law than the linear elastic one",
    ),
    "MODELCHANGE": "adds or removes elements or contacts",
}
"""Cards that change the motion by what a trajectory cannot hold, and how."""
READ_OF_LOADS, READ_OF_AMPLITUDES = {"AMPLITUDE", "OP"}, {"NAME", "TIME"}
"""Parameters of ``*CLOAD``, ``*DLOAD`` and ``*DSLOAD``, and of ``*AMPLITUDE``, that are read or change nothing. Others change when or where loads act."""
RESULTS = ("NODEFILE", "ELFILE", "ELEMENTFILE", "NODEOUTPUT", "ELEMENTOUTPUT", "CONTACTFILE")
"""Cards that say which results are written, and along which axes."""
PROCEDURES = (
    "STATIC",
    "FREQUENCY",
    "BUCKLE",
    "MODALDYNAMIC",
    "STEADYSTATEDYNAMICS",
    "VISCO",
    "HEATTRANSFER",
    "COUPLEDTEMPERATURE-DISPLACEMENT",
)
"""Cards of computations that are no dynamics."""
HOLDING = {"ENCASTRE": (1, 3), "PINNED": (1, 3), "XSYMM": (1, 1), "YSYMM": (2, 2), "ZSYMM": (3, 3)}
"""Named boundary conditions, as the first and last held axis."""


@dataclass
class Deck:
    """Contents of a deck.

    Attributes:
        density, elastic: density, and Young's modulus with Poisson's ratio, by the name of the material in upper case.
        held: held axes, 1 to 3, by the number of the node.
        forces: amplitude, or None for a constant load, and magnitudes by (node, axis), of each card.
        pressures: amplitude, or None, and pressures by face, of each card.
        gravity: acceleration [3]; None if there is no gravity.
        follows: whether pressures follow the deformation (``NLGEOM``).
        damped: whether a material has ``*DAMPING``.
    """

    density: dict[str, float] = field(default_factory=dict)
    elastic: dict[str, tuple[float, float]] = field(default_factory=dict)
    held: dict[int, set[int]] = field(default_factory=dict)
    forces: list[tuple[Amplitude | None, dict[tuple[int, int], float]]] = field(default_factory=list)
    pressures: list[tuple[Amplitude | None, list[tuple[Face, float]]]] = field(default_factory=list)
    gravity: np.ndarray | None = None
    follows: bool = False
    damped: bool = False

    def add_forces(self, amplitude: Amplitude | None, loaded: Iterable[tuple[tuple[int, int], float]]) -> None:
        """Add a card ``*CLOAD``. Forces on a node along an axis add up, within a card and over cards.

        Raises:
            ValueError: an earlier card gives a force there another amplitude, which CalculiX refuses.
        """
        values: dict[tuple[int, int], float] = {}
        for place, magnitude in loaded:
            values[place] = values.get(place, 0.0) + magnitude
        for other, earlier in self.forces:
            both = values.keys() & earlier.keys()
            if both and other is not amplitude:
                node, axis = min(both)
                raise ValueError(
                    f"node {node} has forces with different amplitudes along axis {axis}, which CalculiX refuses; give them one"
                )
        self.forces.append((amplitude, values))

    def force(self, node_ids: np.ndarray, times: np.ndarray, rest_pos: np.ndarray, pos: np.ndarray) -> np.ndarray | None:
        """Return the forces on nodes at times [frame, node, 3] in N; None if there are none.

        Args:
            node_ids: numbers of the nodes [node].
            times: times [frame] in s.
            rest_pos: undeformed positions [node, 3] in m.
            pos: positions at the times [frame, node, 3] in m. Pressures act on the faces there if they follow the deformation, otherwise on undeformed faces.

        Raises:
            Refusal: a node with a load is not in the results.
        """
        if not self.forces and not self.pressures:
            return None
        row = {int(node): k for k, node in enumerate(node_ids)}
        total = np.zeros((len(times), len(node_ids), 3))
        for amplitude, values in self.forces:
            factor = _factors(amplitude, times)
            for (node, axis), magnitude in values.items():
                if node not in row:
                    raise Refusal(f"node {node} has a force in the deck and is not in the results")
                total[:, row[node], axis - 1] += factor * magnitude
        shape = pos if self.follows else np.broadcast_to(rest_pos, pos.shape)
        for amplitude, loaded in self.pressures:
            for count in (3, 4):
                faces = [(face, pressure) for face, pressure in loaded if len(face) == count]
                if faces:
                    missing = next((node for face, _ in faces for node in face if node not in row), None)
                    if missing is not None:
                        raise Refusal(f"node {missing} has a pressure in the deck and is not in the results")
                    rows = np.array([[row[node] for node in face] for face, _ in faces])
                    pressure = _factors(amplitude, times)[:, None] * np.array([own for _, own in faces])
                    forces = pressure[..., None, None] * corner_areas(shape[:, rows])
                    for frame, own in zip(total, forces, strict=True):
                        np.add.at(frame, rows.ravel(), own.reshape(-1, 3))
        return total


def read(path: Path) -> Deck:
    """Read a deck.

    Raises:
        Refusal: the file is missing or no deck; it has several steps, no ``*DYNAMIC`` or elements other than solids, includes other files, has distributed
            loads besides gravity and pressures, has gravity that differs between elements or times, or has cards of ``UNSEEN``.
    """
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except FileNotFoundError:
        raise Refusal(f"{path.name} is missing beside the results") from None
    deck, sets, amplitudes, material = Deck(), dict[str, list[int]](), dict[str, Amplitude](), ""
    elements, num_steps, is_dynamic, pulls = _Elements(), 0, False, list[Pull]()
    for keyword, parameters, lines in _cards(text):
        squeezed = keyword.replace(" ", "")
        try:
            if keyword in ("NODE", "NSET") and "NSET" in parameters:
                sets.setdefault(parameters["NSET"], []).extend(_members(keyword == "NODE", parameters, lines, sets, "nodes"))
            elif keyword in ("ELEMENT", "ELSET", "SURFACE"):
                elements.add(keyword, parameters, lines)
            elif keyword == "AMPLITUDE":
                _check_parameters(parameters, READ_OF_AMPLITUDES)
                numbers = np.array([_number(x) for line in lines for x in line])
                amplitudes[parameters["NAME"]] = numbers[0::2], numbers[1::2]
            elif keyword == "MATERIAL":
                material = parameters["NAME"]
            elif keyword == "DENSITY":
                deck.density[material] = float(lines[0][0])
                if not deck.density[material] > 0:
                    raise ValueError("must be positive")
            elif keyword == "ELASTIC":
                deck.elastic[material] = _isotropic(parameters, lines)
            elif keyword == "BOUNDARY":
                if parameters.get("OP", "MOD") != "MOD":
                    raise ValueError(f"OP={parameters['OP']} releases nodes that were held before; hold only nodes that stay held")
                for node, axes in _held(lines, sets):
                    deck.held.setdefault(node, set()).update(axes)
            elif keyword == "CLOAD":
                _check_parameters(parameters, READ_OF_LOADS)
                deck.add_forces(_amplitude(parameters, amplitudes), _loaded(lines, sets))
            elif keyword in ("DLOAD", "DSLOAD"):
                _check_parameters(parameters, READ_OF_LOADS)
                loaded = list[tuple[Face, float]]()
                for place, label, *values in lines:
                    if label.upper() == "GRAV":
                        if "AMPLITUDE" in parameters:
                            raise ValueError("gravity with an amplitude; a trajectory has one gravity at all times")
                        pulls.append(({*_numbers(place, elements.sets, "elements")}, _gravity(values)))
                    else:
                        loaded += [(face, _number(values[0])) for face in elements.faces(keyword, place, label.upper())]
                if loaded:
                    deck.pressures.append((_amplitude(parameters, amplitudes), loaded))
            elif keyword in LOADS:
                raise Refusal(f"{path.name}: *{keyword} is not read; give forces as *CLOAD and pressures as *DLOAD or *DSLOAD")
            elif squeezed in UNSEEN:
                raise Refusal(f"{path.name}: *{keyword} {UNSEEN[squeezed]}, which a model would not see; compute the deck without it")
            elif squeezed in RESULTS and parameters.get("GLOBAL", "YES") == "NO":
                raise Refusal(f"{path.name}: *{keyword} with GLOBAL=NO writes results along local axes; leave GLOBAL out")
            elif keyword == "TRANSFORM":
                raise Refusal(f"{path.name}: *TRANSFORM; give held axes and forces along the global axes")
            elif keyword == "INCLUDE":
                raise Refusal(f"{path.name}: *INCLUDE; write the whole deck into one file")
            elif squeezed in PROCEDURES:
                raise Refusal(f"{path.name}: *{keyword} is no dynamics; compute with *DYNAMIC, DIRECT")
            elif keyword == "DYNAMIC":
                is_dynamic = True
            elif keyword == "DAMPING":
                deck.damped = True
            elif keyword == "STEP":
                if parameters.get("AMPLITUDE", "STEP") != "STEP":
                    raise ValueError("AMPLITUDE=RAMP; give loads an *AMPLITUDE of their own")
                num_steps += 1
                deck.follows = "NLGEOM" in parameters and parameters["NLGEOM"] != "NO"
        except (ValueError, IndexError, KeyError) as error:
            raise Refusal(f"{path.name}: *{keyword} cannot be read ({error})") from None
    if num_steps != 1:
        raise Refusal(f"{path.name}: has {num_steps} steps, must have one *STEP with *DYNAMIC")
    if not is_dynamic:
        raise Refusal(f"{path.name}: has no *DYNAMIC, so its times are none; compute with *DYNAMIC, DIRECT")
    try:
        deck.gravity = _everywhere(pulls, elements)
    except ValueError as error:
        raise Refusal(f"{path.name}: {error}") from None
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
            while parts and not parts[-1]:
                parts.pop()
            card[2].append(parts)
        continues = line.endswith(",") and (line.startswith("*") or continues)
    if card is not None:
        yield card


def _parameters(parts: list[str]) -> dict[str, str]:
    pairs = (part.partition("=") for part in parts if part)
    return {name.strip().upper(): value.strip().upper() for name, _, value in pairs}


@dataclass
class _Elements:
    """Elements of a deck.

    Attributes:
        kind: kind of each element of linear solids, a key of ``FACES``, by its number.
        nodes: numbers of its nodes.
        sets: numbers of elements by the names of sets.
        surfaces: faces by the names of surfaces.
    """

    kind: dict[int, str] = field(default_factory=dict)
    nodes: dict[int, list[int]] = field(default_factory=dict)
    sets: dict[str, list[int]] = field(default_factory=dict)
    surfaces: dict[str, list[Face]] = field(default_factory=dict)

    def add(self, keyword: str, parameters: dict[str, str], lines: list[list[str]]) -> None:
        """Add a card *ELEMENT, *ELSET or *SURFACE."""
        if keyword == "SURFACE":
            if parameters.get("TYPE", "ELEMENT") == "ELEMENT":
                own = self.surfaces.setdefault(parameters["NAME"], [])
                own.extend(face for place, label, *_ in lines for face in self._of_elements(place, label.upper().replace("S", "P", 1)))
        elif keyword == "ELSET":
            self.sets.setdefault(parameters["ELSET"], []).extend(_members(False, parameters, lines, self.sets, "elements"))
        elif not parameters["TYPE"].startswith("C3D"):
            raise ValueError(
                f"TYPE={parameters['TYPE']} is no solid; CalculiX gives shells and beams other nodes. Mesh with C3D8, C3D6 or C3D4"
            )
        elif (kind := kind_of(parameters["TYPE"])) is not None:
            width = 1 + CORNERS[kind]
            numbers = np.array([int(x) for line in lines for x in line]).reshape(-1, width)
            self.kind.update(dict.fromkeys(numbers[:, 0].tolist(), kind))
            self.nodes.update(zip(numbers[:, 0].tolist(), numbers[:, 1:].tolist(), strict=True))
            if "ELSET" in parameters:
                self.sets.setdefault(parameters["ELSET"], []).extend(numbers[:, 0].tolist())

    def faces(self, keyword: str, place: str, label: str) -> list[Face]:
        """Return the faces on which a line of *DLOAD or *DSLOAD acts.

        Raises:
            ValueError: the load is no pressure on known faces of linear solid elements.
        """
        if keyword == "DLOAD":
            return self._of_elements(place, label)
        if label != "P":
            raise ValueError(f"{label} is no pressure; give forces on nodes as *CLOAD")
        if place.upper() not in self.surfaces:
            raise ValueError(f"unknown surface of elements {place!r}")
        return self.surfaces[place.upper()]

    def _of_elements(self, place: str, label: str) -> list[Face]:
        if label[:1] != "P" or not label[1:].isdigit():
            raise ValueError(f"{label} is no pressure on a face P1 to P6; give forces on nodes as *CLOAD")
        found = list[Face]()
        for element in _numbers(place, self.sets, "elements"):
            corners = FACES[self.kind[element]] if element in self.kind else ()
            if not 1 <= int(label[1:]) <= len(corners):
                raise ValueError(f"element {element} has no face {label[1:]}" if corners else f"element {element} is no linear solid")
            found.append(tuple(self.nodes[element][k] for k in corners[int(label[1:]) - 1]))
        return found


def _members(is_table: bool, parameters: dict[str, str], lines: list[list[str]], sets: dict[str, list[int]], what: str) -> Iterator[int]:
    """Yield the numbers of a set, or those in the first column of a table."""
    for line in lines:
        if is_table:
            yield int(line[0])
        elif "GENERATE" in parameters:
            first, last, *step = map(int, line)
            yield from range(first, last + 1, step[0] if step else 1)
        else:
            for name in filter(None, line):
                yield from _numbers(name, sets, what)


def _numbers(name: str, sets: dict[str, list[int]], what: str) -> list[int]:
    """Return the members of a set, or a number itself."""
    if name.upper() in sets:
        return sets[name.upper()]
    if not name.isdigit():
        raise ValueError(f"unknown set of {what} {name!r}")
    return [int(name)]


def _isotropic(parameters: dict[str, str], lines: list[list[str]]) -> tuple[float, float]:
    """Return Young's modulus and Poisson's ratio of a card *ELASTIC.

    Raises:
        ValueError: the material is not isotropic, or its constants depend on the temperature.
    """
    if parameters.get("TYPE", "ISO") not in ("ISO", "ISOTROPIC"):
        raise ValueError(f"TYPE={parameters['TYPE']}; only isotropic materials are read")
    if len(lines) > 1:
        raise ValueError("constants that depend on the temperature; give those of one temperature")
    modulus, ratio, *_ = (float(value) for value in lines[0])
    return modulus, ratio


def _factors(amplitude: Amplitude | None, times: np.ndarray) -> np.ndarray:
    """Return the factors of a load at times [frame]."""
    return np.ones(len(times)) if amplitude is None else np.interp(times, *amplitude)


def _held(lines: list[list[str]], sets: dict[str, list[int]]) -> Iterator[tuple[int, range]]:
    for name, first, *rest in lines:
        low, high = HOLDING[first.upper()] if not first.isdigit() else (int(first), int(rest[0]) if rest and rest[0] else int(first))
        for node in _numbers(name, sets, "nodes"):
            yield node, range(low, min(high, 3) + 1)


def _amplitude(parameters: dict[str, str], amplitudes: dict[str, Amplitude]) -> Amplitude | None:
    name = parameters.get("AMPLITUDE")
    if name is not None and name not in amplitudes:
        raise ValueError(f"unknown amplitude {name!r}")
    return None if name is None else amplitudes[name]


def _loaded(lines: list[list[str]], sets: dict[str, list[int]]) -> Iterator[tuple[tuple[int, int], float]]:
    for name, axis, magnitude in lines:
        if axis not in ("1", "2", "3"):
            raise ValueError(f"{axis} is no axis of a force; forces act along 1, 2 or 3")
        for node in _numbers(name, sets, "nodes"):
            yield (node, int(axis)), _number(magnitude)


def _number(text: str) -> float:
    """Return a number; an empty field is 0."""
    return float(text or 0)


def _check_parameters(parameters: dict[str, str], read: set[str]) -> None:
    if others := sorted(parameters.keys() - read):
        raise ValueError(f"{others[0]} is not read")


def _gravity(values: list[str]) -> np.ndarray:
    """Return the acceleration [3] of a line of *DLOAD with GRAV. CalculiX normalises the direction."""
    strength, *way = (_number(x) for x in [*values, "", "", ""][:4])
    length = np.linalg.norm(way)
    if not length:
        raise ValueError("gravity has no direction")
    return strength * np.array(way) / length


def _everywhere(pulls: list[Pull], elements: _Elements) -> np.ndarray | None:
    """Return the sum of accelerations [3], which all elements must have; None if there are none.

    Raises:
        ValueError: elements have different accelerations.
    """
    if not pulls:
        return None
    if not elements.kind:  # the results have elements of their own
        return np.asarray(sum(pull for _, pull in pulls))
    each = np.array([sum((pull for own, pull in pulls if element in own), np.zeros(3)) for element in elements.kind])
    differs = (each != each[0]).any(axis=1)
    if differs.any():
        one, other = ([*elements.kind][k] for k in (0, int(differs.argmax())))
        raise ValueError(f"elements {one} and {other} have different gravity; a trajectory has one gravity for all")
    return np.asarray(each[0])
