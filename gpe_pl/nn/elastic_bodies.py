"""Elastic bodies of a graph: their cells and the walls beside them move the nodes through the whole frame (see ``nn.elastic_motion``).

The network learns the constants of the cells as functions of the material parameters, a factor of the friction, the distance at which walls stop nodes, and the
elastic layers in front of walls and between bodies. What it predicts besides acts as a constant acceleration.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.errors import GpeError
from gpe_pl.nn.elastic_bodies_kernels import move_bodies
from gpe_pl.nn.elastic_motion import (
    LOGARITHM_SCALE,
    MAX_SUBSTEPS,
    SOFTER,
    STABLE,
    Cells,
    Constants,
    Corners,
    Walls,
    cauchy_stress,
    elastic_motion,
)
from gpe_pl.nn.elastic_touch import APPROACH, SHARE, BodyLayer, Touching
from gpe_pl.system.compiled import is_wanted

MAX_CACHED = 64
"""Largest number of graphs whose cells at rest are kept in memory; 400 triangles take about 40 kB."""
FIRST_STIFFNESS, FIRST_MOST_FRICTION = 0.5, 0.7
"""Stiffness and largest friction of the layer of walls before training."""
WALL_DAMPING = 0.6
"""Damping of the layer of walls at the wall, as a fraction of the critical one. Elastomers that fall level bounce with it as in the material point method."""
THINNEST = 0.01
"""Least thickness of the layer of walls, in rest spacings."""
ENTRIES = ("body_pos", "rest_pos", "velocity", "wall", "relief", "rest_gap", "cell_index", "attached_index", "corner_index", "corner")
"""Entries of a material's store that the law reads."""


class CellError(GpeError, ValueError):
    """Raised when bodies should be elastic but the graphs do not contain their cells, or cells that the law is not for."""


class Moved(NamedTuple):
    """Motion of all materials over a frame.

    Attributes:
        acceleration: accelerations without gravity, in the unit of accelerations, per material [node, dim].
        frame_velocity: velocities at the end of the frame [m/frame], of materials with cells [node, dim].
        stress: Cauchy stress at the end of the frame, in the unit of stresses, of materials with cells [node, component]; empty if not wanted.
    """

    acceleration: dict[str, Tensor]
    frame_velocity: dict[str, Tensor]
    stress: dict[str, Tensor]


class WallLayer(nn.Module):
    """Elastic layer of walls, of the material of the body that it touches: thickness, stiffness and largest friction are learned.

    The material point method has such a layer. Its particles feel a wall as soon as they share a cell of the grid with it, and deform on their way to it. The
    layer slips: bodies slide even on walls to which they should stick. So a friction μ acts as ``μ / (1 + μ/M)``, with the largest friction M. The layer is
    thinner where a solid is sharp or thin, by the relief of the solid, because the grid hardly sees it there (see ``geometry.relief``). The material point
    method does not push an undeformed body that lies at a wall, so the layer of a node is never thicker than its distance from walls in the undeformed shape.

    The damping is given. From single steps a model learns so much of it that bodies bounce too low, since the solver remembers a contact that the state does
    not show, such as how near to the wall a body was.

    Args:
        thickness: thickness before training, in rest spacings; 0 stands for no layer, which is not learned.
        damping: damping at the wall as a fraction of the critical one.
    """

    def __init__(self, thickness: float, damping: float = WALL_DAMPING) -> None:
        super().__init__()
        self.has_thickness, self.damping = thickness > 0, damping
        if self.has_thickness:
            self.log_thickness = nn.Parameter(torch.tensor(float(thickness)).log())
            self.log_stiffness = nn.Parameter(torch.tensor(FIRST_STIFFNESS).log())
            self.log_most_friction = nn.Parameter(torch.tensor(FIRST_MOST_FRICTION).log())

    def slipping(self, friction: Float[Tensor, " contact"]) -> Float[Tensor, " contact"]:
        """Return the friction coefficients that act, of nodes or corners."""
        return friction / (1.0 + friction * (-self.log_most_friction).exp().to(friction)) if self.has_thickness else friction

    def of_nodes(
        self,
        relief: Float[Tensor, " node"],
        rest_gap: Float[Tensor, " node"],
        modulus: Float[Tensor, " node"],
        mass: Float[Tensor, " node"],
        spacing: Tensor,
    ) -> Float[Tensor, "node 3"] | None:
        """Return the layer of each node as ``elastic_motion.Walls`` has it; None without a layer.

        Args:
            relief: relief of the nearest solid [m].
            rest_gap: distance of the undeformed node from walls [m].
            modulus: λ + 2μ in units of mean mass × spacing^(2 - dim) per frame².
            mass: masses in units of their mean.
            spacing: rest spacing [m].
        """
        if not self.has_thickness:
            return None
        thickness, stiffness = (x.exp().to(modulus) for x in (self.log_thickness, self.log_stiffness))
        per_mass = stiffness * modulus / (thickness * mass)
        depth = torch.minimum(thickness * spacing - relief, rest_gap).clamp(min=THINNEST * spacing).to(per_mass)
        return torch.stack([depth, per_mass, 2.0 * self.damping * per_mass.sqrt()], dim=1)


