"""The finite element solver compared with analytic results and scikit-fem; each check states its formula."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.geometry.meshing import triangulate
from gpe_pl.geometry.shapes import Bowl, Box, Polygon, Shape, Sphere, domain_walls, signed_distance
from gpe_pl.schema import STICKY, node_code
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.fem.elements import build_mesh
from gpe_pl.solvers.materials import lame_parameters
from gpe_pl.solvers.solid_scenes import SolidScene
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State, von_mises

pytestmark = pytest.mark.slow

DENSITY, GRAVITY = 1000.0, 9.81
KINDS = ("triangle", "quad", "tetrahedron")
UNIT = ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0))


def lattice(kind, counts, size, jitter=0.0):
    """Return nodes and cells of a block [0, size] with this number of lattice cells per axis; inner nodes are displaced at random."""
    dim = len(counts)
    axes = [np.linspace(0.0, s, n + 1) for s, n in zip(size, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    inside = np.all((points > 1e-9) & (points < np.array(size) - 1e-9), axis=1)
    points[inside] += np.random.default_rng(0).uniform(-jitter, jitter, (inside.sum(), dim)) * np.array(size) / np.array(counts)
    number = np.arange(len(points)).reshape([n + 1 for n in counts])
    site = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, dim)

    def at(*corner):
        return number[tuple((site + corner).T)]

    if kind == "quad":
        return points, np.stack([at(0, 0), at(1, 0), at(1, 1), at(0, 1)], axis=-1)
    if kind == "triangle":  # diagonals alternate, so that no direction is special
        odd = site.sum(axis=1)[:, None] % 2 == 1
        a, b, c, d = at(0, 0), at(1, 0), at(1, 1), at(0, 1)
        first = np.where(odd, np.stack([a, b, c], axis=-1), np.stack([a, b, d], axis=-1))
        return points, np.concatenate([first, np.where(odd, np.stack([a, c, d], axis=-1), np.stack([b, c, d], axis=-1))])
    cells = []
    for order in itertools.permutations(range(3)):
        path = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        if np.linalg.det(path[1:]) < 0:
            path[[1, 2]] = path[[2, 1]]
        cells.append(np.stack([at(*corner) for corner in path], axis=-1))
    return points, np.concatenate(cells)


def volumes(points, cells):
    corners = points[cells]
    if cells.shape[1] == 4 and points.shape[1] == 2:
        a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / math.factorial(points.shape[1])


def body(points, cells, modulus=1e6, *, velocity=None, boundary=None, gravity=None):
    count, dim = points.shape
    share = np.repeat(DENSITY * volumes(points, cells) / cells.shape[1], cells.shape[1])
    return State(
        points.copy(),
        np.zeros((count, dim)) if velocity is None else np.broadcast_to(velocity, (count, dim)).astype(float),
        np.full(count, node_code("solid"), np.uint8),
        np.bincount(cells.ravel(), share, minlength=count),
        np.full((count, 1), modulus),
        boundary if boundary is not None else Boundary.empty(dim),
        np.zeros(dim) if gravity is None else np.asarray(gravity, float),
        rest_pos=points.copy(),
        cells=cells,
    )


def block(kind, cells_per_side, size=0.2, origin=0.4, jitter=0.2, **options):
    dim = 3 if kind == "tetrahedron" else 2
    points, cells = lattice(kind, (cells_per_side,) * dim, (size,) * dim, jitter)
    return body(points + origin, cells, **options)


def solver(dim=2, **options):
    return FEM(**{"bounds": ((-2.0, 2.0),) * dim, "damping": 0.0, **options})


def run(fem, state, num_steps):
    for _ in range(num_steps):
        state = fem.step(state)
    return state


def forces(state, poisson_ratio=0.35):
    """Return internal forces [node, dim] in N from one tiny substep from rest."""
    h = 1e-9
    fem = solver(state.dim, frame_dt=h, poisson_ratio=poisson_ratio)
    still = replace(state, vel=np.zeros_like(state.pos), gravity=np.zeros(state.dim), boundary=Boundary.empty(state.dim))
    return fem.step(still).vel * state.mass[:, None] / h


def cauchy(deformation, modulus=1e6, poisson_ratio=0.35):
    """Return σ = μ/J (F Fᵀ - 1) + λ log J / J of a neo-Hookean solid, in 3D."""
    lam, mu = lame_parameters(modulus, poisson_ratio)
    full = np.eye(3)
    full[: len(deformation), : len(deformation)] = deformation
    ratio = np.linalg.det(full)
    return mu / ratio * (full @ full.T - np.eye(3)) + lam * math.log(ratio) / ratio * np.eye(3)


def components(stress, dim):
    return stress[[0, 0, 1, 2], [0, 1, 1, 2]] if dim == 2 else stress[np.triu_indices(3)]


SKEW = np.array([[1.2, 0.15, -0.05], [-0.1, 0.9, 0.1], [0.08, 0.02, 1.05]])


@pytest.mark.parametrize("kind", KINDS)
def test_patch(kind, physics):
    """An affine map of an irregular mesh: equilibrium inside and the same stress everywhere."""
    state = block(kind, 5)
    dim = state.dim
    mapped = replace(state, pos=state.pos @ SKEW[:dim, :dim].T)
    force = forces(mapped)
    outside = np.any((state.rest_pos < 0.4 + 1e-9) | (state.rest_pos > 0.6 - 1e-9), axis=1)
    residual = np.abs(force[~outside]).max() / np.abs(force[outside]).max()
    physics(
        "largest interior force / boundary force", residual, 1e-9, formula="f = 0 inside", source="Irons & Razzaque 1972", kind="at_most"
    )
    expected = components(cauchy(SKEW[:dim, :dim]), dim)
    stress = solver(dim, frame_dt=1e-12).step(mapped).stress
    scale = np.abs(expected).max()
    worst = max(np.abs(stress.cell - expected).max(), np.abs(stress.node - expected).max()) / scale
    physics(
        "largest deviation of cell and node stress", worst, 1e-6, formula="σ = μ/J (F Fᵀ - 1) + λ log J / J", source="exact", kind="at_most"
    )
    full = cauchy(SKEW[:dim, :dim])
    deviator = full - np.trace(full) / 3 * np.eye(3)
    physics(
        "von Mises stress",
        float(np.mean(von_mises(stress.cell))),
        math.sqrt(1.5 * np.sum(deviator**2)),
        1e-6,
        formula="√(3/2 s:s)",
        source="exact",
        unit="Pa",
    )


@pytest.mark.parametrize("kind", KINDS)
def test_small_uniaxial_tension(kind, physics):
    """Sides free of stress: σ/ε is E in 3D, E/(1 - ν²) in plane strain."""
    state = block(kind, 3)
    dim, nu, strain = state.dim, 0.35, 1e-6
    across = -strain * (nu / (1 - nu) if dim == 2 else nu)
    deformation = np.diag([1 + strain] + [1 + across] * (dim - 1))
    stress = solver(dim, frame_dt=1e-12).step(replace(state, pos=state.pos @ deformation)).stress.cell.mean(axis=0)
    expected = 1e6 / (1 - nu**2) if dim == 2 else 1e6
    physics("σ_xx/ε_xx", stress[0] / strain, expected, 1e-4, formula="E, in plane strain E/(1-ν²)", source="exact", unit="Pa")
    physics("σ_yy/σ_xx", stress[2 if dim == 2 else 3] / stress[0], 0.0, 1e-4, formula="0", source="exact", kind="absolute")


# --- dynamics -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_free_fall_is_exact(kind, physics):
    """Along the parabola, with one substep per frame or many, and however their number changes."""
    start = block(kind, 3, modulus=1e5)
    up = np.eye(start.dim)[-1]
    start = replace(start, gravity=-GRAVITY * up)
    for frame_dt in (1e-4, 1e-2):
        fem = solver(start.dim, frame_dt=frame_dt)
        assert (fem.step(start).num_substeps == 1) == (frame_dt == 1e-4)
        after, t = run(fem, start, 20), 20 * frame_dt
        formula, source = "y0 - g t²/2", "exact"
        fall = np.abs(after.pos - start.pos + GRAVITY * t * t / 2 * up).max()
        physics(
            f"largest error of y, frames of {frame_dt:g} s", fall, 0.0, 1e-11, formula=formula, source=source, unit="m", kind="absolute"
        )
        speed = np.abs(after.vel + GRAVITY * t * up).max()
        physics(
            f"largest error of v, frames of {frame_dt:g} s", speed, 0.0, 1e-11, formula="-g t", source=source, unit="m/s", kind="absolute"
        )
    state, middle = replace(tumbling(kind), gravity=-GRAVITY * up), []
    solvers = itertools.cycle([solver(state.dim, cfl=cfl) for cfl in (0.9, 0.4, 0.2)])
    for _ in range(20):
        middle.append(state.mass @ state.pos[:, -1] / state.mass.sum())
        state = next(solvers).step(state)
    acceleration = np.diff(middle, 2) / 5e-3**2
    worst = np.abs(acceleration / -GRAVITY - 1).max()
    physics(
        "acceleration of the centre of mass from three frames, relative error", worst, 1e-8, formula="g", source="exact", kind="at_most"
    )


def tumbling(kind, **options):
    """Return a body that spins, stretches and flies."""
    state = block(kind, 6, **options)
    arm = state.pos - state.pos.mean(axis=0)
    spin = np.zeros((state.dim, state.dim))
    spin[0, 1], spin[1, 0] = -8.0, 8.0
    stretch = np.diag([6.0, -4.0, 1.0][: state.dim])
    return replace(state, vel=arm @ (spin + stretch).T + 0.3)


def angular_momentum(state):
    return np.sum(state.mass * (state.pos[:, 0] * state.vel[:, 1] - state.pos[:, 1] * state.vel[:, 0]))


@pytest.mark.parametrize("kind", KINDS)
def test_momenta_of_a_free_body(kind, physics):
    """Elastic and viscous forces come in pairs and have no torque."""
    start = tumbling(kind)
    fem = solver(start.dim, damping=0.5)
    after = run(fem, start, 30)
    assert np.abs(after.vel - start.vel).max() > 0.5
    scale = np.sum(start.mass[:, None] * np.abs(start.vel))
    change = np.abs(after.mass @ after.vel - start.mass @ start.vel).max() / scale
    physics("relative change of Σ m v", change, 1e-12, formula="constant", source="exact", kind="at_most")
    change = abs(angular_momentum(after) / angular_momentum(start) - 1)
    physics("relative change of Σ m x × v", change, 1e-11, formula="constant", source="exact", kind="at_most")


@pytest.mark.parametrize("kind", KINDS)
def test_energy_of_a_free_body(kind, physics):
    """Without damping and contact, over about 25 periods of the lowest mode; velocities lag half a substep behind, so the energy also oscillates."""
    state = tumbling(kind)
    fem = solver(state.dim)
    energies = []
    for _ in range(100):
        energies.append(fem.energy(state))
        state = fem.step(state)
    drift = abs(np.mean(energies[-25:]) / np.mean(energies[:25]) - 1)
    physics("relative drift of the mean energy", drift, 0.01, formula="constant", source="exact", kind="at_most")
    swing = np.abs(np.array(energies) / np.mean(energies) - 1).max()
    physics("largest relative deviation from the mean", swing, 0.05, formula="O(h ω)", source="symplectic Euler", kind="at_most")


def bar_frequency(kind, cells, fem_options=None, damping=0.0):
    """Return first longitudinal frequency and decay rate of a free-free bar of unit length and E = 1 MPa, ν = 0, from a fit to the motion of its mode."""
    dim = 3 if kind == "tetrahedron" else 2
    width = 1.0 / cells * 3
    points, mesh = lattice(kind, (cells, *(3,) * (dim - 1)), (1.0, *(width,) * (dim - 1)))
    state = body(points, mesh)
    shape = np.cos(math.pi * state.pos[:, 0])
    state = replace(state, vel=0.01 * shape[:, None] * np.eye(dim)[0])
    fem = solver(dim, poisson_ratio=0.0, damping=damping, frame_dt=1e-3, **(fem_options or {}))
    signal = []
    for _ in range(127):  # two periods
        signal.append(np.sum(state.mass * shape * state.vel[:, 0]))
        state = fem.step(state)
    s = np.array(signal)
    # s(t + h) = 2 e^(-δh) cos(ωh) s(t) - e^(-2δh) s(t - h)
    a, b = np.linalg.lstsq(np.stack([s[1:-1], -s[:-2]], axis=-1), s[2:], rcond=None)[0]
    decay = -math.log(b) / 2 / 1e-3
    return math.acos(a / 2 / math.sqrt(b)) / 1e-3 / (2 * math.pi), decay, state


@pytest.mark.parametrize("kind", KINDS)
def test_bar_frequency(kind, physics):
    expected = math.sqrt(1e6 / DENSITY) / 2
    values = {n: bar_frequency(kind, n)[0] for n in (10, 20, 40)}
    physics("first longitudinal frequency, 40 cells", values[40], expected, 0.003, formula="√(E/ρ)/(2L)", source="exact, ν = 0", unit="Hz")
    order = math.log2(abs(values[10] - expected) / abs(values[20] - expected))
    physics("order of its error in the cell size", order, 1.7, formula="2", source="linear elements", kind="at_least")


@pytest.mark.parametrize("kind", KINDS)
def test_damping_of_the_bar(kind, physics):
    """``2η F Ė`` makes the mode of wave number k decay as exp(-η k² t / ρ)."""
    _, decay, state = bar_frequency(kind, 20, damping=0.5)
    mesh = build_mesh(state.rest_pos, state.cells, state.mass)
    viscosity = 0.5 * math.sqrt(1e6 / mesh.scale)  # damping √((2μ + d λ)/s), here with λ = 0 and 2μ = E
    physics("decay rate", decay, viscosity * math.pi**2 / DENSITY, 0.03, formula="η k²/ρ", source="Kelvin-Voigt bar", unit="1/s")


def test_order_in_time(physics):
    """Against a run with small substeps. The stored velocity lags half a substep behind, an error of first order unless the start is free of force."""
    start = tumbling("triangle")
    ends = {cfl: run(solver(cfl=cfl), start, 4).pos for cfl in (0.8, 0.4, 0.2, 0.0125)}
    errors = [np.abs(ends[cfl] - ends[0.0125]).max() for cfl in (0.8, 0.4, 0.2)]
    physics("order of the error in the substep", math.log2(errors[1] / errors[2]), 1.8, formula="2", source="leapfrog", kind="at_least")


# --- stiffness ------------------------------------------------------------------------------------------------------------------------------


def stiffness(state, poisson_ratio):
    """Return ∂(-f)/∂x by central differences of the solver's forces."""
    count, dim, step = state.num_nodes, state.dim, 1e-6
    matrix = np.empty((count * dim, count * dim))
    for k in range(count * dim):
        shift = np.zeros(count * dim)
        shift[k] = step
        shift = shift.reshape(count, dim)
        ahead, behind = replace(state, pos=state.pos + shift), replace(state, pos=state.pos - shift)
        matrix[:, k] = (forces(behind, poisson_ratio) - forces(ahead, poisson_ratio)).ravel() / (2 * step)
    return matrix


