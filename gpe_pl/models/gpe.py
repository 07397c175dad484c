"""GPE, the Graph-based Physics Engine [Yang et al. 2022, "Learning to Simulate Unseen Physical Systems with Graph Neural Networks", Algorithm 1].

The model is an encoder, processor and decoder over typed nodes and relations, with one parameter set per node type and per pair of types. A forward pass::

    h_i   = f_v0(x_i, Θ(material parameters))            e_ij = f_e0(edge features)
    m_ij  = f_e(h_i, h_j, e_ij),  m_ji = −m_ij           (nn.momentum_conv)
    h_i  += f_v(Σ_j m_ij)                                e_ij += m_ij
    a_i   = f_d(h_i)                                     or a sum of antisymmetric pair forces over the true mass, or both (``contact``)

Virtual nodes above meshes are nodes of separate types. They pass messages, and nothing is decoded from them. A message moves up one level per step.
"""

from functools import partial
from typing import Annotated, Any, Literal, cast

import torch
from pydantic import Field
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.errors import GpeError
from gpe_pl.models.base import Model, Prediction
from gpe_pl.models.gpe_program_runner import Decoded, GPEProgramRunner, notice
from gpe_pl.nn.blocks import MLP, NORM_EPS
from gpe_pl.nn.connected import Edges, merged_levels, order_of_edges, renumbered, reordered, touched
from gpe_pl.nn.edge_strength import ties
from gpe_pl.nn.elastic_bodies import WALL_DAMPING, CellError, ElasticBodies
from gpe_pl.nn.encoders import MaterialEmbedding, MaterialEmbeddingKind, OddEncoder
from gpe_pl.nn.fused import works_on
from gpe_pl.nn.fused_processor import Conv, Relation, Step, Update, fused_processor
from gpe_pl.nn.island_momentum import IslandMomentum, conserve, grouped, joined, moved_by_contacts
from gpe_pl.nn.momentum_conv import RAW, EdgeState, Implementation, Interaction, MomentumConv, orient
from gpe_pl.nn.node_loads import loads_of, plus, without_held_bodies
from gpe_pl.nn.pair_force import PairForce
from gpe_pl.nn.strain_scale import StrainScale
from gpe_pl.schema import BOUNDARY, CELL, MESH_MATERIALS, RADIUS, EdgeType, FeatureSpec, grid, is_symmetric, role

Decoder = Literal["node", "pair", "contact"]
LevelWeights = Literal["shared", "separate"]
NodeNorm = Literal["none", "layer"]
StressUnit = Literal["data", "strain"]


class StressError(GpeError, ValueError):
    """Raised when the model should decode a stress but the data set stores none."""


class IslandError(GpeError, ValueError):
    """Raised when islands or bodies should move as a whole but the graphs do not contain them, or when momentum would not be conserved."""


def _conv(conv: Any) -> Conv:
    """Return the parameters of a layer; ``parameters()`` would search for them."""
    return Conv(conv.lin_in.weight, conv.lin_in.bias, conv.act.weight, conv.lin_out.weight, conv.lin_out.bias)


def _update(mlp: Any) -> Update:
    first, act, last, *norm = mlp
    gain, shift = (norm[0].weight, norm[0].bias) if norm else (None, None)
    return Update(first.weight, first.bias, act.weight, last.weight, last.bias, gain, shift)


