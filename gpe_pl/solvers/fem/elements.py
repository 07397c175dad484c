"""Finite elements of a compressible neo-Hookean solid: linear triangles and bilinear quadrilaterals in plane strain, linear tetrahedra in 3D.

Energy per reference volume, first Piola-Kirchhoff and Cauchy stress (Bonet & Wood 2008, section 6.4.3)::

    Ψ = μ/2 (tr FᵀF - 3) - μ log J + λ/2 (log J)²,   P = μ F + (λ log J - μ)/J cof F,   σ = P Fᵀ / J

Below ``J = SMALLEST_RATIO`` the logarithm is replaced by its tangent, so a finite, conservative force acts on a crushed or inverted cell. An optional viscous
stress ``2η F Ė`` is added to P, with E the Green-Lagrange strain. It is objective and never adds energy.

A substep is stable while ``h² ω² + 2 h Γ <= 4``, with ω the highest frequency and Γ the highest damping rate of the mesh. The stiffness matrix is
``Σ V Gᵀ (∂P/∂F) G`` over the quadrature points, with G the gradient, so ``ω² <= s A`` and ``Γ <= s 2η |F|²``. The rest configuration fixes s, the largest
eigenvalue of the Laplacian ``Σ V Gᵀ G`` in the metric of the nodal masses. A is the largest eigenvalue of ``∂P/∂F`` in any cell of the present mesh.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numpy as np
from numba import njit
from scipy.sparse import csr_array
from scipy.sparse.linalg import eigsh

from gpe_pl.rollout.loop import SimulationError
from gpe_pl.trajectory.cells import bodies
from gpe_pl.trajectory.state import Stress
from gpe_pl.trajectory.strain import SMALLEST_RATIO, deformation_gradients, neo_hookean_density, shape_gradients

_LOG_SMALLEST = math.log(SMALLEST_RATIO)

CELLS = {(2, 3): "triangle", (2, 4): "quad", (3, 4): "tetrahedron"}
"""Kinds of cells by (dim, corners)."""


@dataclass(frozen=True)
class Mesh:
    """Rest configuration as arrays for the compiled kernels.

    Attributes:
        kind: kind of cell, one of ``CELLS``.
        cells: node indices of the corners [cell, corner].
        gradient: shape function gradients at the quadrature points [cell, point, corner, dim] in 1/m.
        weight: rest volume of each quadrature point [cell, point] in m^dim.
        scale: bound s of ω² per modulus, in m/kg.
        reach: half the smallest height of a cell [m]; the largest distance that a node may move in one substep.
        edges: surface edges in 2D [edge, 2], the body on their left; empty in 3D.
        averaging: weights [node, cell] that average cell values around each node by rest volume.
    """

    kind: str
    cells: np.ndarray
    gradient: np.ndarray
    weight: np.ndarray
    scale: float
    reach: float
    edges: np.ndarray
    averaging: csr_array


log = logging.getLogger(__name__)

MAX_CACHED = 512
"""Largest number of meshes kept in memory; one of 400 triangles takes about 0.1 MB. Training with targets of the solver returns to the meshes of all scenes."""


def build_mesh(rest_pos: np.ndarray, cells: np.ndarray, mass: np.ndarray) -> Mesh:
    """Prepare a mesh; the result for the same arrays is cached.

    Args:
        rest_pos: positions at rest [node, dim] in m.
        cells: node indices of the corners [cell, corner], positively oriented.
        mass: lumped masses [node] in kg.

    Raises:
        SimulationError: with reason ``input``, if cells are of another kind than ``CELLS``, a cell repeats a node or has one that does not exist, a node
            belongs to no cell, or the volume of a cell is not positive.
    """
    rest_pos, mass = np.array(rest_pos, dtype=np.float64, order="C"), np.array(mass, dtype=np.float64, order="C")
    cells = np.asarray(cells)
    if (
        rest_pos.ndim != 2
        or cells.ndim != 2
        or not np.issubdtype(cells.dtype, np.integer)
        or (rest_pos.shape[1], cells.shape[1]) not in CELLS
    ):
        raise SimulationError(
            f"cells {cells.dtype}{list(cells.shape)} of nodes {list(rest_pos.shape)} are none of {', '.join(CELLS.values())}",
            reason="input",
        )
    cells = np.array(cells, dtype=np.int64, order="C")
    return _build_mesh(rest_pos.tobytes(), rest_pos.shape, cells.tobytes(), cells.shape, mass.tobytes())


@lru_cache(maxsize=MAX_CACHED)
def _build_mesh(rest_bytes: bytes, rest_shape: tuple[int, int], cell_bytes: bytes, cell_shape: tuple[int, int], mass_bytes: bytes) -> Mesh:
    rest_pos = np.frombuffer(rest_bytes).reshape(rest_shape)
    cells = np.frombuffer(cell_bytes, dtype=np.int64).reshape(cell_shape)
    mass = np.frombuffer(mass_bytes)
    num_nodes, dim = rest_shape
    kind = CELLS[dim, cell_shape[1]]
    _require_sound(cells, num_nodes)
    if (count := len(bodies(cells, num_nodes))) > 1:  # once per mesh, as the result is cached
        log.warning(
            "the mesh has %d bodies, which the finite element solver lets pass through each other: contact between them is not computed",
            count,
        )
    gradient, weight = shape_gradients(rest_pos[cells])
    flat = ~np.all(weight > 0, axis=1)
    if np.any(flat) or not np.all(np.isfinite(gradient)):
        cell = int(np.argmax(flat))
        raise SimulationError(
            f"cell {cell} has no positive volume at rest; its nodes are {cells[cell].tolist()}", reason="input", node=int(cells[cell, 0])
        )
    volume = weight.sum(axis=1)
    around = np.bincount(cells.ravel(), np.repeat(volume, cells.shape[1]), minlength=num_nodes)
    averaging = csr_array(
        (np.repeat(volume, cells.shape[1]) / around[cells].ravel(), (cells.ravel(), np.repeat(np.arange(len(cells)), cells.shape[1]))),
        shape=(num_nodes, len(cells)),
    )
    return Mesh(
        kind,
        cells,
        gradient,
        weight,
        _largest_eigenvalue(cells, gradient, weight, mass),
        0.5 / float(np.sqrt(np.max(np.sum(gradient**2, axis=-1)))) if len(cells) else math.inf,
        _surface_edges(cells) if dim == 2 else np.empty((0, 2), dtype=np.int64),
        averaging,
    )


def _require_sound(cells: np.ndarray, num_nodes: int) -> None:
    """Check that the corners of every cell are different, existing nodes, and that every node belongs to a cell."""
    wrong = np.any((cells < 0) | (cells >= num_nodes), axis=1)
    wrong |= np.any(np.diff(np.sort(cells, axis=1), axis=1) == 0, axis=1)
    if np.any(wrong):
        cell = int(np.argmax(wrong))
        raise SimulationError(f"cell {cell} has nodes {cells[cell].tolist()}; they must be different and below {num_nodes}", reason="input")
    used = np.bincount(cells.ravel(), minlength=num_nodes)
    if num_nodes and not np.all(used):
        node = int(np.argmin(used))
        raise SimulationError(f"node {node} belongs to no cell", reason="input", node=node)


def _largest_eigenvalue(cells: np.ndarray, gradient: np.ndarray, weight: np.ndarray, mass: np.ndarray) -> float:
    """Return the largest eigenvalue of the Laplacian in the metric of the masses."""
    if len(cells) == 0:
        return 0.0
    per_cell = np.einsum("cq,cqad,cqbd->cab", weight, gradient, gradient) / np.sqrt(mass[cells][:, :, None] * mass[cells][:, None, :])
    count = cells.shape[1]
    rows, columns = np.repeat(cells, count, axis=1).ravel(), np.tile(cells, (1, count)).ravel()
    laplacian = csr_array((per_cell.ravel(), (rows, columns)), shape=(len(mass), len(mass)))
    if len(mass) < 50:
        return float(np.linalg.eigvalsh(laplacian.toarray())[-1])
    start = np.cos(np.arange(len(mass)) ** 2)  # reproducible, and without symmetry
    return float(eigsh(laplacian, k=1, which="LA", v0=start, tol=1e-9, return_eigenvectors=False)[0])


def _surface_edges(cells: np.ndarray) -> np.ndarray:
    """Return edges that belong to exactly one plane cell [edge, 2], with the body on their left."""
    count = cells.shape[1]
    edges = np.concatenate([cells[:, [k, (k + 1) % count]] for k in range(count)])
    _, first, times = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return np.ascontiguousarray(edges[np.sort(first[times == 1])])


def cauchy_stress(mesh: Mesh, pos: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> Stress:
    """Return the elastic Cauchy stress [Pa]; where J is below ``SMALLEST_RATIO``, it is relative to that fraction of the rest volume.

    Args:
        mesh: rest configuration.
        pos: positions [node, dim] in m.
        lam, mu: Lamé parameters [cell] in Pa.

    Returns:
        Cell stress, averaged over the quadrature points, and node stress, averaged over the cells around the node; both averages by rest volume.
    """
    dim = pos.shape[1]
    cell = np.zeros((len(mesh.cells), 6))
    _average_stress(np.asarray(pos, dtype=np.float64), mesh.cells, mesh.gradient, mesh.weight, lam, mu, cell)
    if dim == 2:
        cell = np.array(cell[:, [0, 1, 3, 5]])
    return Stress(mesh.averaging @ cell, cell)


def elastic_energy(mesh: Mesh, pos: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> float:
    """Return the stored energy ∫ Ψ in J (per metre of depth in 2D); arguments as in ``cauchy_stress``."""
    deformation = deformation_gradients(pos[mesh.cells], mesh.gradient)
    return float(np.sum(neo_hookean_density(deformation, lam, mu) * mesh.weight))


# --- kernels --------------------------------------------------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy")
@no_type_check
def _volume_response(ratio, lam, mu):
    """Return the first and second derivative by J of ``-μ log J + λ/2 (log J)²``."""
    if ratio > SMALLEST_RATIO:
        slope = 1.0 / ratio
        excess = lam * math.log(ratio) - mu
        return excess * slope, (lam - excess) * slope * slope
    slope = 1.0 / SMALLEST_RATIO
    return (lam * (_LOG_SMALLEST + (ratio - SMALLEST_RATIO) * slope) - mu) * slope, lam * slope * slope


@njit(cache=True, error_model="numpy")
@no_type_check
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy")
@no_type_check
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
@no_type_check
def _average_stress(pos, cells, gradient, weight, lam, mu, stress):
    """Add the mean Cauchy stress of each cell to ``stress`` [cell, 6]: xx, xy, xz, yy, yz, zz. In plane strain F has a third row and column (0, 0, 1)."""
    dim = pos.shape[1]
    deformation = np.zeros((3, 3))
    for c in range(cells.shape[0]):
        volume = 0.0
        for q in range(weight.shape[1]):
            volume += weight[c, q]
        for q in range(weight.shape[1]):
            deformation[2, 2] = 1.0
            for i in range(dim):
                for j in range(dim):
                    total = 0.0
                    for a in range(1, cells.shape[1]):
                        total += (pos[cells[c, a], i] - pos[cells[c, 0], i]) * gradient[c, q, a, j]
                    deformation[i, j] = total
            fx = (deformation[0, 0], deformation[0, 1], deformation[0, 2])
            fy = (deformation[1, 0], deformation[1, 1], deformation[1, 2])
            fz = (deformation[2, 0], deformation[2, 1], deformation[2, 2])
            ratio = _dot(fx, _cross(fy, fz))
            first, _ = _volume_response(ratio, lam[c], mu[c])
            share = weight[c, q] / (volume * max(ratio, SMALLEST_RATIO))
            stress[c, 0] += share * (mu[c] * _dot(fx, fx) + first * ratio)
            stress[c, 1] += share * mu[c] * _dot(fx, fy)
            stress[c, 2] += share * mu[c] * _dot(fx, fz)
            stress[c, 3] += share * (mu[c] * _dot(fy, fy) + first * ratio)
            stress[c, 4] += share * mu[c] * _dot(fy, fz)
            stress[c, 5] += share * (mu[c] * _dot(fz, fz) + first * ratio)


@njit(cache=True, error_model="numpy")
@no_type_check
def _plane_response(f00, f01, f10, f11, lam, mu):
    """Return P and the largest eigenvalue of ∂P/∂F in plane strain, from its values in principal stretches."""
    ratio = f00 * f11 - f01 * f10
    first, second = _volume_response(ratio, lam, mu)
    trace = second * (f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11)
    root = math.sqrt(max(0.0, trace * trace + 4.0 * first * (2.0 * second * ratio + first)))
    stiffness = mu + max(abs(first), 0.5 * (trace + root))
    return mu * f00 + first * f11, mu * f01 - first * f10, mu * f10 - first * f01, mu * f11 + first * f00, stiffness


@njit(cache=True, error_model="numpy")
@no_type_check
def _plane_viscous(f00, f01, f10, f11, d00, d01, d10, d11, eta):
    """Return ``2η F Ė`` for F and its rate, and its largest derivative by the rate."""
    e00, e11 = f00 * d00 + f10 * d10, f01 * d01 + f11 * d11
    e01 = 0.5 * (f00 * d01 + f10 * d11 + f01 * d00 + f11 * d10)
    twice, square, ratio = 2.0 * eta, f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11, f00 * f11 - f01 * f10
    largest = 0.5 * (square + math.sqrt(max(0.0, square * square - 4.0 * ratio * ratio)))
    return (
        twice * (f00 * e00 + f01 * e01),
        twice * (f00 * e01 + f01 * e11),
        twice * (f10 * e00 + f11 * e01),
        twice * (f10 * e01 + f11 * e11),
        twice * largest,
    )


@njit(cache=True, error_model="numpy")
@no_type_check
def add_triangle_forces(pos, vel, cells, gradient, weight, lam, mu, eta, damped, force):
    """Add the internal forces of linear triangles to ``force``. Return the largest A and the largest 2η |F|² of any quadrature point.

    Args:
        pos, vel: positions [m] and velocities [m/s] [node, 3]; the third component is zero in 2D.
        cells, gradient, weight: as in ``Mesh``.
        lam, mu, eta: Lamé parameters [Pa] and viscosity [Pa s] [cell].
        damped: whether to add the viscous stress.
        force: forces [N] [node, 3], in 2D per metre of depth.
    """
    stiffest = most_viscous = 0.0
    for c in range(cells.shape[0]):
        i, j, k = cells[c, 0], cells[c, 1], cells[c, 2]
        gjx, gjy, gkx, gky = gradient[c, 0, 1, 0], gradient[c, 0, 1, 1], gradient[c, 0, 2, 0], gradient[c, 0, 2, 1]
        ajx, ajy, akx, aky = pos[j, 0] - pos[i, 0], pos[j, 1] - pos[i, 1], pos[k, 0] - pos[i, 0], pos[k, 1] - pos[i, 1]
        f00, f01, f10, f11 = ajx * gjx + akx * gkx, ajx * gjy + akx * gky, ajy * gjx + aky * gkx, ajy * gjy + aky * gky
        p00, p01, p10, p11, stiffness = _plane_response(f00, f01, f10, f11, lam[c], mu[c])
        stiffest = max(stiffest, stiffness)
        if damped:
            ajx, ajy, akx, aky = vel[j, 0] - vel[i, 0], vel[j, 1] - vel[i, 1], vel[k, 0] - vel[i, 0], vel[k, 1] - vel[i, 1]
            d00, d01, d10, d11 = ajx * gjx + akx * gkx, ajx * gjy + akx * gky, ajy * gjx + aky * gkx, ajy * gjy + aky * gky
            q00, q01, q10, q11, viscosity = _plane_viscous(f00, f01, f10, f11, d00, d01, d10, d11, eta[c])
            most_viscous = max(most_viscous, viscosity)
            p00, p01, p10, p11 = p00 + q00, p01 + q01, p10 + q10, p11 + q11
        w = weight[c, 0]
        gjx, gjy, gkx, gky = w * gjx, w * gjy, w * gkx, w * gky
        hjx, hjy, hkx, hky = p00 * gjx + p01 * gjy, p10 * gjx + p11 * gjy, p00 * gkx + p01 * gky, p10 * gkx + p11 * gky
        force[i, 0] += hjx + hkx
        force[i, 1] += hjy + hky
        force[j, 0] -= hjx
        force[j, 1] -= hjy
        force[k, 0] -= hkx
        force[k, 1] -= hky
    return stiffest, most_viscous


@njit(cache=True, error_model="numpy")
@no_type_check
def add_quad_forces(pos, vel, cells, gradient, weight, lam, mu, eta, damped, force):
    """Add the internal forces of bilinear quadrilaterals, with 2 × 2 quadrature points, to ``force``; arguments and results as in ``add_triangle_forces``."""
    stiffest = most_viscous = 0.0
    for c in range(cells.shape[0]):
        i, j, k, n = cells[c, 0], cells[c, 1], cells[c, 2], cells[c, 3]
        x, y, u, v = pos[i, 0], pos[i, 1], vel[i, 0], vel[i, 1]
        xj, yj, xk, yk, xn, yn = pos[j, 0] - x, pos[j, 1] - y, pos[k, 0] - x, pos[k, 1] - y, pos[n, 0] - x, pos[n, 1] - y
        uj, vj, uk, vk, un, vn = vel[j, 0] - u, vel[j, 1] - v, vel[k, 0] - u, vel[k, 1] - v, vel[n, 0] - u, vel[n, 1] - v
        hjx = hjy = hkx = hky = hnx = hny = 0.0
        for q in range(4):
            gjx, gjy = gradient[c, q, 1, 0], gradient[c, q, 1, 1]
            gkx, gky = gradient[c, q, 2, 0], gradient[c, q, 2, 1]
            gnx, gny = gradient[c, q, 3, 0], gradient[c, q, 3, 1]
            f00, f01 = xj * gjx + xk * gkx + xn * gnx, xj * gjy + xk * gky + xn * gny
            f10, f11 = yj * gjx + yk * gkx + yn * gnx, yj * gjy + yk * gky + yn * gny
            p00, p01, p10, p11, stiffness = _plane_response(f00, f01, f10, f11, lam[c], mu[c])
            stiffest = max(stiffest, stiffness)
            if damped:
                d00, d01 = uj * gjx + uk * gkx + un * gnx, uj * gjy + uk * gky + un * gny
                d10, d11 = vj * gjx + vk * gkx + vn * gnx, vj * gjy + vk * gky + vn * gny
                q00, q01, q10, q11, viscosity = _plane_viscous(f00, f01, f10, f11, d00, d01, d10, d11, eta[c])
                most_viscous = max(most_viscous, viscosity)
                p00, p01, p10, p11 = p00 + q00, p01 + q01, p10 + q10, p11 + q11
            w = weight[c, q]
            hjx, hjy = hjx + w * (p00 * gjx + p01 * gjy), hjy + w * (p10 * gjx + p11 * gjy)
            hkx, hky = hkx + w * (p00 * gkx + p01 * gky), hky + w * (p10 * gkx + p11 * gky)
            hnx, hny = hnx + w * (p00 * gnx + p01 * gny), hny + w * (p10 * gnx + p11 * gny)
        force[i, 0] += hjx + hkx + hnx
        force[i, 1] += hjy + hky + hny
        force[j, 0] -= hjx
        force[j, 1] -= hjy
        force[k, 0] -= hkx
        force[k, 1] -= hky
        force[n, 0] -= hnx
        force[n, 1] -= hny
    return stiffest, most_viscous


@njit(cache=True, error_model="numpy")
@no_type_check
def _combine(x, a, y, b, z, c):
    return x * a[0] + y * b[0] + z * c[0], x * a[1] + y * b[1] + z * c[1], x * a[2] + y * b[2] + z * c[2]


@njit(cache=True, error_model="numpy")
@no_type_check
def _largest_stretch_stiffness(fx, fy, fz, cx, cy, cz, first, second):
    """Bound the largest eigenvalue of ``first S + second c cᵀ``, the response to changes of the principal stretches s apart from μ.

    ``c = J/s``, and S has the third stretch at each pair of the two others. The mean and deviation of the eigenvalues follow from the rows of F and of its
    cofactor, and give the bound (Wolkowicz & Styan 1980).
    """
    square = _dot(fx, fx) + _dot(fy, fy) + _dot(fz, fz)
    trace = second * (_dot(cx, cx) + _dot(cy, cy) + _dot(cz, cz))
    norm = trace * trace + 2.0 * first * square * (2.0 * second * _dot(fx, cx) + first)
    return trace / 3.0 + math.sqrt(max(0.0, (2.0 * norm - 2.0 / 3.0 * trace * trace) / 3.0))


@njit(cache=True, error_model="numpy")
@no_type_check
def _viscous_row(eta, row, fx, fy, fz, dx, dy, dz):
    """Return a row of ``2η F Ė = η (F Fᵀ Ḟ + F Ḟᵀ F)``, from the rows of F and its rate."""
    a = _combine(_dot(row, fx), dx, _dot(row, fy), dy, _dot(row, fz), dz)
    b = _combine(_dot(row, dx), fx, _dot(row, dy), fy, _dot(row, dz), fz)
    return eta * (a[0] + b[0]), eta * (a[1] + b[1]), eta * (a[2] + b[2])


@njit(cache=True, error_model="numpy")
@no_type_check
def _edge(x, i, j):
    return x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]


@njit(cache=True, error_model="numpy")
@no_type_check
def add_tetrahedron_forces(pos, vel, cells, gradient, weight, lam, mu, eta, damped, force):
    """Add the internal forces of linear tetrahedra to ``force``; arguments and results as in ``add_triangle_forces``."""
    stiffest = most_viscous = 0.0
    for c in range(cells.shape[0]):
        i = cells[c, 0]
        g1 = (gradient[c, 0, 1, 0], gradient[c, 0, 1, 1], gradient[c, 0, 1, 2])
        g2 = (gradient[c, 0, 2, 0], gradient[c, 0, 2, 1], gradient[c, 0, 2, 2])
        g3 = (gradient[c, 0, 3, 0], gradient[c, 0, 3, 1], gradient[c, 0, 3, 2])
        a, b, d = _edge(pos, i, cells[c, 1]), _edge(pos, i, cells[c, 2]), _edge(pos, i, cells[c, 3])
        fx, fy, fz = _combine(a[0], g1, b[0], g2, d[0], g3), _combine(a[1], g1, b[1], g2, d[1], g3), _combine(a[2], g1, b[2], g2, d[2], g3)
        cx, cy, cz = _cross(fy, fz), _cross(fz, fx), _cross(fx, fy)
        first, second = _volume_response(_dot(fx, cx), lam[c], mu[c])
        px, py, pz = (
            _combine(mu[c], fx, first, cx, 0.0, fx),
            _combine(mu[c], fy, first, cy, 0.0, fy),
            _combine(mu[c], fz, first, cz, 0.0, fz),
        )
        # Gershgorin's bound on the largest squared stretch
        xy, xz, yz = abs(_dot(fx, fy)), abs(_dot(fx, fz)), abs(_dot(fy, fz))
        square = max(_dot(fx, fx) + xy + xz, _dot(fy, fy) + xy + yz, _dot(fz, fz) + xz + yz)
        stiffest = max(
            stiffest, mu[c] + max(abs(first) * math.sqrt(square), _largest_stretch_stiffness(fx, fy, fz, cx, cy, cz, first, second))
        )
        if damped:
            a, b, d = _edge(vel, i, cells[c, 1]), _edge(vel, i, cells[c, 2]), _edge(vel, i, cells[c, 3])
            dx, dy, dz = (
                _combine(a[0], g1, b[0], g2, d[0], g3), _combine(a[1], g1, b[1], g2, d[1], g3), _combine(a[2], g1, b[2], g2, d[2], g3),
            )  # fmt: skip
            most_viscous = max(most_viscous, 2.0 * eta[c] * square)
            q = _viscous_row(eta[c], fx, fx, fy, fz, dx, dy, dz)
            px = (px[0] + q[0], px[1] + q[1], px[2] + q[2])
            q = _viscous_row(eta[c], fy, fx, fy, fz, dx, dy, dz)
            py = (py[0] + q[0], py[1] + q[1], py[2] + q[2])
            q = _viscous_row(eta[c], fz, fx, fy, fz, dx, dy, dz)
            pz = (pz[0] + q[0], pz[1] + q[1], pz[2] + q[2])
        w = weight[c, 0]
        sx = sy = sz = 0.0
        for n, g in ((1, g1), (2, g2), (3, g3)):
            j = cells[c, n]
            hx, hy, hz = w * _dot(px, g), w * _dot(py, g), w * _dot(pz, g)
            force[j, 0] -= hx
            force[j, 1] -= hy
            force[j, 2] -= hz
            sx, sy, sz = sx + hx, sy + hy, sz + hz
        force[i, 0] += sx
        force[i, 1] += sy
        force[i, 2] += sz
    return stiffest, most_viscous
