"""Hypothesis strategies for states, scenes, graphs and files, including degenerate ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from hypothesis import strategies as st
from torch_geometric.data import HeteroData

from gpe_pl.benchmarks.faults.stores import flipped, overwritten, truncated
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.schema import MATERIALS, STICKY, node_code, param_names
from gpe_pl.solvers.scenes import BodyScene
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from tests.scenes import SPACING, builder, metadata

PARTICLES = ("sand", "snow", "fluid")
seeds = st.integers(0, 2**32 - 1)


# --- states -------------------------------------------------------------------------------------------------------------------------------


@st.composite
def clouds(draw: Callable[..., Any], num_nodes: int, dim: int) -> np.ndarray:
    """Draw positions [node, dim] in the unit box: random, on a lattice with ties and coincident nodes, crowded, or at the walls."""
    rng = np.random.default_rng(draw(seeds))
    pos = rng.uniform(0.0, 1.0, (num_nodes, dim))
    kind = draw(st.sampled_from(["anywhere", "lattice", "crowded", "walls", "one place"]))
    if kind == "lattice":
        pos = np.clip(np.round(pos / SPACING) * SPACING, 0.0, 1.0)
    elif kind == "crowded":
        pos = 0.5 + 0.1 * (pos - 0.5)
    elif kind == "walls":
        pos[:, rng.integers(dim)] = rng.choice([0.0, 1.0])
    elif kind == "one place" and num_nodes <= 8:
        pos[:] = pos[:1]
    return pos


@st.composite
def states(
    draw: Callable[..., Any], max_nodes: int = 24, materials: tuple[str, ...] = PARTICLES, history: int = 2, dim: int | None = None
) -> State:
    """Draw a state of particles for which a graph exists: any number from 0, any materials, at rest or fast, with or without walls."""
    dim = draw(st.sampled_from([2, 3])) if dim is None else dim
    count = draw(st.integers(0, max_nodes))
    rng = np.random.default_rng(draw(seeds))
    names = param_names(materials)
    kinds = rng.integers(len(materials), size=count)
    params = np.full((count, len(names)), np.nan)
    for row, kind in enumerate(kinds):
        first = MATERIALS[materials[kind]][0]
        low, high = first.limits.low, first.limits.high
        params[row, names.index(first.name)] = rng.uniform(low, min(high, low + 40.0))
    speed = draw(st.sampled_from([0.0, 1.0, 100.0]))
    past = speed * rng.normal(size=(count, history, dim))
    shapes = domain_walls(((0.0, 1.0),) * dim, draw(st.sampled_from([0.0, 0.5, STICKY]))) if draw(st.booleans()) else ()
    return State(
        draw(clouds(count, dim)),
        past[:, -1],
        np.array([node_code(materials[k]) for k in kinds], dtype=np.uint8),
        rng.uniform(0.1, 10.0, count),
        params,
        Boundary.sample(shapes, 2 * SPACING, dim),
        np.array(metadata(materials, dim).gravity),
        past,
    )


@st.composite
def trajectories(draw: Callable[..., Any], max_nodes: int = 8, max_frames: int = 6) -> Trajectory:
    """Draw a trajectory that can be stored: any number of frames and nodes, values of any size that fit, any text in the metadata."""
    state = draw(states(max_nodes))
    rng, frames = np.random.default_rng(draw(seeds)), draw(st.integers(1, max_frames))
    scale = 10.0 ** draw(st.integers(-30, 18))  # larger numbers are not read
    shape = (frames, state.num_nodes, state.dim)
    text = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)  # no halves of surrogate pairs
    about: Metadata = replace(metadata(PARTICLES, state.dim), dataset=draw(text), config=draw(text), seed=draw(st.integers(-1, 2**63 - 1)))
    b = state.boundary
    arrays = {name: np.asarray(getattr(b, name), np.float32) for name in ("pos", "vel", "normal", "friction", "restitution")}
    return Trajectory(
        about,
        (scale * rng.normal(size=shape)).astype(np.float32),
        rng.normal(size=shape).astype(np.float32),
        np.asarray(state.node_type, np.uint8),
        np.asarray(state.mass, np.float32),
        np.asarray(state.material_params, np.float32),
        replace(b, **arrays),
    )


# --- scenes -------------------------------------------------------------------------------------------------------------------------------


@st.composite
def body_scenes(draw: Callable[..., Any]) -> BodyScene:
    """Draw settings of small scenes of thrown bodies."""
    dim, materials = (
        draw(st.sampled_from([2, 3])),
        tuple(draw(st.lists(st.sampled_from(["sand", "snow", "elastomer"]), min_size=1, unique=True))),
    )
    low = draw(st.floats(0.0, 0.3))
    return BodyScene(
        bounds=((0.0, 1.0),) * dim,
        materials=materials,
        grid_spacing=draw(st.sampled_from([0.05, 0.1])),
        num_particles=draw(st.integers(1, 60)),
        density=dict.fromkeys(materials, 1000.0),
        gravity=(0.0,) * (dim - 1) + (draw(st.floats(-20.0, 0.0)),),
        max_bodies=draw(st.integers(1, 3)),
        max_obstacles=draw(st.integers(0, 2)),
        drop_height=(low, draw(st.floats(low, 0.5))),
        max_speed=draw(st.floats(0.0, 5.0)),
        resting_probability=draw(st.sampled_from([0.0, 0.5, 1.0])),
        sticky_probability=draw(st.floats(0.0, 0.5)),
        slip_probability=draw(st.floats(0.0, 0.5)),
    )


# --- graphs -------------------------------------------------------------------------------------------------------------------------------


@st.composite
def graphs(draw: Callable[..., Any], materials: tuple[str, ...] = PARTICLES, dim: int = 2) -> tuple[GraphBuilder, HeteroData]:
    """Draw a graph of any state, and its builder."""
    build = builder(materials, dim, history=2)
    return build, build(draw(states(materials=materials, dim=dim)).to_torch())


# --- files --------------------------------------------------------------------------------------------------------------------------------


def damages() -> st.SearchStrategy[Callable[[bytes], bytes]]:
    """Draw damage to the bytes of a file: a truncated end, a flipped bit or an overwritten block."""
    return st.one_of(
        st.floats(0.0, 1.0, exclude_max=True).map(lambda fraction: partial(truncated, fraction)),
        seeds.map(lambda seed: partial(flipped, seed)),
        seeds.map(lambda seed: partial(overwritten, seed)),
    )
