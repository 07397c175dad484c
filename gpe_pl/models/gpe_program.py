"""Writes GPE as a network program, for rollouts on a CPU (see ``nn.network_program``).

The program computes what ``GPE.compute`` computes, up to rounding. Two pairs of linear maps are multiplied once, when the program is written: the last map of
the messages with the first map of the update, and the material embedding with the first map of the encoder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gpe_pl.nn.network_program import NetworkProgram
from gpe_pl.nn.network_program_kernels import ADD, JOIN, NONE
from gpe_pl.schema import CELL, RADIUS, EdgeType

if TYPE_CHECKING:
    from gpe_pl.models.gpe import GPE

Place = tuple[int, int]
"""Number of a matrix of the program, and number of a column in it, at which some columns start."""


class GPEProgram:
    """Writes the program of a GPE. The attributes name matrices and sets of rows by their number in the program (``nn.network_program``).

    Attributes:
        program: the program.
        types: name of the weights (``GPE.type_key``) of each node type that the network reads. Several types may share weights.
        relations: for each relation, the name of the source's weights, its own name, and the name of the target's weights.
        features: matrices of node features, by name in ``types``.
        params, mass: matrices of material parameters and masses, by material.
        edges, states: matrices of edge features and of edge states, by names in ``relations``. Each is a pair: the matrix of the stored direction, and that of
            the opposite direction or ``NONE``.
        acceleration, stress, contact: matrices of the results, by material; see ``gpe_program_runner.Decoded``.
        stress_rows: set of rows that is empty if no stress is wanted.
    """

    def __init__(self, model: GPE) -> None:
        weight = next(model.parameters())
        self.model, self.program = model, NetworkProgram(weight.dtype)
        self.hidden: int = model.settings["hidden_channels"]
        spec, program = model.spec, self.program
        self.types = {t: model.type_key(t) for t in spec.node_types if model.type_key(t) in model.node_encoder}
        convs: Any = model.convs
        self.relations = {r: (self.types[r[0]], r[1], self.types[r[2]]) for r in spec.relations if model.key(r) in convs[0]}
        self.named = {joined: r for r, joined in reversed(self.relations.items())}
        self.features, self.params, self.mass = dict[str, int](), dict[str, int](), dict[str, int]()
        self.edges, self.states = dict[EdgeType, Place](), dict[EdgeType, Place]()
        self.acceleration, self.stress, self.contact = dict[str, int](), dict[str, int](), dict[str, int]()
        self.h, self.z, self.y, self.sums, self.projected = (dict[str, int]() for _ in range(5))
        self.degree = dict[str, int]()
        for t, key in self.types.items():
            if key not in program.node_types:
                kind = program.node_type(key)
                self.features[key] = program.matrix(kind.every, spec.node_channels[t])
        for joined in dict.fromkeys(self.relations.values()):
            program.relations[joined] = program.new_set()
        self.stress_rows = program.new_set()
        self.block = {name: program.matrix(NONE, self.hidden) for name in ("z", "y", "w", "u")}
        self._uses = [self._used_columns(step) for step in range(model.num_message_passing_steps)]
        self._write()

    # --- layout ------------------------------------------------------------------------------------------------------------------------------

    def _layers(self, step: int) -> list[tuple[EdgeType, Any]]:
        """Return the relations that have messages in a step, and their layers."""
        convs: Any = self.model.convs[step]
        return [(joined, convs[self.model.key(r)]) for joined, r in self.named.items() if self.model.key(r) in convs]

    def _updates_edges(self, step: int) -> bool:
        return self.model.edge_state == "latent" and step < self.model.num_message_passing_steps - 1

    def _used_columns(self, step: int) -> dict[str, dict[tuple[Any, ...], int]]:
        """Return the first column of each sum of messages of a step, by node type and by what is summed."""
        found: dict[str, dict[tuple[Any, ...], int]] = {t: {} for t in self.program.node_types}
        for joined, conv in self._layers(step):
            for t in dict.fromkeys((joined[2], joined[0])):
                if t not in self._updated(step):
                    continue
                keys: list[tuple[Any, ...]] = [("messages",)] if self._updates_edges(step) else [("sums", joined)]
                keys += [("evens", joined)] if conv.lin_even is not None else []
                for key in keys:
                    found[t].setdefault(key, self.hidden * len(found[t]))
        return found

    def _updated(self, step: int) -> Any:
        return self.model.updates[step]

    def _write(self) -> None:
        program, hidden = self.program, self.hidden
        widths = {t: max(len(use[t]) for use in self._uses) * hidden for t in program.node_types}
        columns = {
            t: max(sum(self._num_maps(joined, conv, t) for joined, conv in self._layers(s)) for s in range(len(self._uses))) for t in widths
        }
        decoded = self._force_relations()
        for t, kind in program.node_types.items():
            num_forces = sum(t in (joined[0], joined[2]) for joined in decoded)
            maps = max(columns[t], 2 * num_forces)
            self.h[t] = program.matrix(kind.every, hidden)
            self.sums[t] = program.matrix(kind.every, max(widths[t], num_forces * hidden))
            self.projected[t] = program.matrix(kind.every, maps * hidden)
            self.degree[t] = program.matrix(kind.every, 2 * len(program.relations))
        for t in program.node_types:
            self._encode_nodes(t)
        for joined in program.relations:
            self._encode_edges(joined)
        for t in program.node_types:
            self._between_layers(t, None, 0)
        for step in range(len(self._uses)):
            places = self._projected_places(step)
            for joined, conv in self._layers(step):
                self._messages(joined, conv, step, places)
            for t in program.node_types:
                self._between_layers(t, step, step + 1)
        self._decode()

    # --- encoders ----------------------------------------------------------------------------------------------------------------------------

    def _encode_nodes(self, t: str) -> None:
        model, program, kind = self.model, self.program, self.program.node_types[t]
        encoder: Any = model.node_encoder[t]
        first, material = encoder[0], t if t in model.spec.materials else None
        weight, bias, z = first.weight, first.bias, self.block["z"]
        embedding: Any = model.material_embedding[t] if material is not None and t in model.material_embedding else None
        channels = weight.shape[1] - (self.hidden if embedding is not None else 0)
        with program.segment(kind.every if material and not self._falls_freely(t) else kind.connected):
            program.product(z, self.features[t], weight[:, :channels], JOIN)
            if embedding is not None:
                theta, own = embedding.theta, weight[:, channels:].double()
                self.params[t] = program.matrix(kind.every, model.spec.param_channels[t])
                if isinstance(theta, torch.nn.Linear):
                    program.product(z, self.params[t], own @ theta.weight.double(), JOIN)
                    bias = bias.double() + own @ theta.bias.double()
                else:
                    y, last = self.block["y"], theta[2]
                    program.product(y, self.params[t], theta[0].weight)
                    program.activate(y, theta[0].bias, theta[1].weight)
                    program.product(z, y, own @ last.weight.double(), JOIN)
                    bias = bias.double() + own @ last.bias.double()
            program.activate(z, bias, encoder[1].weight, fills=True)
            if len(encoder) > 3:
                program.product(self.block["y"], z, encoder[2].weight)
                program.normalize(self.h[t], self.block["y"], encoder[2].bias, encoder[3], adds=False)
            else:
                program.product(self.h[t], z, encoder[2].weight)
                program.bias(self.h[t], encoder[2].bias)
            program.zero(self.sums[t])
            program.zero(self.degree[t])

    def _encode_edges(self, joined: EdgeType) -> None:
        """Write edge states, and count the edges of each node."""
        model, program, r = self.model, self.program, self.named[joined]
        rows, odd, even = program.relations[joined], model.spec.odd_channels[r], model.spec.even_channels[r]
        kind, directed = model._interaction(r), model._interaction(r) == "directed"
        features = program.matrix(rows, odd + even), program.matrix(rows, odd + even) if directed else NONE
        self.edges[joined] = features
        with program.segment(rows):
            for end, t, sign in ((1, joined[2], 1), (0, joined[0], 1 if directed else -1)):
                program.count((self.degree[t], self._degree_column(joined)), sign, end)
        if model.edge_state == "geometry":
            self.states[joined] = features
            return
        encoder: Any = model.edge_encoder[model.key(r)]
        states = program.matrix(rows, self.hidden), program.matrix(rows, self.hidden) if directed else NONE
        self.states[joined] = states
        with program.segment(rows):
            if kind in ("odd", "odd_even"):
                w, u = self.block["w"], self.block["u"]
                program.product(w, features[0], encoder.lin_odd.weight)
                program.product(u, features[0], encoder.lin_even.weight, column=odd)
                program.activate_odd(w, u, encoder.lin_even.bias, encoder.act.weight)
                program.product(states[0], w, encoder.lin_out.weight)
                return
            for x, e in zip(features, states, strict=True):
                if x != NONE:
                    program.product(self.block["w"], x, encoder[0].weight)
                    program.activate(self.block["w"], encoder[0].bias, encoder[1].weight)
                    program.product(e, self.block["w"], encoder[2].weight)
                    program.bias(e, encoder[2].bias)

    def _degree_column(self, joined: EdgeType) -> int:
        return [*self.program.relations].index(joined)

    # --- layers ------------------------------------------------------------------------------------------------------------------------------

    def _num_maps(self, joined: EdgeType, conv: Any, t: str) -> int:
        """Return the number of linear maps of the states of nodes of a type that the messages of a relation need."""
        if t not in (joined[0], joined[2]):
            return 0
        return 2 if joined[0] == joined[2] or conv.interaction == "directed" else 1

    def _projected_places(self, step: int) -> dict[tuple[EdgeType, str], Place]:
        """Return the places of the products of node states with the first (a) and second (b) map of the messages.

        Keys are a relation, and the map with the end whose states it takes: ``a target``, ``b source`` and so on.
        """
        used = dict.fromkeys(self.program.node_types, 0)
        places: dict[tuple[EdgeType, str], Place] = {}

        def take(joined: EdgeType, t: str, *names: str) -> None:
            for name in names:
                places[joined, name] = self.projected[t], used[t]
            used[t] += self.hidden

        for joined, conv in self._layers(step):
            source, _, target = joined
            if source == target:
                take(joined, target, "a target", "a source")
                take(joined, target, "b source", "b target")
            elif conv.interaction == "directed":
                take(joined, target, "a target")
                take(joined, target, "b target")
                take(joined, source, "a source")
                take(joined, source, "b source")
            else:
                take(joined, target, "a target")
                take(joined, source, "b source")
        return places

    def _project(self, t: str, step: int) -> None:
        """Write the products of node states that the messages of a step need."""
        program, places = self.program, self._projected_places(step)
        for joined, conv in self._layers(step):
            needs = program.relations[joined]
            a, b, *_ = conv.lin_in.weight.split(conv.widths, dim=1)
            maps: dict[Place, tuple[Tensor, Tensor | None]] = {}
            for name, weight, bias in (("a", a, conv.lin_in.bias), ("b", b, None)):
                for end, node_type in (("target", joined[2]), ("source", joined[0])):
                    if node_type == t and (joined, f"{name} {end}") in places:
                        maps[places[joined, f"{name} {end}"]] = weight, bias
            if not maps:
                continue
            matrix, first = min(maps)  # the others are beside it
            program.product(matrix, self.h[t], torch.cat([weight for weight, _ in maps.values()]), to=first, needs=needs)
            for (_, column), (_, bias) in maps.items():
                if bias is not None:
                    program.bias(matrix, bias, column, needs=needs)

    def _messages(self, joined: EdgeType, conv: Any, step: int, places: dict[tuple[EdgeType, str], Place]) -> None:
        """Write the messages of a relation, their sums, and new edge states."""
        program, updates, uses = self.program, self._updates_edges(step), self._uses[step]
        source, _, target = joined
        _, _, of_state, of_even = conv.lin_in.weight.split(conv.widths, dim=1)
        w, u, m, slope, hidden = self.block["w"], self.block["u"], self.block["z"], conv.act.weight, self.hidden

        def sums(t: str, name: str = "messages" if updates else "sums") -> Place | None:
            column = uses[t].get((name,) if name == "messages" else (name, joined))
            return None if column is None else (self.sums[t], column)

        def receive(x: int, *ends: tuple[int, str, int], name: str = "messages" if updates else "sums") -> None:
            for end, t, sign in ends:
                if (place := sums(t, name)) is not None:
                    program.scatter(x, hidden, place, sign, end)

        def send(x: int, state: int, *ends: tuple[int, str, int]) -> None:
            """Add activations x to the sums, or messages of them, which also change the edge states."""
            if updates:
                program.product(m, x, conv.lin_out.weight)
                bias = conv.lin_out.bias
                program.update(m, state, torch.zeros(hidden) if bias is None else bias)
            receive(m if updates else x, *ends)

        with program.segment(program.relations[joined]):
            state, opposite = self.states[joined]
            program.product(w, state, of_state)
            if conv.is_odd:
                program.product(u, self.edges[joined][0], of_even, column=self.model.spec.odd_channels[self.named[joined]])
                (matrix, a), (_, b) = places[joined, "a target"], places[joined, "b source"]
                program.gather_odd(w, u, hidden, slope, matrix, a, b)
                send(w, state, (1, target, 1), (0, source, -1))
                if conv.lin_even is not None:
                    receive(u, (1, target, 1), (0, source, 1), name="evens")
            elif conv.interaction == "directed":
                program.gather(w, hidden, slope, places[joined, "a target"], places[joined, "b source"], end=1)
                send(w, state, (1, target, 1))
                program.product(w, opposite, of_state)
                program.gather(w, hidden, slope, places[joined, "a source"], places[joined, "b target"], end=0)
                send(w, opposite, (0, source, 1))
            else:
                at_target, at_source = sums(target), sums(source)
                if not updates and at_target is not None and at_source is not None:
                    program.messages(w, hidden, slope, places[joined, "a target"], places[joined, "b source"], at_target, at_source)
                else:
                    program.gather(w, hidden, slope, places[joined, "a target"], places[joined, "b source"])
                    send(w, state, (1, target, 1), (0, source, -1))

    def _between_layers(self, t: str, step: int | None, following: int) -> None:
        """Write the update of a node type after a step, and the products of node states that the following step needs."""
        with self.program.segment(self.program.node_types[t].connected):
            if step is not None and t in self._updated(step):
                self._update(t, step)
            if following < len(self._uses):
                self._project(t, following)

    def _update(self, t: str, step: int) -> None:
        program, z, y = self.program, self.block["z"], self.block["y"]
        layers: Any = self.model.updates[step][t]  # type: ignore[index]
        first, convs = layers[0].weight.double(), dict(self._layers(step))
        for key, column in self._uses[step][t].items():
            if key[0] == "messages":
                program.product(z, self.sums[t], first, JOIN, column)
                continue
            conv, needs = convs[key[1]], program.relations[key[1]]
            last = conv.lin_out if key[0] == "sums" else conv.lin_even
            program.product(z, self.sums[t], first @ last.weight.double(), JOIN, column, needs=needs)
            if last.bias is not None:
                program.degree(z, self.degree[t], self._degree_column(key[1]), first @ last.bias.double(), needs=needs)
        program.activate(z, layers[0].bias, layers[1].weight, fills=True)
        program.product(y, z, layers[2].weight)
        if len(layers) > 3:
            program.normalize(self.h[t], y, layers[2].bias, layers[3], adds=True)
        else:
            program.residual(self.h[t], y, layers[2].bias)
        program.zero(self.sums[t])

    # --- decoders ----------------------------------------------------------------------------------------------------------------------------

    def _falls_freely(self, material: str) -> bool:
        """Tell whether nodes of a material without edges need no state: only pair forces accelerate them, and no stress is decoded."""
        return self.model.decoder == "pair" and not (self.model.settings["stress"] and material in self.model.spec.stress_channels)

    def _force_relations(self) -> list[EdgeType]:
        model = self.model
        if not hasattr(model, "pair_decoder"):
            return []
        return [joined for joined, r in self.named.items() if model.key(r) in model.pair_decoder and r[1] in (RADIUS, CELL)]

    def _decode(self) -> None:
        model, program = self.model, self.program
        for m in model.spec.materials:
            if m not in program.node_types:
                continue
            kind = program.node_types[m]
            with program.segment(kind.isolated):
                if not self._falls_freely(m):
                    program.bias(self.h[m], self._isolated_update(m))
            if model.decoder != "pair":
                self.acceleration[m] = program.matrix(kind.every, model.spec.dim)
                with program.segment(kind.every):
                    self._decode_node(model.node_decoder[m], m, self.acceleration[m], NONE)
            if hasattr(model, "stress_decoder") and m in model.stress_decoder:
                self.stress[m] = program.matrix(kind.every, model.spec.stress_channels[m])
                with program.segment(kind.every):
                    self._decode_node(model.stress_decoder[m], m, self.stress[m], self.stress_rows)
        if model.decoder == "pair" or model.bodies:
            self._decode_forces()

    def _isolated_update(self, material: str) -> Tensor:
        """Return the sum of all updates of a node that receives no message."""
        total = torch.zeros(self.hidden, dtype=torch.float64)
        for updates in self.model.updates:
            layers: Any = updates[material]  # type: ignore[index]
            y = torch.nn.functional.prelu(layers[0].bias.detach().double(), layers[1].weight.detach().double())
            y = layers[2].weight.detach().double() @ y + layers[2].bias.detach().double()
            if len(layers) > 3:
                norm = layers[3]
                y = torch.nn.functional.layer_norm(y, (self.hidden,), norm.weight.detach().double(), norm.bias.detach().double(), norm.eps)
            total += y
        return total

    def _decode_node(self, layers: Any, material: str, out: int, needs: int) -> None:
        self.program.product(self.block["z"], self.h[material], layers[0].weight, JOIN, needs=needs)
        self.program.activate(self.block["z"], layers[0].bias, layers[1].weight, needs=needs)
        self.program.product(out, self.block["z"], layers[2].weight, needs=needs)
        self.program.bias(out, layers[2].bias, needs=needs)

    def _decode_forces(self) -> None:
        """Write pair forces: activations are summed at nodes, and the last map is taken of the sums."""
        model, program, hidden = self.model, self.program, self.hidden
        relations, decoders = self._force_relations(), model.pair_decoder
        receives = [m for m in model.spec.materials if m in program.node_types and (not model.bodies or m in model.bodies)]
        place: dict[tuple[EdgeType, str], Place] = {}
        column: dict[tuple[EdgeType, str], int] = {}
        num_maps, num_sums = dict.fromkeys(program.node_types, 0), dict.fromkeys(program.node_types, 0)
        for joined in relations:
            for t, name in ((joined[2], "target"), (joined[0], "source")):
                place[joined, name] = self.projected[t], hidden * num_maps[t]
                num_maps[t] += 1
            for t in dict.fromkeys((joined[2], joined[0])):
                column[joined, t] = hidden * num_sums[t]
                num_sums[t] += 1
        for t, kind in program.node_types.items():
            with program.segment(kind.connected):
                if any(t in (joined[0], joined[2]) for joined in relations):
                    program.zero(self.sums[t])
                for joined in relations:
                    decoder: Any = decoders[model.key(self.named[joined])]
                    for name, end, weight in (("target", 2, decoder.lin_target.weight), ("source", 0, decoder.lin_source.weight)):
                        if joined[end] == t:
                            matrix, first = place[joined, name]
                            program.product(matrix, self.h[t], weight, to=first, needs=program.relations[joined])
        for joined in relations:
            self._sum_forces(joined, place, column, receives)
        for m in receives:
            kind = program.node_types[m]
            self.mass[m] = program.matrix(kind.every, 1)
            out = program.matrix(kind.every, model.spec.dim)
            (self.contact if model.bodies else self.acceleration)[m] = out
            with program.segment(kind.isolated):
                program.zero(out)
            with program.segment(kind.connected):
                for joined in relations:
                    if m in (joined[0], joined[2]):
                        decoder, needs = decoders[model.key(self.named[joined])], program.relations[joined]
                        program.product(out, self.sums[m], decoder.lin_out.weight, JOIN, column[joined, m], needs=needs)
                        if decoder.lin_out.bias is not None:
                            program.degree(out, self.degree[m], self._force_degree(joined), decoder.lin_out.bias, needs=needs)
                program.divide(out, self.mass[m])

    def _force_degree(self, joined: EdgeType) -> int:
        return len(self.program.relations) + self._degree_column(joined)

    def _sum_forces(
        self, joined: EdgeType, place: dict[tuple[EdgeType, str], Place], column: dict[tuple[EdgeType, str], int], receives: list[str]
    ) -> None:
        model, program, hidden = self.model, self.program, self.hidden
        decoder: Any = model.pair_decoder[model.key(self.named[joined])]
        w, u, features = self.block["w"], self.block["u"], self.edges[joined][0]
        odd = model.spec.odd_channels[self.named[joined]]
        source, _, target = joined
        bodies = (NONE, NONE)
        if source in model.bodies and target in model.bodies:
            bodies = program.node_types[target].number, program.node_types[source].number
        with program.segment(program.relations[joined]):
            program.product(w, features, decoder.lin_odd.weight)
            if decoder.bipartite:
                program.product(w, features, decoder.lin_even.weight, ADD, column=odd)
                program.bias(w, decoder.lin_even.bias)
                program.gather(w, hidden, decoder.act.weight, place[joined, "target"], place[joined, "source"])
            else:
                program.product(u, features, decoder.lin_even.weight, column=odd)
                program.bias(u, decoder.lin_even.bias)
                (matrix, a), (_, b) = place[joined, "target"], place[joined, "source"]
                program.gather_odd(w, u, hidden, decoder.act.weight, matrix, a, b)
            for end, t, sign in ((1, target, 1), (0, source, -1)):
                if t in receives:
                    here = bodies if end else bodies[::-1]
                    program.scatter(w, hidden, (self.sums[t], column[joined, t]), sign, end, here)
                    if decoder.bipartite:
                        program.count((self.degree[t], self._force_degree(joined)), sign, end, here)