@pytest.mark.parametrize("deformed", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_substep_is_stable(kind, deformed, physics):
    """h ω_max <= 2 with the true largest frequency of the mesh, and not much less."""
    state = block(kind, 3)
    if deformed:
        state = replace(state, pos=state.pos @ SKEW[: state.dim, : state.dim].T)
    roots = np.sqrt(np.repeat(state.mass, state.dim))
    omega = math.sqrt(np.linalg.eigvalsh(stiffness(state, 0.35) / roots / roots[:, None])[-1])
    h = solver(state.dim, cfl=0.999).substep(state) / 0.999
    formula, source = "h ω_max <= 2", "Irons & Treharne 1971"
    physics("bound of the substep × highest frequency", h * omega, 2.0, formula=formula, source=source, kind="at_most")
    physics(
        "bound of the substep × highest frequency",
        h * omega,
        1.0 if kind == "tetrahedron" else 1.3,
        formula=formula,
        source=source,
        kind="at_least",
    )


def cantilever(kind, nx, ny):
    """Return the tip deflection in m under its weight of a bar of 1 m × 0.1 m clamped at the left, linear, ν = 0.35, E = 10 MPa."""
    points, cells = lattice(kind, (nx, ny), (1.0, 0.1))
    state = body(points, cells, 1e7)
    free = np.repeat(points[:, 0] > 1e-9, 2)
    load = np.stack([np.zeros(len(points)), -GRAVITY * state.mass], axis=-1).ravel()
    shift = np.zeros(2 * len(points))
    shift[free] = np.linalg.solve(stiffness(state, 0.35)[np.ix_(free, free)], load[free])
    return points, cells, shift.reshape(-1, 2)


@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_cantilever_of_scikit_fem(kind, physics):
    """The same mesh and load in an independent library."""
    skfem = pytest.importorskip("skfem")
    helpers = pytest.importorskip("skfem.helpers")

    points, cells, shift = cantilever(kind, 40, 4)
    mesh = (skfem.MeshTri if kind == "triangle" else skfem.MeshQuad)(points.T.copy(), cells.T.copy())
    element = skfem.ElementVector(skfem.ElementTriP1() if kind == "triangle" else skfem.ElementQuad1())
    basis = skfem.Basis(mesh, element, intorder=2)
    lam, mu = lame_parameters(1e7, 0.35)

    @skfem.BilinearForm
    def elasticity(u, v, _):
        strain, virtual = helpers.sym_grad(u), helpers.sym_grad(v)
        return 2 * mu * helpers.ddot(strain, virtual) + lam * helpers.trace(strain) * helpers.trace(virtual)

    @skfem.LinearForm
    def weight(v, _):
        return -DENSITY * GRAVITY * v[1]

    clamped = basis.get_dofs(lambda x: x[0] < 1e-9)
    solution = skfem.solve(*skfem.condense(elasticity.assemble(basis), weight.assemble(basis), D=clamped))
    expected = solution[basis.nodal_dofs].T
    tip = points[:, 0] > 1 - 1e-9
    # lumped weights differ from consistent ones at the ends only
    physics(
        "mean tip deflection, 40 × 4 cells",
        shift[tip, 1].mean(),
        expected[tip, 1].mean(),
        1e-3,
        formula="K u = f",
        source="scikit-fem",
        unit="m",
    )
    worst = np.abs(shift - expected).max() / np.abs(expected).max()
    physics("largest relative difference of u", worst, 1e-3, formula="K u = f", source="scikit-fem", kind="at_most")


@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_cantilever_of_beam_theory(kind, physics):
    points, _, shift = cantilever(kind, 80, 8)
    plane, height = 1e7 / (1 - 0.35**2), 0.1
    bending = 12 * DENSITY * GRAVITY * height / (8 * plane * height**3)
    shear = DENSITY * GRAVITY / (2 * 5 / 6 * 1e7 / (2 * 1.35))
    tip = shift[points[:, 0] > 1 - 1e-9, 1].mean()
    formula = "ρ g H L⁴/(8 E' I) + ρ g L²/(2 κ G)"
    physics("tip deflection, 80 × 8 cells", tip, -bending - shear, 0.05, formula=formula, source="Timoshenko beam, E' = E/(1-ν²)", unit="m")


# --- contact --------------------------------------------------------------------------------------------------------------------------------


def floor(dim, friction=0.0):
    return Boundary.sample(domain_walls(((-2.0, 2.0),) * (dim - 1) + ((0.0, 2.0),), friction)[-2:-1], 0.1, dim)


@pytest.mark.parametrize("kind", KINDS)
def test_bounce(kind, physics):
    """A block dropped onto a frictionless floor: never higher, never more energy, and contact itself takes little."""
    dim = 3 if kind == "tetrahedron" else 2
    up = np.eye(dim)[-1]
    state = block(kind, 6, origin=0.05, boundary=floor(dim), gravity=-GRAVITY * up, velocity=-2.0 * up)
    fem = solver(dim)
    energies, heights = [fem.energy(state)], []
    for _ in range(120):
        state = fem.step(state)
        energies.append(fem.energy(state))
        heights.append(state.mass @ state.pos[:, -1] / state.mass.sum())
    drop = energies[0] / (state.mass.sum() * GRAVITY)
    physics("largest height of the centre of mass", max(heights), drop, formula="v²/(2g) + y", source="energy", unit="m", kind="at_most")
    physics("largest energy / initial energy", max(energies) / energies[0], 1.001, formula="1", source="energy", kind="at_most")
    physics("final energy / initial energy", energies[-1] / energies[0], 0.8, formula="1", source="elastic impact", kind="at_least")
    assert max(heights) > 0.05 + heights[0]  # it did bounce


def slide(kind, slope, friction, surface="wall"):
    """Return acceleration along and displacement down a slope of a block in 0.3 s, in m/s² and m."""
    dim = 3 if kind == "tetrahedron" else 2
    points, cells = lattice(kind, (8, *(4,) * (dim - 1)), (0.2, *(0.08,) * (dim - 1)), 0.2)
    angle = math.radians(slope)
    down, normal = np.eye(dim)[0], np.eye(dim)[-1]
    gravity = GRAVITY * (math.sin(angle) * down - math.cos(angle) * normal)
    if surface == "ramp":  # the same with an inclined polygon under vertical gravity
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        corners = np.array([[-1.5, -0.5], [1.5, -0.5], [1.5, 0.0], [-1.5, 0.0]]) @ turn.T
        ramp = Polygon(tuple(map(tuple, corners.tolist())), friction)
        boundary, gravity = Boundary.sample((ramp,), 0.1, 2), np.array([0.0, -GRAVITY])
        points, down = points @ turn.T, turn @ down
    else:
        boundary = floor(dim, friction)
    fem = solver(dim, damping=0.5)
    state = run(fem, body(points, cells, 1e6, boundary=boundary, gravity=gravity), 20)
    speeds, start = [], state.mass @ state.pos @ down / state.mass.sum()
    for _ in range(60):
        state = fem.step(state)
        speeds.append(state.mass @ state.vel @ down / state.mass.sum())
    return np.polyfit(fem.frame_dt * np.arange(60), speeds, 1)[0], state.mass @ state.pos @ down / state.mass.sum() - start


@pytest.mark.parametrize(("kind", "surface"), [("triangle", "wall"), ("quad", "ramp"), ("tetrahedron", "wall")])
def test_block_on_a_slope(kind, surface, physics):
    angle, friction = 30.0, 0.3
    expected = GRAVITY * (math.sin(math.radians(angle)) - friction * math.cos(math.radians(angle)))
    acceleration, _ = slide(kind, angle, friction, surface)
    physics("acceleration", acceleration, expected, 0.02, formula="g (sin θ - μ cos θ)", source="Coulomb", unit="m/s²")
    for coefficient in (0.65, STICKY):  # tan 30° = 0.577
        _, moved = slide(kind, angle, coefficient, surface)
        physics(
            f"creep at μ = {coefficient:g} in 0.3 s",
            abs(moved),
            1e-4,
            formula="0 for tan θ < μ",
            source="Coulomb",
            unit="m",
            kind="at_most",
        )


def test_hertz_line_contact(physics):
    """A disc pressed on a rigid frictionless plane by its weight, at rest; half-width and load from the nodal reactions, ∫ p x² = P b²/4."""
    radius, modulus, nu, spacing = 0.1, 1e7, 0.35, 0.0025
    angle = 2 * math.pi * np.arange(400) / 400
    circle = radius * np.stack([np.cos(angle), 1.0 + np.sin(angle)], axis=-1)
    points, cells = triangulate([circle], spacing, np.random.default_rng(0))
    gravity = np.array([0.0, -1200.0])
    state = body(points, cells, modulus, boundary=floor(2), gravity=gravity)
    fem = FEM(bounds=((-1.0, 1.0), (0.0, 1.0)), frame_dt=2e-4, poisson_ratio=nu, damping=0.0)
    for _ in range(400):
        state = fem.step(state)
        state = replace(state, vel=0.95 * state.vel)
    reaction = -(forces(state, nu) + state.mass[:, None] * gravity)[:, 1]
    touching = state.pos[:, 1] < 1e-9
    assert touching.sum() >= 8
    x, load = state.pos[touching, 0], reaction[touching]
    total, stiff = load.sum(), modulus / (1 - nu**2)
    physics("load of the nodes in contact", total, -gravity[1] * state.mass.sum(), 0.01, formula="m g", source="equilibrium", unit="N/m")
    expected = math.sqrt(4 * total * radius / (math.pi * stiff))
    width = 2 * math.sqrt(load @ (x - load @ x / total) ** 2 / total)
    physics("half-width of the contact", width, expected, 0.1, formula="√(4 P R/(π E*))", source="Johnson 1985, section 4.2", unit="m")
    order = np.argsort(x)
    share = np.gradient(x[order])
    middle = np.abs(x[order]) < 0.4 * expected
    # mean of √(1 - (x/b)²) over the nodes in the middle
    shape = np.mean(np.sqrt(1 - (x[order][middle] / expected) ** 2))
    pressure = np.mean(load[order][middle] / share[middle]) / shape
    physics(
        "largest pressure",
        pressure,
        2 * total / (math.pi * expected),
        0.1,
        formula="2P/(π b)",
        source="Johnson 1985, section 4.2",
        unit="Pa",
    )


@pytest.mark.parametrize(("kind", "modulus"), [("triangle", 5e5), ("triangle", 1e7), ("quad", 5e5), ("tetrahedron", 5e5)])
def test_no_node_inside_an_obstacle(kind, modulus, physics):
    """Random bodies thrown at up to 10 m/s per axis onto random obstacles, at the end of every frame."""
    dim = 3 if kind == "tetrahedron" else 2
    gravity = (0.0,) * (dim - 1) + (-GRAVITY,)
    scene = SolidScene(bounds=UNIT[:dim], cell=kind, num_cells=200, max_speed=10.0, gravity=gravity)
    fem = FEM(bounds=scene.bounds)
    deepest, gain = 0.0, 0.0
    for seed in range(4):
        state = scene.sample({"solid": modulus}, seed)
        start = fem.energy(state)
        for _ in range(40):
            state = fem.step(state)
            deepest = max(deepest, -float(signed_distance(state.boundary.shapes, state.pos).min()))
            gain = max(gain, fem.energy(state) / start)
    physics("deepest node", deepest, 1e-9, formula="0", source="exact", unit="m", kind="at_most")
    physics("largest energy / initial energy", gain, 1.001, formula="1", source="energy", kind="at_most")


OBSTACLES: dict[tuple[str, int], Shape] = {  # the solver samples the bowl on a grid
    ("ball", 2): Sphere((0.45, 0.2), 0.1, 0.3),
    ("ball", 3): Sphere((0.45, 0.5, 0.2), 0.1, 0.3),
    ("box", 2): Box((0.45, 0.15), (0.55, 0.3), 0.3),
    ("box", 3): Box((0.45, 0.4, 0.15), (0.55, 0.6, 0.3), 0.3),
    ("bowl", 2): Bowl((0.5, 0.5), 0.48, 0.3),
    ("bowl", 3): Bowl((0.5, 0.5, 0.5), 0.48, 0.3),
}


@pytest.mark.parametrize(("name", "dim"), OBSTACLES)
def test_every_kind_of_obstacle(name, dim, physics):
    """A block falls on it, and touches it without getting inside."""
    shape, up = OBSTACLES[name, dim], np.eye(dim)[-1]
    boundary = Boundary.sample((*domain_walls(UNIT[:dim], 0.3), shape), 0.1, dim)
    kind = "triangle" if dim == 2 else "tetrahedron"
    state = block(kind, 4, boundary=boundary, gravity=-GRAVITY * up, velocity=-2.0 * up, modulus=5e5)
    fem, deepest = FEM(bounds=UNIT[:dim]), -1.0
    for _ in range(60):
        state = fem.step(state)
        deepest = max(deepest, -float(shape.signed_distance(state.pos).min()))
    assert deepest > -1e-4
    if name == "bowl":
        limit, formula, source = dim / 64**2 / 8 / 0.48, "d h²/(8 R)", "interpolation on a grid of h = 1/64 m"
    else:
        limit, formula, source = 1e-9, "0", "exact"
    physics("deepest node", deepest, limit, formula=formula, source=source, unit="m", kind="at_most")
