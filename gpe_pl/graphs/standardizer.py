"""Standardisation of graphs with the statistics of the training split."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.graphs.features import ParameterScale
from gpe_pl.graphs.standards import ParameterStandards, Standards
from gpe_pl.nn.blocks import Standardize
from gpe_pl.nn.pointers import checksum, count_words
from gpe_pl.schema import RADIUS, EdgeType, FeatureSpec, role


def _no_more(roles: frozenset[str]) -> list[HeteroData]:
    return []


def _as_they_are(relation: EdgeType, graphs: list[HeteroData]) -> list[HeteroData]:
    return graphs


@dataclass(frozen=True)
class StatisticsSample:
    """Training graphs from which statistics are computed.

    Attributes:
        graphs: graphs evenly spread over the split.
        rare: function that takes roles of node types (see ``schema.role``). If few of ``graphs`` have nodes of all these roles, it returns further graphs that
            do; otherwise an empty list.
        touching: function that takes a ``radius`` relation and graphs. If few of these graphs have edges of the relation, it returns other graphs that do;
            otherwise the same graphs.
    """

    graphs: list[HeteroData]
    rare: Callable[[frozenset[str]], list[HeteroData]] = _no_more
    touching: Callable[[EdgeType, list[HeteroData]], list[HeteroData]] = _as_they_are

    def of(self, *roles: str) -> list[HeteroData]:
        """Return the graphs for statistics of nodes of one role, or of edges between two."""
        return self.rare(frozenset(roles)) or self.graphs

    def __iter__(self) -> Iterator[HeteroData]:
        return iter(self.graphs)


class _Kept(NamedTuple):
    """Statistics as arrays, and what tells whether they are current.

    Attributes:
        addresses: addresses of the tensors.
        memory: the addresses, and the numbers of words of four bytes there, as ``pointers.checksum`` takes them.
        checksum: checksum of this memory.
        tensors: the tensors, which are kept so that no others get their addresses.
        standards: the statistics.
    """

    addresses: list[int]
    memory: tuple[np.ndarray, np.ndarray]
    checksum: int
    tensors: list[Tensor]
    standards: Standards


class GraphStandardizer(nn.Module):
    """Standardises every feature of a graph with training statistics. Odd edge channels are only scaled, so they stay odd. Masses are divided by their mean.

    All levels of virtual nodes have the same statistics, so a graph may have more levels than the graphs of training.

    Args:
        spec: channels of the graphs.
        parameter_scale: scale of material parameters, as in ``GraphConfig``.
    """

    mass: Tensor

    def __init__(self, spec: FeatureSpec, parameter_scale: ParameterScale | None = None) -> None:
        super().__init__()
        self.spec, self.parameter_scale = spec, parameter_scale
        self.node = nn.ModuleDict({role(t): Standardize(c) for t, c in spec.node_channels.items()})
        self.params = nn.ModuleDict({m: Standardize(c).to(self._precision(m)) for m, c in spec.param_channels.items()})
        self.odd = nn.ModuleDict({self._key(r): Standardize(spec.odd_channels[r], centered=False) for r in spec.relations})
        self.even = nn.ModuleDict({self._key(r): Standardize(spec.even_channels[r]) for r in spec.relations})
        self.register_buffer("mass", torch.ones(()))
        self._buffers_of_all = [module._buffers for module in self.modules()]
        self._standards: _Kept | None = None

    @staticmethod
    def _key(relation: EdgeType) -> str:
        source, name, target = relation
        return f"{role(source)}__{name}__{role(target)}"

    def is_log(self, material: str) -> list[bool]:
        """Return for each parameter of a material whether its logarithm is standardised."""
        return [self.parameter_scale is None and p.scale == "log" for p in self.spec.parameters[material]]

    def _precision(self, material: str) -> torch.dtype:
        """Return the precision in which a material's parameters are standardised.

        Logarithms need double precision. In another unit they are shifted, and single precision would round them differently.
        """
        return torch.float64 if any(self.is_log(material)) else torch.float32

    def _material_scale(self, material: str, params: Tensor) -> Tensor:
        """Return parameters [node, param], the logarithm of those with a logarithmic scale."""
        is_log = self.is_log(material)
        if not any(is_log):
            return params
        columns = params.to(torch.float64).unbind(dim=1)
        return torch.stack([c.log() if log else c for c, log in zip(columns, is_log, strict=True)], dim=1)

    def fit(self, graphs: Iterable[HeteroData]) -> list[str]:
        """Set all statistics from graphs of the training split; a ``StatisticsSample`` adds graphs of rare materials and relations.

        Returns:
            Materials without nodes in any graph, and ``radius`` relations without edges between node types that occur. These are not standardised. Relations of
                meshes are never listed.
        """

        def fit(module: nn.Module, values: Iterable[Tensor]) -> bool:
            return cast(Standardize, module).fit(values)

        sample = graphs if isinstance(graphs, StatisticsSample) else StatisticsSample(list(graphs))
        looked_at = cache(sample.of)

        missing = []
        for name, module in self.node.items():
            found = fit(module, (g[t].x for g in looked_at(name) for t in self.spec.node_types if role(t) == name))
            if not found and name in self.spec.materials:
                missing.append(name)
        for m, module in self.params.items():
            fit(module, (self._material_scale(m, g[m].material_params) for g in looked_at(m)))
        for key, module in self.odd.items():
            relations = [r for r in self.spec.relations if self._key(r) == key]
            seen, is_contact = looked_at(role(relations[0][0]), role(relations[0][2])), relations[0][1] == RADIUS
            if is_contact:
                seen = sample.touching(relations[0], seen)
            found = fit(module, (g[r].odd for g in seen for r in relations))
            fit(self.even[key], (g[r].even for g in seen for r in relations))
            if not found and is_contact and any(len(g[r[0]].x) and len(g[r[2]].x) for g in seen for r in relations):
                missing.append(named(relations[0]))
        mass = [g[m].mass for g in sample for m in self.spec.materials]
        if sum(len(x) for x in mass):
            self.mass.copy_(torch.cat(mass).double().mean())
        return missing

    def unknown(self) -> list[str | EdgeType]:
        """Return the materials and relations without statistics; empty before ``fit``."""
        materials = [m for m in self.spec.materials if cast(Standardize, self.node[m]).is_identity]
        if len(materials) == len(self.spec.materials):
            return []
        return [*materials, *(r for r in self.spec.relations if cast(Standardize, self.odd[self._key(r)]).is_identity)]

    def standards(self, limits: dict[str, Tensor] | None = None) -> Standards:
        """Return the statistics as arrays for compiled features on the CPU. They are kept until a statistic changes.

        Each call compares a checksum of all statistics, because PyTorch does not count changes through ``data``, NumPy or in inference mode.

        Args:
            limits: as in ``forward``.
        """
        tensors = [t for buffers in self._buffers_of_all for t in buffers.values() if t is not None] + [*(limits or {}).values()]
        addresses, kept = [*map(Tensor.data_ptr, tensors)], self._standards
        if kept is None or kept.addresses != addresses or checksum(*kept.memory) != kept.checksum:
            memory = np.array(addresses, np.int64), np.array([*map(count_words, tensors)], np.int64)
            kept = self._standards = _Kept(addresses, memory, checksum(*memory), tensors, self._new_standards(limits))
        return kept.standards

    def _new_standards(self, limits: dict[str, Tensor] | None) -> Standards:
        def statistics(module: nn.Module) -> tuple[np.ndarray, np.ndarray]:
            standard = cast(Standardize, module)
            return standard.mean.detach().numpy().copy(), (1 / standard.std.detach()).numpy()

        keys = {r: self._key(r) for r in self.spec.relations}
        bounds = {m: None if limits is None else limits[m].detach().numpy().astype(np.float32) for m in self.spec.materials}
        return Standards(
            node={t: statistics(self.node[role(t)]) for t in self.spec.node_types},
            odd={r: statistics(self.odd[key])[1] for r, key in keys.items()},
            even={r: statistics(self.even[key]) for r, key in keys.items()},
            params={m: ParameterStandards(statistics(self.params[m]), self.is_log(m), bounds[m]) for m in self.spec.materials},
            mass=float(self.mass),
            precision=self.mass.detach().numpy().dtype,
        )

    def forward(self, data: HeteroData, skip_absent: bool = True, limits: dict[str, Tensor] | None = None) -> HeteroData:
        """Return a graph with standardised features; the input does not change.

        Args:
            data: graph with features in SI units.
            skip_absent: do nothing for node types and relations without rows.
            limits: lowest and highest value [2, param] of each material's parameters, to which values are clamped.
        """

        def wanted(values: Tensor) -> bool:
            return not skip_absent or values.shape[0] > 0

        out = copy.copy(data)
        for t in self.spec.node_types:
            if wanted(data[t].x):
                out[t].x = self.node[role(t)](data[t].x)
        for m in self.spec.materials:
            if wanted(data[m].x):
                params = data[m].material_params
                if limits is not None:
                    params = params.clamp(*limits[m].to(params.dtype))
                standardized = self.params[m](self._material_scale(m, params))
                out[m].material_params = standardized.to(torch.promote_types(params.dtype, self.mass.dtype))
                out[m].mass = data[m].mass / self.mass
        for relation in self.spec.relations:
            if wanted(data[relation].odd):
                out[relation].odd = self.odd[self._key(relation)](data[relation].odd)
                out[relation].even = self.even[self._key(relation)](data[relation].even)
        return out


def named(kind: str | EdgeType) -> str:
    """Return a material or relation in words, for messages."""
    return kind if isinstance(kind, str) else "–".join((role(kind[0]), kind[1], role(kind[2])))
