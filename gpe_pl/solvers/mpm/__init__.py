"""The material point method: explicit MLS-MPM with quadratic B-splines and APIC transfers, in float64, in 2D and 3D.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC). One substep of length h, with grid spacing Δ and ``D = Δ²/4``::

    F_p ← (1 + h' ∇v_p) F_p, return-mapped, with h' of the substep before;  τ_p = Kirchhoff stress
    m_i v_i = Σ_p w_ip [m_p v_p + (m_p C_p - h V_p τ_p / D) (x_i - x_p)],   m_i = Σ_p w_ip m_p
    v_i ← openings and boundary conditions (v_i + h g),   with gravity over the mean of this h and the one before
    v_p = Σ_i w_ip v_i,   C_p = ∇v_p = Σ_i w_ip v_i (x_i - x_p)ᵀ / D,   x_p ← x_p + h v_p

Particles keep a part of the velocity that the grid does not represent; otherwise shorter substeps would lose more energy (``smoothing``).

Particles of all materials share the grid; each has its own constitutive law. ``solver`` is the ``Simulator``. ``frame`` is the loop over substeps and contains
the third line above, ``transfer_*`` contain the other lines, ``laws_*`` the return mappings and stresses, ``collider`` the walls and obstacles, and
``prescribed`` the openings. Only transfers and laws exist once for each dimension: they are written in scalars because that is fast.
"""

from gpe_pl.solvers.mpm.solver import MPM, MPMInternal

__all__ = ["MPM", "MPMInternal"]
