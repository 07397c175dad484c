"""The constants of the constitutive law can be learned from frames of the solver, as functions of Young's modulus."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.bodies import bounce_height, deformation_ratio
from gpe_pl.config.datasets import dataset
from gpe_pl.data.ground_truth import generate_trajectory
from gpe_pl.metrics.bodies import Bodies
from gpe_pl.nn.elastic_bodies import WALL_DAMPING
from gpe_pl.nn.elastic_motion import Cells, Constants, Walls, elastic_motion
from gpe_pl.rollout.loop import rollout
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.mpm.solver import MPM
from gpe_pl.solvers.scenes import describe
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.strain import lame_parameters

SOFT, STIFF = 1e6, 4e6
FRAMES, STEPS = 4, 300


@pytest.mark.long
def test_constants_are_recovered_at_two_moduli() -> None:
    """Bodies that were strained by 2 % swing freely. Training begins at constants that are wrong by factors of up to 20."""
    spec = dataset("data=fem", "size=tiny", "data.num_frames=4", "data.scene.num_cells=60")
    assert isinstance(spec.solver, FEM)
    truth = generate_trajectory(spec, split="train", index=0)
    start, dt = truth.state(0), truth.metadata.frame_dt
    assert start.cells is not None and start.rest_pos is not None
    strain = np.array([[1.02, 0.01], [0.0, 0.99]])
    centre = np.asarray(spec.solver.bounds).mean(axis=1)
    start = replace(
        start, pos=(start.rest_pos - start.rest_pos.mean(axis=0)) @ strain.T + centre, vel=0.0 * start.vel, gravity=0.0 * start.gravity
    )
    start = replace(start, boundary=Boundary.sample((), truth.metadata.spacing, 2), stress=None)
    rest, nodes, mass = (torch.from_numpy(x) for x in (start.rest_pos, start.cells, start.mass))
    cells, unit = Cells.of(nodes, rest, mass / mass.mean(), None), float(mass.mean()) / dt**2
    walls = Walls(torch.zeros_like(rest), torch.zeros_like(mass), torch.zeros_like(mass))
    samples: list[tuple[Tensor, ...]] = []
    for modulus, feature in ((SOFT, -1.0), (STIFF, 1.0)):
        state = replace(start, material_params=torch.full((len(mass), 1), modulus, dtype=torch.float64).numpy())
        for _ in range(FRAMES):
            after = spec.solver.step(state)
            samples.append(tuple(torch.as_tensor(x) for x in (state.pos, dt * state.vel, after.pos - state.pos, [[feature]])))
            state = after
    constants = Constants(1).double()
    optimizer = torch.optim.Adam(constants.parameters(), lr=0.02)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, STEPS)
    for _ in range(STEPS):
        optimizer.zero_grad()
        loss = torch.zeros((), dtype=torch.float64)
        for pos, vel, way, parameter in samples:
            law = tuple(constant.expand(len(nodes)) for constant in constants(parameter.double()))
            moved, *_ = elastic_motion(pos, vel, torch.zeros_like(pos), mass / mass.mean(), law, cells, walls)  # type: ignore[arg-type]
            loss = loss + ((moved - way).square().sum() / (way - vel).square().sum())
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    found = {}
    for modulus, value in ((SOFT, -1.0), (STIFF, 1.0)):
        expected = lame_parameters(modulus, spec.solver.poisson_ratio)
        lam, mu, _ = (float(c) * unit for c in constants(torch.tensor([[value]], dtype=torch.float64)))
        found[modulus] = lam, mu
        assert (lam, mu) == pytest.approx(expected, rel=0.2)  # the solver's integration in time is another one
    ratios = [stiff / soft for stiff, soft in zip(found[STIFF], found[SOFT], strict=True)]
    assert ratios == pytest.approx([STIFF / SOFT] * 2, rel=0.1), ratios


def test_without_viscosity_its_constant_stays_negligible() -> None:
    constants = Constants(1, viscous=False)
    lam, mu, eta = constants(torch.tensor([[2.0]]))
    (lam + mu + eta).sum().backward()  # type: ignore[no-untyped-call]
    assert eta.item() < 1e-7 < lam.item()
    for values in constants.logarithm.values():
        assert values.grad is not None and values.grad[:2].all() and not values.grad[2].any()
    assert Constants(1)(torch.zeros(1, 1))[2].item() == pytest.approx(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("modulus", [3e4, 1.3e5, 6e5])
def test_with_the_solvers_constants_a_block_bounces_as_in_the_material_point_method(modulus: float) -> None:
    """The layer of the wall, with about half the body's stiffness, makes the bounce. Without it, blocks bounce a third lower, and stiff ones ring."""
    spec = dataset("data=elastomer", "size=small")
    solver, spacing, history, num_frames = cast(MPM, spec.solver), spec.scene.spacing, 1, 80
    start = scenes.dropped_block(spec, modulus, 12, 10, 0.1, 2.0)
    metadata = describe(spec.scene, solver.frame_dt)
    truth = rollout(solver, start, history + num_frames, metadata).frames(history)
    assert truth.rest_pos is not None and truth.cells is not None
    rest, nodes, mass, first = (torch.from_numpy(np.array(x)) for x in (truth.rest_pos, truth.cells, truth.mass, truth.vel[0]))
    dt, unit = solver.frame_dt, float(mass.double().mean()) / solver.frame_dt**2
    mass = mass.double() / mass.double().mean()
    cells = Cells.of(nodes.long(), rest.double(), mass, None)
    lam, mu = (value / unit for value in lame_parameters(modulus, solver.elastomer.poisson_ratio))
    viscosity = 0.02 * spacing * math.sqrt(modulus * solver.elastomer.density) / (unit * dt)
    law = tuple(torch.full((len(nodes),), value, dtype=torch.float64) for value in (lam, mu, viscosity))
    normal = torch.zeros_like(rest, dtype=torch.float64)
    normal[:, 1] = 1.0
    stiffness = 0.55 * (lam + 2.0 * mu) / 2.3
    bounces = {}
    for name, layer in {"layer": [2.3 * spacing, stiffness, 2.0 * WALL_DAMPING * math.sqrt(stiffness)], "plane": [0.0, 0.0, 0.0]}.items():
        pos, vel = torch.from_numpy(truth.pos[0].astype(np.float64)), dt * first.double()
        gravity = torch.tensor([0.0, -9.81 * dt**2], dtype=torch.float64).expand_as(pos)
        path = [pos]
        for _ in range(num_frames):
            distance = pos[:, 1] - (0.0 if name == "layer" else spacing)
            walls = Walls(normal, distance, torch.full_like(mass, scenes.COULOMB), torch.tensor([layer]).double().expand(len(mass), 3))
            moved, vel, _ = elastic_motion(pos, vel, gravity, mass, law, cells, walls)  # type: ignore[arg-type]
            pos = pos + moved
            path.append(pos)
        own = replace(truth, pos=torch.stack(path).numpy())
        bodies = Bodies.of(truth)
        assert bodies is not None
        bounces[name] = bounce_height(bodies, own) / bounce_height(bodies, truth)
        assert name == "plane" or 0.8 < deformation_ratio(bodies, own) < 1.25
    assert 0.85 < bounces["layer"] < 1.2 and bounces["plane"] < 0.8, bounces
