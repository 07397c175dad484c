"""Quantities that an engineer asks of a scene: energy, momentum, run-out, bounce height, deflection and peak stress, over time and as one number per scene.

Velocities are those of the frames, (x[t] − x[t−1]) / Δt, in predictions and ground truth alike. In 2D, energies, momenta and masses are per metre of depth.
Horizontal is across gravity. In scenes without gravity all directions are horizontal, and there is no height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gpe_pl.metrics.deformation import strain_energy
from gpe_pl.metrics.open_scenes import ledger, present
from gpe_pl.metrics.rollouts import displacement, mass_motion
from gpe_pl.trajectory.state import von_mises
from gpe_pl.trajectory.trajectory import Trajectory

RUN_OUT_FRACTION = 0.95
"""Fraction of the mass within the run-out. The farthest node alone would be chance."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of one scene.

    Attributes:
        unit: unit of the values.
        over_time: values of frames 1, 2, … [frame].
        value: the number of the scene that parity plots compare; None if only the course is of interest.
    """

    unit: str
    over_time: Float[np.ndarray, "frame"]
    value: float | None = None


def quantities(trajectory: Trajectory) -> dict[str, Quantity]:
    """Return the quantities of a trajectory of at least two frames, by name.

    - ``kinetic energy``, ``potential energy`` (0 in frame 1), ``elastic energy`` where ``strain_energy`` knows it [J].
    - ``momentum``: magnitude of the total momentum [kg m/s].
    - ``run-out``: horizontal distance from the first centre of mass within which ``RUN_OUT_FRACTION`` of the mass is [m]; one number: at the end.
      Along a periodic axis, the material must be narrower than half of the domain in frame 0.
    - ``height``: height of the centre of mass above that in frame 1 [m].
    - ``bounce height``: rise of the centre of mass above its lowest earlier place, since it began to fall [m]; one number: the largest.
    - ``deflection``, in scenes with nodes whose motion is given: largest distance of a node from its rest position [m]; one number: the largest.
    - ``peak stress``: largest von Mises stress of a node [Pa], where there is a stress; one number: the largest.

    Open scenes have the kinetic energy and the momentum of what is in the scene, and

    - ``mass``: mass in the scene [kg]; one number: at the end.
    - ``outflow``: mass that has left the scene since frame 0 [kg]; one number: at the end.
    """
    if trajectory.alive is not None:
        return _of_open_scene(trajectory)
    motion = mass_motion(trajectory, trajectory.num_frames - 1)
    mass, gravity = float(trajectory.mass.sum(dtype=np.float64)), np.asarray(trajectory.metadata.gravity, float)
    found = {
        "kinetic energy": Quantity("J", mass * motion.kinetic_energy),
        "momentum": Quantity("kg m/s", mass * np.linalg.norm(motion.momentum, axis=-1)),
    }
    energy = strain_energy(trajectory)
    if energy is not None:
        found["elastic energy"] = Quantity("J", energy[1:])
    strength = float(np.linalg.norm(gravity))
    up = -gravity / strength if strength else np.zeros(len(gravity))
    if _has_a_middle(trajectory, up):
        out = _run_out(_way_from_centre(trajectory, motion.pos), trajectory.mass, up)
        found["run-out"] = Quantity("m", out, float(out[-1]))
    if strength:
        height = (motion.centre - motion.centre[0]) @ up
        rise = _rise(height)
        found["potential energy"] = Quantity("J", mass * strength * height)
        found["height"] = Quantity("m", height)
        found["bounce height"] = Quantity("m", rise, float(rise.max()))
    if trajectory.prescribed is not None:
        rest = trajectory.pos[0] if trajectory.rest_pos is None else trajectory.rest_pos
        start = displacement(trajectory.pos[0], rest, trajectory.metadata)
        bent = np.linalg.norm(start + motion.pos - trajectory.pos[0], axis=-1).max(axis=1)
        found["deflection"] = Quantity("m", bent, float(bent.max()))
    if trajectory.stress is not None:
        peak = von_mises(np.asarray(trajectory.stress.node[1:], np.float64)).max(axis=1)
        found["peak stress"] = Quantity("Pa", peak, float(peak.max()))
    return found


def _of_open_scene(trajectory: Trajectory) -> dict[str, Quantity]:
    there, book, mass = present(trajectory), ledger(trajectory), trajectory.mass.astype(np.float64)
    pos = trajectory.pos.astype(np.float64)
    between = displacement(pos[1:], pos[:-1], trajectory.metadata) / trajectory.metadata.frame_dt
    vel = np.where((there[1:] & there[:-1])[..., None], between, trajectory.vel[1:])  # what has just entered has no frame before
    left = np.cumsum(book.left_mass)[1:]
    return {
        "kinetic energy": Quantity("J", 0.5 * np.einsum("fn,n,fnd,fnd->f", there[1:], mass, vel, vel)),
        "momentum": Quantity("kg m/s", np.linalg.norm(np.einsum("fn,n,fnd->fd", there[1:], mass, vel), axis=-1)),
        "mass": Quantity("kg", book.mass[1:], float(book.mass[-1])),
        "outflow": Quantity("kg", left, float(left[-1])),
    }


def _has_a_middle(trajectory: Trajectory, up: Float[np.ndarray, "dim"]) -> bool:
    """Whether the first frame is narrower than half of the domain along each periodic axis that has a horizontal part. Otherwise it has no centre of mass."""
    space = trajectory.metadata.periodicity
    for axis in space.axes if trajectory.num_nodes else ():
        period = float(space.period[axis])
        place = np.sort(trajectory.pos[0, :, axis].astype(np.float64) % period)
        widest_gap = np.diff(place, append=place[0] + period).max()
        if abs(up[axis]) < 1 - 1e-9 and widest_gap <= 0.5 * period:
            return False
    return True


def _way_from_centre(trajectory: Trajectory, pos: Float[np.ndarray, "frame node dim"]) -> Float[np.ndarray, "frame node dim"]:
    """Return positions minus the centre of mass of the first of these frames. In a periodic domain, nodes are first brought together beside one of them."""
    if any(trajectory.metadata.periodic) and trajectory.num_nodes:
        there = pos[0, :1]
        pos = pos - pos[0] + there + displacement(pos[0], np.broadcast_to(there, pos[0].shape), trajectory.metadata)
    fraction = trajectory.mass.astype(np.float64) / trajectory.mass.sum(dtype=np.float64)
    return pos - np.einsum("n,nd->d", fraction, pos[0])


def _run_out(
    way: Float[np.ndarray, "frame node dim"], mass: Float[np.ndarray, "node"], up: Float[np.ndarray, "dim"]
) -> Float[np.ndarray, "frame"]:
    distance = np.linalg.norm(way - (way @ up)[..., None] * up, axis=-1)
    order = np.argsort(distance, axis=1)
    within = np.cumsum(mass.astype(np.float64)[order], axis=1) / mass.sum(dtype=np.float64)
    node = np.argmax(within >= RUN_OUT_FRACTION - 1e-12, axis=1)
    return np.take_along_axis(np.take_along_axis(distance, order, axis=1), node[:, None], axis=1)[:, 0]


def _rise(height: Float[np.ndarray, "frame"]) -> Float[np.ndarray, "frame"]:
    """Return the rise above the lowest earlier height in each frame; 0 until the height first decreases."""
    falls = np.diff(height, prepend=height[0]) < 0
    begun = np.logical_or.accumulate(falls)
    lowest = np.minimum.accumulate(np.where(begun, height, np.inf))
    return np.where(begun, height - np.where(begun, lowest, 0.0), 0.0)