class GPE(Model):
    """Model of Yang et al. 2022 ("the paper") and its variants; see the module's docstring for the equations.

    Args:
        spec: channels of the graphs.
        interaction: relation between a message and its reverse; see ``nn.momentum_conv``.
        decoder: ``node`` decodes an acceleration per node (paper). ``pair`` decodes an antisymmetric force per edge, divided by the node's mass. ``contact``
            decodes both in meshes: forces on a body's ``radius`` edges to other bodies and walls move and rotate the body as a whole, and accelerations of its
            nodes only deform it. Such edges exist only at contacts. Nodes without a cell belong to the body beside them. Forces between bodies sum to zero.
            Materials without a mesh have an acceleration per node; beside meshes they need ``island_momentum``, so that the total momentum is conserved.
        edge_state: ``latent`` updates a hidden state per edge (Algorithm 1); ``geometry`` feeds the raw edge features to every layer.
        material_embedding: ``affine`` (the paper's interpolation rule) or ``mlp`` (see ``MaterialEmbedding``); ``none`` leaves parameters out, as a control.
        num_message_passing_steps: number of processor layers; 12 in the paper.
        hidden_channels: width of all hidden states and layers; 128 in the paper.
        implementation: ``factored`` or ``plain``; both compute the same function of the same parameters.
        level_weights: ``shared`` has one set of weights for all levels of virtual nodes, whose number is then free; ``separate`` one set per level (paper).
        stress: also decode the stress of materials that have one.
        node_norm: ``layer`` normalises the encoded state of every node and the update of each step, as GNS does. With the ``node`` decoder, accelerations then
            stay bounded in any rollout. ``none`` follows the paper.
        elastic: cells of meshes move their nodes through the whole frame by a constitutive law that the model learns (see ``nn.elastic_bodies``).
        wall_distance: with ``elastic``, initial value of the learned distance from walls at which nodes stop, in rest spacings.
        wall_layer: with ``elastic``, initial thickness of the learned elastic layer of walls in front of that, in rest spacings; 0 stands for no layer.
        wall_damping: damping of this layer at the wall, a fraction of the critical one. It is not learned.
        body_layer: with ``elastic``, initial thickness of the learned layer between bodies, in rest spacings; 0 stands for no layer.
        only_contacts: with ``elastic`` and the ``contact`` decoder, the network adds forces between bodies, and nothing within bodies or at walls.
        viscous: with ``elastic``, cells also have a viscous stress with a learned constant. Choose false for data of solids without damping.
        stress_unit: with ``stress`` and without ``elastic``: decode the stress in the unit of the data set, or with ``strain`` per strain of its scene.
        island_momentum: conserve the ``linear``, or also the ``angular``, momentum of free islands exactly (see ``nn.island_momentum``); or ``ignored``.

    Raises:
        StressError: ``stress`` without a material that has a stress.
        IslandError: graphs do not contain islands and bodies, which ``island_momentum`` and the ``contact`` decoder with meshes need; or the ``contact``
            decoder is used with meshes beside other materials and without ``island_momentum``.
        CellError: ``elastic`` or ``stress_unit="strain"`` without cells in the graphs, or both together.
    """

    has_named_weights = True

    def __init__(
        self,
        spec: FeatureSpec,
        interaction: Interaction = "negated",
        decoder: Decoder = "node",
        edge_state: EdgeState = "latent",
        material_embedding: MaterialEmbeddingKind = "affine",
        num_message_passing_steps: Annotated[int, Field(ge=1, le=64)] = 12,
        hidden_channels: Annotated[int, Field(ge=1, le=4096)] = 128,
        implementation: Implementation = "factored",
        level_weights: LevelWeights = "shared",
        stress: bool = False,
        node_norm: NodeNorm = "none",
        island_momentum: IslandMomentum = "ignored",
        elastic: bool = False,
        wall_distance: Annotated[float, Field(ge=0)] = 0.0,
        wall_layer: Annotated[float, Field(ge=0)] = 0.0,
        wall_damping: Annotated[float, Field(ge=0)] = WALL_DAMPING,
        body_layer: Annotated[float, Field(ge=0)] = 0.0,
        only_contacts: bool = False,
        viscous: bool = True,
        stress_unit: StressUnit = "data",
    ) -> None:
        super().__init__(
            spec,
            interaction=interaction,
            decoder=decoder,
            edge_state=edge_state,
            material_embedding=material_embedding,
            num_message_passing_steps=num_message_passing_steps,
            hidden_channels=hidden_channels,
            implementation=implementation,
            level_weights=level_weights,
            stress=stress,
            node_norm=node_norm,
            island_momentum=island_momentum,
            elastic=elastic,
            wall_distance=wall_distance,
            wall_layer=wall_layer,
            wall_damping=wall_damping,
            body_layer=body_layer,
            only_contacts=only_contacts,
            viscous=viscous,
            stress_unit=stress_unit,
        )
        if elastic and not (spec.cells and spec.meshes and spec.islands):
            raise CellError(
                "model.elastic=true needs graph.cells=true graph.mesh=true graph.islands=true and a material with cells, "
                f"such as {MESH_MATERIALS[0]}; the data set has {', '.join(spec.materials)}; or choose law=none"
            )
        if stress_unit == "strain" and (elastic or not (stress and spec.cells and spec.meshes)):
            raise CellError("model.stress_unit=strain needs model.stress=true model.elastic=false graph.cells=true and cells of a material")
        if island_momentum != "ignored" and not spec.islands:
            raise IslandError(f"model.island_momentum={island_momentum} needs graph.islands=true")
        self.bodies = tuple(r[0] for r in spec.relations if r[1] == CELL) if decoder == "contact" else ()
        if self.bodies and not spec.islands:
            raise IslandError("model.decoder=contact needs graph.islands=true")
        others = [m for m in spec.materials if m not in self.bodies]
        if self.bodies and others and island_momentum == "ignored":
            raise IslandError(
                f"model.decoder=contact with model.island_momentum=ignored does not conserve momentum between {', '.join(self.bodies)} and "
                f"{', '.join(others)}; choose model.island_momentum=linear or angular, or model.decoder=pair or node"
            )
        if stress and not spec.stress_channels:
            raise StressError(
                f"model.stress=true: the data set stores no stress of {', '.join(spec.materials)}; set model.stress=false or, for MPM, data.solver.stress=true"
            )
        self.interaction, self.decoder, self.edge_state = interaction, decoder, edge_state
        self._program: list[GPEProgramRunner | None] = [None]  # shallow copies, which share the weights, share it
        self.level_weights = level_weights
        self.num_message_passing_steps = num_message_passing_steps
        hidden, norm = hidden_channels, node_norm == "layer"
        is_fused = implementation == "factored"
        mlp = partial(MLP, is_fused=is_fused)
        read = {} if material_embedding == "none" else {m: c for m, c in spec.param_channels.items() if c}
        self.material_embedding = nn.ModuleDict({m: MaterialEmbedding(c, hidden, material_embedding, is_fused) for m, c in read.items()})
        readable = self._readable()
        relations = [r for r in spec.relations if {r[0], r[2]} & readable[0]]
        ends = readable[0].union(*({r[0], r[2]} for r in relations))
        self.node_encoder, self.edge_encoder = nn.ModuleDict(), nn.ModuleDict()
        for t in spec.node_types:
            if t in ends and self.type_key(t) not in self.node_encoder:
                self.node_encoder[self.type_key(t)] = mlp(spec.node_channels[t] + (hidden if t in read else 0), hidden, hidden, norm)
        for relation in relations if edge_state == "latent" else []:
            if self.key(relation) not in self.edge_encoder:
                odd, even = spec.odd_channels[relation], spec.even_channels[relation]
                is_odd = self._interaction(relation) in ("odd", "odd_even")
                self.edge_encoder[self.key(relation)] = OddEncoder(odd, even, hidden) if is_odd else mlp(odd + even, hidden, hidden)
        self.convs, self.updates = nn.ModuleList(), nn.ModuleList()
        for types in readable:
            convs = nn.ModuleDict()
            for relation in relations:
                if self.key(relation) in convs or not {relation[0], relation[2]} & types:
                    continue
                kind = self._interaction(relation)
                odd, even = spec.odd_channels[relation], spec.even_channels[relation]
                raw_edge = odd if kind in ("odd", "odd_even") else odd + even
                edge_channels = hidden if edge_state == "latent" else raw_edge
                convs[self.key(relation)] = MomentumConv(hidden, edge_channels, even, kind, implementation)
            self.convs.append(convs)
            keys = dict.fromkeys(self.type_key(t) for t in spec.node_types if t in types)
            self.updates.append(nn.ModuleDict({k: mlp(hidden, hidden, hidden, norm) for k in keys}))
        if decoder != "pair":
            self.node_decoder = nn.ModuleDict({m: mlp(hidden, hidden, spec.dim) for m in spec.materials})
        if decoder == "pair" or self.bodies:
            forces = [r for r in spec.relations if r[1] in (RADIUS, CELL)]
            if self.bodies:
                forces = [r for r in forces if r[1] == RADIUS and {r[0], r[2]} & {*self.bodies}]
            forces = [r for r in forces if not (elastic and only_contacts and BOUNDARY in r)]  # the law has the walls
            self.pair_decoder = nn.ModuleDict({self.key(r): PairForce(spec, r, hidden) for r in forces})
        if elastic:
            count = {m: spec.param_channels[m] if m in read else 0 for m in spec.meshes}
            self.elastic_bodies = ElasticBodies(count, spec.dim, wall_distance, wall_layer, wall_damping, viscous, body_layer)
            zeroed = [cast(MLP, self.node_decoder[m])[2] for m in spec.meshes] if decoder != "pair" else []
            zeroed += [cast(PairForce, force).lin_out for force in self.pair_decoder.values()] if decoder == "pair" or self.bodies else []
            for layer in zeroed:  # training starts from the motion by cells and walls alone
                for values in cast(nn.Linear, layer).parameters():
                    nn.init.zeros_(values)
        if stress:
            decoded = {m: c for m, c in spec.stress_channels.items() if not (elastic and m in spec.meshes)}  # the law knows the others'
            self.stress_decoder = nn.ModuleDict({m: mlp(hidden, hidden, c) for m, c in decoded.items()})
        if stress_unit == "strain":
            self.strain_scale = StrainScale(tuple(m for m in spec.meshes if m in spec.stress_channels), spec.dim)

    def set_units(self, acceleration: float, spacing: float, stress: float) -> None:
        if self.settings["elastic"]:
            self.elastic_bodies.set_units(acceleration, spacing, stress)
        if self.settings["stress_unit"] == "strain":
            self.strain_scale.set_units(acceleration)

    def early_layers(self, num_steps: int) -> list[nn.Module]:
        constants = [self.elastic_bodies] if self.settings["elastic"] else []
        encoders = [self.material_embedding, self.node_encoder, self.edge_encoder]
        return [*encoders, *constants, *self.convs[:num_steps], *self.updates[:num_steps]]

    def parameter_weights(self) -> dict[str, str]:
        first = "weight" if self.settings["material_embedding"] == "affine" else "0.weight"
        names = {f"material_embedding.{m}.theta.{first}": m for m in self.material_embedding}
        if self.settings["elastic"]:
            read = [
                (m, name) for m in self.elastic_bodies.constants if m in self.material_embedding for name in self.elastic_bodies.laws(m)
            ]
            names |= {f"elastic_bodies.{name}.weight": m for m, name in read}
        return names

    def convert_units(self, material: str, stress: float, time: float, shift: Tensor, scale: Tensor) -> None:
        if self.settings["elastic"] and material in self.elastic_bodies.constants:
            self.elastic_bodies.convert_units(material, stress, time, shift, scale)

    @property
    def num_hops(self) -> int:
        return self.num_message_passing_steps + (self.decoder == "pair" or bool(self.bodies))  # a pair force reads the other end

    @property
    def is_fused(self) -> bool:
        """Whether messages use the fused passes for CPUs (see ``nn.fused_messages`` and ``nn.fused_latent``)."""
        return self.interaction in ("negated", "odd") and self.settings["implementation"] == "factored"

    def type_key(self, node_type: str) -> str:
        """Return the name under which the weights of a node type are stored."""
        return role(node_type) if self.level_weights == "shared" else node_type

    def key(self, relation: EdgeType) -> str:
        """Return the name under which the weights of a relation are stored."""
        source, name, target = relation
        return f"{self.type_key(source)}__{name}__{self.type_key(target)}"

    def _interaction(self, relation: EdgeType) -> Interaction:
        return self.interaction if is_symmetric(relation) or self.interaction == "directed" else "negated"

    def _readable(self) -> list[set[str]]:
        """Return for every step the node types whose state after it can still influence a material."""
        readable = [{*self.spec.materials}]
        while len(readable) < self.num_message_passing_steps:
            readers = readable[-1]
            readable.append(readers.union(*({r[0], r[2]} for r in self.spec.relations if {r[0], r[2]} & readers)))
        return readable[::-1]

    def forward(self, data: HeteroData) -> Prediction:
        """Return accelerations without gravity per material, in units of the data set's acceleration scale, and stresses.

        Node types and relations are skipped if they are empty or cannot influence a material within the number of steps.
        """
        keep_absent = not (self.training or self.skips.absent_types)
        acceleration, stress, contact = self._compiled(data, keep_absent) or self._uncompiled(data, keep_absent)
        elastic = self.settings["elastic"]
        load, load_by_law = loads_of(data, acceleration, self.spec.meshes if elastic else ())
        if self.decoder == "pair":
            acceleration = plus(acceleration, load)
        if contact:
            acceleration = self._moved_by_contacts(data, acceleration, plus(contact, load))
        if acceleration and self.settings["island_momentum"] != "ignored":  # forces change it
            acceleration = plus(self._conserve(data, plus(acceleration, load, -1.0)), load)
        velocity: dict[str, Tensor] = {}
        if elastic:
            acceleration = plus(acceleration, load_by_law)
            params = {m: data[m].material_params for m in self.material_embedding if m in acceleration}
            mass = {m: data[m].mass for m in acceleration}
            with_stress = self._wants_stress and bool(self.spec.stress_channels)
            acceleration, velocity, of_law = self.elastic_bodies(data, acceleration, params, mass, with_stress)
            stress = stress | of_law
        elif self.settings["stress_unit"] == "strain":
            stress = self.strain_scale(data, acceleration, stress)
        return Prediction(acceleration, stress, velocity)

    def _compiled(self, data: HeteroData, keep_absent: bool) -> Decoded | None:
        """Return what the network decodes from one compiled call, or None where that is impossible (see ``models.gpe_program_runner``)."""
        weight = self.updates[0][self.type_key(self.spec.materials[0])][0].weight  # type: ignore[index]
        if self.training or torch.is_grad_enabled() or not works_on(weight) or self.settings["implementation"] != "factored":
            return None
        if "compute" in self.__dict__:  # replaced by torch.compile
            return None
        if type(self) is not GPE:
            return notice(f"{type(self).__name__} is a subclass of GPE")
        program = self._program[0]
        if program is None or not program.is_current():
            program = self._program[0] = GPEProgramRunner(self)
        return program(data, self.skips, keep_absent)

    def _uncompiled(self, data: HeteroData, keep_absent: bool) -> Decoded:
        x = {t: data[t].x for t in self.spec.node_types if self.type_key(t) in self.node_encoder and (keep_absent or data[t].x.shape[0])}
        params = {m: data[m].material_params for m in self.material_embedding if m in x}
        mass = {m: data[m].mass for m in self.spec.materials if m in x}
        convs = cast(nn.ModuleDict, self.convs[0])
        relations = [r for r in self.spec.relations if self.key(r) in convs and (keep_absent or data[r].edge_index.shape[1])]
        edges = {r: (data[r].edge_index, data[r].odd, data[r].even) for r in relations}
        if grid(1) in x and self.level_weights == "shared":
            x, edges = merged_levels(x, edges)
        apart = self.skips.isolated_nodes and not self.training
        body = {m: data[m].body for m in self.bodies if m in x}
        return (self._compute_apart if apart else self._compute_in_order)(x, params, mass, body, edges)

    def _moved_by_contacts(self, data: HeteroData, acceleration: dict[str, Tensor], contact: dict[str, Tensor]) -> dict[str, Tensor]:
        """Replace the rigid part of the accelerations of each body by that of its contacts; graphs without cells have no bodies."""
        mass, pos, body = grouped(data, contact, "body", data.num_bodies)
        count = body.shape[0] if torch.compiler.is_exporting() else int(data.num_bodies.sum())  # upper bound of the number
        forces, own = joined([*contact.values()]), joined([acceleration[m] for m in contact])
        if not self.settings["elastic"]:
            body = without_held_bodies(data, [*contact], body, count)
        # with the law, forces act where the contact is, and cells pass them on
        new = moved_by_contacts(own, forces, mass, pos, body, count, not self.settings["elastic"], bool(self.settings["only_contacts"]))
        parts = new.split([a.shape[0] for a in contact.values()])
        return acceleration | dict(zip(contact, parts, strict=True))

    def _conserve(self, data: HeteroData, acceleration: dict[str, Tensor]) -> dict[str, Tensor]:
        mass, pos, island = grouped(data, acceleration, "island", data.num_islands)
        angular = self.settings["island_momentum"] == "angular"
        is_held = data.island_is_held
        tie, wall = ties(data, [*acceleration], island, is_held.shape[0])
        freedom = (1.0 - wall).masked_fill(is_held, 0.0)
        kept = conserve(joined([*acceleration.values()]), mass, pos, island, tie, freedom, angular)
        return dict(zip(acceleration, kept.split([a.shape[0] for a in acceleration.values()]), strict=True))

    def _compute_in_order(
        self, x: dict[str, Tensor], params: dict[str, Tensor], mass: dict[str, Tensor], body: dict[str, Tensor], edges: Edges
    ) -> Decoded:
        """Run ``compute`` with nodes in the order of their edges. In large scenes, the data of neighbours are then more often in the cache."""
        limit = None if self.training else self.skips.sorted_from
        if limit is None or sum(values.shape[0] for values in x.values()) < limit:
            return self.compute(x, params, mass, body, edges)
        order = order_of_edges({t: values.shape[0] for t, values in x.items()}, edges)

        def in_order(values: dict[str, Tensor]) -> dict[str, Tensor]:
            return {t: v[order[t]] if t in order else v for t, v in values.items()}

        results = self.compute(in_order(x), in_order(params), in_order(mass), in_order(body), reordered(edges, order))
        for result in results:
            for t in result.keys() & order.keys():
                result[t] = torch.empty_like(result[t]).index_copy(0, order[t], result[t])
        return results

    def _compute_apart(
        self, x: dict[str, Tensor], params: dict[str, Tensor], mass: dict[str, Tensor], body: dict[str, Tensor], edges: Edges
    ) -> Decoded:
        """Run ``compute`` without message passing for nodes that have no edge, because they would receive no message."""
        has_edge = touched({t: values.shape[0] for t, values in x.items()}, edges)
        if has_edge.keys() >= x.keys() and all(bool(mask.all()) for mask in has_edge.values()):
            return self._compute_in_order(x, params, mass, body, edges)

        def connected(values: dict[str, Tensor]) -> dict[str, Tensor]:
            return {t: v[has_edge[t]] for t, v in values.items() if t in has_edge}

        inner, whole = Decoded({}, {}, {}), Decoded({}, {}, {})
        if edges:
            inner = self._compute_in_order(connected(x), connected(params), connected(mass), connected(body), renumbered(edges, has_edge))
        for m in mass:
            alone = ~has_edge[m] if m in has_edge else torch.ones(x[m].shape[0], dtype=torch.bool, device=x[m].device)
            single = self._isolated(m, x[m][alone], params[m][alone] if m in params else None)
            for together, part, others in zip(whole, single, inner, strict=True):
                if part is not None:
                    together[m] = part.new_empty(alone.shape[0], part.shape[1])
                    together[m][alone] = part
                    if m in others:
                        together[m][~alone] = others[m]
        return whole

    def _isolated(self, material: str, x: Tensor, params: Tensor | None) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Return the entries of ``Decoded`` for nodes of a material without edges. Their sum of messages is zero in every step."""
        falls_freely, with_stress = self.decoder == "pair", self._decodes_stress(material)
        nothing = x.new_zeros(x.shape[0], self.spec.dim)
        if falls_freely and not with_stress:
            return nothing, None, None
        h, key = self._encode_node(material, x, params), self.type_key(material)
        for updates in self.updates:
            h = h + cast(nn.ModuleDict, updates)[key](h.new_zeros(1, h.shape[1]))
        acceleration = nothing if falls_freely else self.node_decoder[material](h)
        return acceleration, self.stress_decoder[material](h) if with_stress else None, nothing if material in self.bodies else None

    @property
    def _wants_stress(self) -> bool:
        return bool(self.settings["stress"]) and (self.training or not self.skips.stress)

    def _decodes_stress(self, material: str) -> bool:
        return self._wants_stress and material in self.stress_decoder

    def compute(
        self,
        x: dict[str, Tensor],
        params: dict[str, Tensor],
        mass: dict[str, Tensor],
        body: dict[str, Tensor],
        edges: Edges,
    ) -> Decoded:
        """Do the computation of ``forward`` on plain tensors, by node type and relation. ``torch.compile`` compiles this method."""
        if self.interaction == "negated":
            edges = {r: (*orient(index, odd), even) if is_symmetric(r) else (index, odd, even) for r, (index, odd, even) in edges.items()}
        is_inference = not torch.is_grad_enabled()
        chunk = self.skips.edges_at_once if is_inference else None
        h = {t: self._encode_node(t, x[t], params.get(t)) for t in x}
        e = {r: self._encode_edges(r, odd, even, chunk) for r, (_, odd, even) in edges.items()}
        at_once = not is_inference and self._can_process_at_once(h, e)
        if at_once:
            h = self._processed_at_once(h, e, edges)

        for step in range(0 if at_once else self.num_message_passing_steps):
            update_edges = self.edge_state == "latent" and step < self.num_message_passing_steps - 1
            convs, updates = cast(nn.ModuleDict, self.convs[step]), cast(nn.ModuleDict, self.updates[step])
            total: dict[str, Tensor] = {}
            for relation, (edge_index, _, even) in edges.items():
                if self.key(relation) not in convs:
                    continue
                source, _, target = relation
                conv = convs[self.key(relation)]
                at_target, at_source, state = conv(h[source], h[target], edge_index, e[relation], even, update_edges, chunk, is_inference)
                for node_type, arriving in ((target, at_target), (source, at_source)):
                    if arriving is not None and self.type_key(node_type) in updates:
                        total[node_type] = total[node_type] + arriving if node_type in total else arriving
                if update_edges:
                    e[relation] = state
            for node_type in x:
                if self.type_key(node_type) not in updates:
                    continue
                incoming = total[node_type] if node_type in total else torch.zeros_like(h[node_type])
                h[node_type] = updates[self.type_key(node_type)](incoming, h[node_type])

        stress = {m: self.stress_decoder[m](h[m]) for m in mass if self._decodes_stress(m)}
        if self.decoder == "pair":
            return Decoded(self._pair_accelerations(h, mass, body, edges, chunk), stress, {})
        contact = self._pair_accelerations(h, {m: mass[m] for m in body}, body, edges, chunk) if body else {}
        return Decoded({m: self.node_decoder[m](h[m]) for m in mass}, stress, contact)

    def _can_process_at_once(self, h: dict[str, Tensor], e: dict[EdgeType, Tensor]) -> bool:
        """Tell whether ``nn.fused_processor`` covers the message-passing steps of training on this graph."""
        if not self.is_fused or self.interaction != "negated" or self.edge_state != "geometry":
            return False
        alike = {self.type_key(t) for t in h}, {self.key(r) for r in e}
        distinct = (len(alike[0]), len(alike[1])) == (len(h), len(e))  # else types of nodes or relations have the same weights
        return (
            distinct
            and bool(h)
            and works_on(*h.values(), *e.values())
            and all(0 < f.shape[1] <= RAW and not f.requires_grad for f in e.values())
        )

    def _processed_at_once(self, h: dict[str, Tensor], e: dict[EdgeType, Tensor], edges: Edges) -> dict[str, Tensor]:
        """Return the states of the nodes after all message-passing steps."""
        types, relations = [*h], [*e]
        steps = []
        for convs, updates in zip(self.convs, self.updates, strict=True):
            conv_of, update_of = cast(nn.ModuleDict, convs), cast(nn.ModuleDict, updates)
            sent = {k: _conv(conv_of[self.key(r)]) for k, r in enumerate(relations) if self.key(r) in conv_of}
            updated = {k: _update(update_of[self.type_key(t)]) for k, t in enumerate(types) if self.type_key(t) in update_of}
            steps.append(Step(sent, updated))
        ends = [Relation(types.index(r[0]), types.index(r[2]), edges[r][0], e[r]) for r in relations]
        return dict(zip(types, fused_processor(ends, steps, NORM_EPS, [*h.values()]), strict=True))

    def _encode_node(self, node_type: str, x: Tensor, params: Tensor | None) -> Tensor:
        if params is not None:
            x = torch.cat([x, self.material_embedding[node_type](params)], dim=1)
        return self.node_encoder[self.type_key(node_type)](x)

    def _encode_edges(self, relation: EdgeType, odd: Tensor, even: Tensor, chunk: int | None) -> Tensor:
        """Return the edge states, computed for ``chunk`` edges at a time."""
        if chunk is None or odd.shape[0] <= chunk:
            return self._encode_edge(relation, odd, even)
        parts = [self._encode_edge(relation, *part) for part in zip(odd.split(chunk), even.split(chunk), strict=True)]
        if self._interaction(relation) == "directed":  # each part contains both directions
            return torch.cat([half for direction in range(2) for half in (part.chunk(2)[direction] for part in parts)])
        return torch.cat(parts)

    def _encode_edge(self, relation: EdgeType, odd: Tensor, even: Tensor) -> Tensor:
        kind = self._interaction(relation)
        encoder = self.edge_encoder[self.key(relation)] if self.edge_state == "latent" else None
        if kind in ("odd", "odd_even"):
            return odd if encoder is None else encoder(odd, even)
        features = torch.cat([odd, even], dim=1)
        if kind == "directed":  # one state per direction, forward first
            features = torch.cat([features, torch.cat([-odd, even], dim=1)])
        return features if encoder is None else encoder(features)

    def _pair_accelerations(
        self, h: dict[str, Tensor], mass: dict[str, Tensor], body: dict[str, Tensor], edges: Edges, chunk: int | None
    ) -> dict[str, Tensor]:
        """Return accelerations by pair forces of the materials in ``mass``.

        Forces within a ``body`` are left out. They are not central, so they could rotate the body.
        """
        force = {m: h[m].new_zeros(h[m].shape[0], self.spec.dim) for m in mass}
        for relation, (edge_index, odd, even) in edges.items():
            if self.key(relation) not in self.pair_decoder:
                continue
            source, _, target = relation
            f = self.pair_decoder[self.key(relation)](h[source], h[target], edge_index, odd, even, chunk)
            if source in body and target in body:
                (j, i), here, there = edge_index, body[target], body[source]
                f = torch.where(((here[i] == there[j]) & (here[i] >= 0))[:, None], 0.0, f)
            if target in force:
                force[target] = force[target].index_add(0, edge_index[1], f)
            if source in force:
                force[source] = force[source].index_add(0, edge_index[0], -f)
        return {m: force[m] / mass[m][:, None] for m in mass}
