"""The material point solver compared with an independent engine: the example ``mpm99`` of the package taichi."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.schema import node_code
from gpe_pl.solvers.materials import Elastomer, Snow
from gpe_pl.solvers.mpm import MPM
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

pytestmark = pytest.mark.slow

NODES, DT, GRAVITY, DENSITY, MODULUS, XI = 128, 1e-4, 50.0, 1e3, 1e6, 10.0
"""Constants that the example fixes. Density and modulus have units 1000 times smaller, which does not change the motion."""
DX, JELLY, SNOW = 1 / NODES, 1, 2
SOURCE = "taichi 1.7, examples/simulation/mpm99"


@pytest.fixture
def reference(tmp_path):
    """Return positions after the example's substeps, in double precision [m]."""
    pytest.importorskip("taichi")

    def run(pos, vel, material, num_steps):
        file = tmp_path / "particles.npz"
        np.savez(file, pos=pos, vel=vel, material=material, num_steps=num_steps)
        environment = {**os.environ, "TI_ARCH": "x64", "TI_DEFAULT_FP": "64"}
        script = Path(__file__).with_name("mpm99_process.py")
        done = subprocess.run([sys.executable, script, file], env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return np.load(file.with_suffix(".npy"))

    return run


def two_blocks(seed=0):
    """Return 9000 jittered particles, the number and spacing of the example, in two blocks one cell apart [particle, 2]."""
    lattice = np.stack(np.meshgrid(np.arange(60), np.arange(75), indexing="ij"), axis=-1).reshape(-1, 2) + 0.5
    jitter = np.random.default_rng(seed).uniform(-0.25, 0.25, (2, *lattice.shape))
    left = np.array([0.5 - 31 * DX, 0.5]) + (lattice + jitter[0]) * DX / 2
    right = np.array([0.5 + 1 * DX, 0.52]) + (lattice + jitter[1]) * DX / 2
    return np.concatenate([left, right])


def ours(pos, vel, material, value, num_steps, **constants):
    """Return positions after as many frames of the example's time step [m]; the example's walls begin at the third node from each side."""
    count, bounds = len(pos), ((2 * DX, 1 - 2 * DX),) * 2
    solver = MPM(bounds=bounds, grid_spacing=DX, frame_dt=DT, materials=(material,), cfl=1.0, **constants)
    state = State(
        pos,
        vel,
        np.full(count, node_code(material), np.uint8),
        np.full(count, DENSITY * (DX / 2) ** 2),
        np.full((count, 1), value),
        Boundary.sample(domain_walls(bounds, 0.0), DX, 2),
        np.array([0.0, -GRAVITY]),
    )
    for _ in range(num_steps):
        state = solver.step(state)
    return state.pos


def compare(physics, got, expected, start, tolerances):
    """Compare centre of mass, spread (standard deviation per axis) and the median distance between twin particles, in grid cells."""
    values = {
        "centre of mass": np.abs(got.mean(axis=0) - expected.mean(axis=0)).max(),
        "spread": np.abs(got.std(axis=0) - expected.std(axis=0)).max(),
        "median particle": np.median(np.linalg.norm(got - expected, axis=1)),
    }
    for (name, value), tolerance in zip(values.items(), tolerances, strict=True):
        physics(f"difference of {name} in cells", value / DX, 0, tolerance, formula="same kernels", source=SOURCE, kind="absolute")
    assert np.abs(got - start).max() > 2 * DX


SNOW_CONSTANTS = Snow(
    youngs_modulus=MODULUS,
    poisson_ratio=0.2,
    density=DENSITY,
    critical_compression=2.5e-2,
    critical_stretch=4.5e-3,
    max_hardening=1e30,
    memory_cells=0,
)


@pytest.mark.long
def test_collision_of_snow_blocks(reference, physics):
    """Both solvers agree particle by particle in free fall, before the floor. Ours takes smaller substeps once the snow has hardened."""
    pos = two_blocks()
    vel = np.where(pos[:, :1] < 0.5, [[1.0, 0.0]], [[-1.0, 0.0]])
    expected = reference(pos, vel, SNOW, 300)
    got = ours(pos, vel, "snow", XI, 300, snow=SNOW_CONSTANTS)
    compare(physics, got, expected, pos, (0.01, 0.03, 0.03))


@pytest.mark.long
def test_collision_of_elastic_blocks(reference, physics):
    """The example's jelly is fixed-corotated with 0.3 E, ours neo-Hookean: equal for small strains only."""
    pos = two_blocks()
    vel = np.where(pos[:, :1] < 0.5, [[0.5, 0.0]], [[-0.5, 0.0]])
    expected = reference(pos, vel, JELLY, 400)
    got = ours(pos, vel, "elastomer", 0.3 * MODULUS, 400, elastomer=Elastomer(poisson_ratio=0.2, density=DENSITY))
    compare(physics, got, expected, pos, (1e-9, 0.05, 0.05))


def test_snow_on_the_floor(reference, physics):
    """A fall on the floor; unlike ours, the example lets particles sink into it by up to half a cell."""
    pos = two_blocks() - np.array([0.0, 0.45])
    vel = np.zeros_like(pos)
    expected = reference(pos, vel, SNOW, 1000)
    got = ours(pos, vel, "snow", XI, 1000, snow=SNOW_CONSTANTS)
    compare(physics, got, expected, pos, (0.3, 0.2, 0.5))