class ElasticBodies(nn.Module):
    """Moves the nodes of bodies by their cells.

    Graphs need ``GraphConfig.cells``. Join them with ``graphs.batching.batched``, which renumbers cells.

    Args:
        param_channels: number of parameters per material with cells; 0 leaves the parameters out.
        dim: dimension of space.
        wall_distance: distance at which walls stop nodes before training, in rest spacings.
        wall_layer: thickness of the elastic layer of walls before training, in rest spacings; 0 stands for no layer.
        wall_damping: its damping at the wall, a fraction of the critical one.
        viscous: cells have a viscous stress, whose constant is learned; otherwise it is negligible.
        body_layer: thickness of the layer between bodies before training, in rest spacings; 0 stands for no layer.
    """

    acceleration_unit: Tensor
    spacing: Tensor
    stress_unit: Tensor

    def __init__(
        self,
        param_channels: dict[str, int],
        dim: int,
        wall_distance: float = 0.0,
        wall_layer: float = 0.0,
        wall_damping: float = WALL_DAMPING,
        viscous: bool = True,
        body_layer: float = 0.0,
    ) -> None:
        super().__init__()
        self.dim = dim
        self.constants = nn.ModuleDict({m: Constants(count, viscous) for m, count in param_channels.items()})
        self.log_friction = nn.ParameterDict({m: torch.zeros(()) for m in param_channels})
        self.wall_distance = nn.ParameterDict({m: torch.tensor(float(wall_distance)) for m in param_channels})
        self.wall_layer = nn.ModuleDict({m: WallLayer(wall_layer, wall_damping) for m in param_channels})
        self.body_layer = nn.ModuleDict({m: BodyLayer(body_layer, count, LOGARITHM_SCALE) for m, count in param_channels.items()})
        self.register_buffer("acceleration_unit", torch.ones((), dtype=torch.float64))
        self.register_buffer("spacing", torch.ones((), dtype=torch.float64))
        self.register_buffer("stress_unit", torch.ones((), dtype=torch.float64))

    def set_units(self, acceleration: float, spacing: float, stress: float) -> None:
        """Set the units of a data set.

        Args:
            acceleration: unit of accelerations [m/frame²].
            spacing: rest spacing of nodes [m].
            stress: unit of stresses, in mean masses per m^(dim − 2) and frame².
        """
        self.acceleration_unit.fill_(acceleration)
        self.spacing.fill_(spacing)
        self.stress_unit.fill_(stress)

    def laws(self, material: str) -> dict[str, nn.ParameterDict]:
        """Return the weights and biases of a material that give logarithms of constants from its standardised parameters, by name."""
        laws = {f"constants.{material}.logarithm": cast(Constants, self.constants[material]).logarithm}
        layer = cast(BodyLayer, self.body_layer[material])
        return laws | ({f"body_layer.{material}.logarithm": layer.logarithm} if layer.has_thickness else {})

    @torch.no_grad()
    def convert_units(self, material: str, stress: float, time: float, shift: Tensor, scale: Tensor) -> None:
        """Rewrite the laws of a material so that they mean the same in other units and of parameters with other statistics; see ``Model.convert_units``."""
        cast(Constants, self.constants[material]).convert_units(stress, time)
        for law in self.laws(material).values():
            if law["weight"].shape[1]:
                law["bias"].add_((law["weight"].double() @ shift.double()).to(law["bias"]))
                law["weight"].mul_(scale)

    def forward(
        self, data: HeteroData, acceleration: dict[str, Tensor], params: dict[str, Tensor], mass: dict[str, Tensor], with_stress: bool
    ) -> Moved:
        """Return how nodes move over the frame.

        Args:
            data: graph.
            acceleration: accelerations without gravity by all but cells and walls, per material [node, dim], in the unit of accelerations.
            params: standardised material parameters [node, param].
            mass: masses in units of their mean [node].
            with_stress: also compute the stress at the end of the frame.

        Raises:
            CellError: PyTorch Geometric joined the graphs, or scenes of one material have different kinds of cells.
        """
        moved = Moved({**acceleration}, {}, {})
        for m in self.constants:
            if m in acceleration:  # also without cells, so that a scene moves alike alone and in a batch
                own = self._moved(m, data, acceleration[m], params.get(m), mass[m], with_stress)
                for values, value in zip(moved, own, strict=True):
                    if value is not None:
                        values[m] = value
        return moved

    def _moved(
        self, m: str, data: HeteroData, acceleration: Tensor, params: Tensor | None, mass: Tensor, with_stress: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        if "ptr" in data[m]:
            raise CellError("PyTorch Geometric's Batch does not renumber cells; join graphs with gpe_pl.graphs.batching.batched")
        if is_wanted() and not torch.is_grad_enabled() and not torch.compiler.is_compiling():
            return self._moved_at_once(m, data, acceleration, params, mass, with_stress)
        weight = cast(Constants, self.constants[m]).logarithm["weight"]  # can have another precision than the graph
        own = weight.new_empty(len(mass), 0) if params is None else params.to(weight.dtype)
        constants = cast(Constants, self.constants[m])(own)
        # an H200 needs 0.1 to 0.4 s to start the operations of all substeps one by one; the compiled pass on the host takes 1 ms with both copies
        device = torch.device("cpu") if is_wanted() else mass.device
        store = {key: data[m][key].to(device) for key in ENTRIES}
        held = data[m].prescribed.to(device) if "prescribed" in data[m] else None
        scene = data[m].batch.to(device) if "batch" in data[m] else None
        unit, spacing, friction_factor, forcing = (
            x.to(device) for x in (self.acceleration_unit, self.spacing, self.log_friction[m].exp(), acceleration * self.acceleration_unit)
        )
        body_pos, (mean, velocity) = store["body_pos"], store["velocity"].double().split(self.dim, dim=1)
        gravity = data.gravity.to(device).double()
        gravity = gravity if scene is None else gravity[scene]
        cells = cells_at_rest(m, _with_attached(store, scene), store["rest_pos"], mass.to(device), scene)
        # masses are in units of their mean, and the rest volume of a node is about spacing^dim
        modulus = spacing ** (2 - self.dim)
        of_node = [value.to(device) for value in constants]
        lam, mu, eta = ((value * modulus)[cells.nodes].mean(dim=1) for value in of_node)
        walls = self._walls(m, store, of_node[0] + 2.0 * of_node[1], mass.to(device))
        ends, corner = store["corner_index"], store["corner"]
        at_corner = cast(WallLayer, self.wall_layer[m]).slipping(corner[:, self.dim] * friction_factor).detach()
        corners = Corners(ends, body_pos.double()[ends[:, 0]] + corner[:, : self.dim], at_corner)
        touching = self._touching(m, data, own.to(device), (of_node[0], of_node[1]))
        way, at_end, law = elastic_motion(
            body_pos, velocity, forcing + gravity, mass.to(device), (lam, mu, eta), cells, walls, corners, held, touching
        )
        stress = None
        if with_stress:
            stress = (cauchy_stress(body_pos + way, law, cells) / self.stress_unit.to(device)).to(acceleration)
        return ((way - mean - gravity) / unit).to(acceleration), at_end.to(mass.device), stress

    def _walls(self, m: str, store: dict[str, Tensor], modulus: Tensor, mass: Tensor) -> Walls:
        """Return the walls of the nodes of a material, on the device of its entries."""
        layer, spacing = cast(WallLayer, self.wall_layer[m]), self.spacing.to(mass.device)
        normal, gap, friction = store["wall"].split([self.dim, 1, 1], dim=1)
        stop = self.wall_distance[m].to(mass.device) * spacing
        of_layer = layer.of_nodes(store["relief"], store["rest_gap"] - stop, modulus, mass, spacing)
        gap = gap[:, 0] - stop
        return Walls(normal, gap, layer.slipping(friction[:, 0] * self.log_friction[m].exp().to(mass.device)), of_layer)

    def _touching(self, m: str, data: HeteroData, params: Tensor, lame: tuple[Tensor, Tensor]) -> Touching:
        """Return the pairs of nodes of different bodies, on the device of the constants λ and μ of the nodes."""
        layer, store = cast(BodyLayer, self.body_layer[m]), data[m]
        if not layer.has_thickness or not len(store.touch_index):
            return Touching.nothing(params.new_empty(0, self.dim, dtype=torch.float64))
        lam, mu = lame
        nodes, spacing = store.touch_index.to(lam.device), self.spacing.to(lam.device)
        return Touching(nodes, store.touch.to(lam.device).double(), layer.law_of(nodes, params, lam + 2.0 * mu, spacing))

    def _moved_at_once(
        self, m: str, data: HeteroData, acceleration: Tensor, params: Tensor | None, mass: Tensor, with_stress: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return the results of ``_moved`` by one compiled call on the host."""
        store = data[m]
        host = {key: store[key].cpu() for key in ENTRIES}
        mass_on_host, scene = mass.cpu(), store.batch.cpu() if "batch" in store else None
        cells = cells_at_rest(m, _with_attached(host, scene), host["rest_pos"], mass_on_host, scene)
        moved, at_end = np.empty(acceleration.shape, _array(acceleration).dtype), np.empty(acceleration.shape)
        components = 4 if self.dim == 2 else 6
        stress = np.empty((len(mass) if with_stress else 0, components), moved.dtype)
        weight = cast(Constants, self.constants[m]).logarithm["weight"]
        own = weight.new_empty(len(mass), 0) if params is None else params.to(weight.dtype)
        lam, mu, eta = (value.cpu() for value in cast(Constants, self.constants[m])(own))
        touching = self._touching(m, data, own.cpu(), (lam, mu))
        walls = self._walls(m, host, lam + 2.0 * mu, mass_on_host)
        at_corner = cast(WallLayer, self.wall_layer[m]).slipping(host["corner"][:, self.dim] * self.log_friction[m].exp().cpu())
        layer = torch.zeros(len(mass), 3) if walls.layer is None else walls.layer
        held = _array(store.prescribed) if "prescribed" in store else np.zeros((0, self.dim), bool)
        forces = (acceleration, data.gravity, mass_on_host)
        contacts = (
            walls.normal,
            walls.gap.double(),
            walls.friction.double(),
            layer.double(),
            host["corner_index"],
            host["corner"],
            at_corner.double(),
        )
        move_bodies(
            _array(torch.stack([lam, mu, eta], dim=1).double()), *map(_array, forces), held, _array(host["body_pos"]), _array(host["velocity"]),
            *map(_array, contacts), *map(_array, (touching.nodes, touching.way, touching.law)), *cells.arrays, _array(cells.length),
            tuple(float(unit) for unit in (self.acceleration_unit, self.spacing, self.stress_unit)),
            (float(MAX_SUBSTEPS), STABLE, SHARE, APPROACH), np.array(SOFTER), moved, at_end, stress,
        )  # fmt: skip
        found, velocity, tensions = (torch.from_numpy(a).to(mass.device) for a in (moved, at_end, stress))
        return found, velocity, tensions if with_stress else None


def _with_attached(store: dict[str, Tensor], scene: Tensor | None) -> Tensor:
    """Return the cells of a material with those that attach loose nodes, scene by scene."""
    if not len(store["attached_index"]):
        return store["cell_index"]
    cells = torch.cat([store["cell_index"], store["attached_index"]])
    return cells if scene is None else cells[torch.argsort(scene[cells[:, 0]], stable=True)]


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.detach().cpu().numpy())


def cells_at_rest(material: str, cell_index: Tensor, rest_pos: Tensor, mass: Tensor, scene: Tensor | None) -> Cells:
    """Return the cells of a graph at rest. They are computed once for equal arrays, because only positions and velocities change in a rollout.

    Raises:
        CellError: a cell has no volume, or there are several kinds of cells.
    """
    arrays = [None if t is None else np.ascontiguousarray(t.detach().cpu().numpy()) for t in (cell_index, rest_pos, mass, scene)]
    return _found_once(material, rest_pos.device, *(None if a is None else (a.tobytes(), a.dtype.str, a.shape) for a in arrays))


Content = tuple[bytes, str, tuple[int, ...]]
"""Bytes, type and shape of an array."""


@lru_cache(maxsize=MAX_CACHED)
@torch.inference_mode(False)  # a rollout may be the first to ask, and training the next
def _found_once(material: str, device: torch.device, *contents: Content | None) -> Cells:
    cell_index, rest_pos, mass, scene = (
        None if c is None else torch.from_numpy(np.ndarray(buffer=c[0], dtype=c[1], shape=c[2]).copy()) for c in contents
    )
    assert cell_index is not None and rest_pos is not None and mass is not None
    cells = Cells.of(_without_padding(cell_index, rest_pos.shape[1], material), rest_pos, mass, scene)
    flat = torch.nonzero(cells.volume.sum(dim=1) <= 0)
    if len(flat):
        raise CellError(f"{material}: cell {int(flat[0])} has no volume at rest; leave it out or choose model.elastic=false")
    return cells.to(device)


def _without_padding(cells: Tensor, dim: int, material: str) -> Tensor:
    """Return simplices [cell, dim + 1] whose last corner was repeated, or other cells as they are.

    Raises:
        CellError: some of the cells are simplices.
    """
    is_simplex = (cells[:, dim : dim + 1] == cells[:, dim + 1 :]).all(dim=1)
    if bool(is_simplex.all()):
        return cells[:, : dim + 1]
    if bool(is_simplex.any()):
        kinds = "triangles and quadrilaterals" if dim == 2 else "tetrahedra and hexahedra"
        raise CellError(f"{material}: model.elastic=true needs cells of one kind, these scenes have {kinds}; choose model.elastic=false")
    return cells
