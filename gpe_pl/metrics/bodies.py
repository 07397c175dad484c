"""Metrics of bodies that bend: deformation, strain energy, bounces, contact and peak stress of a rollout against the ground truth.

A body is a mesh whose cells are connected (``trajectory.cells.bodies``). No metric changes if the whole scene is moved rigidly. Other units of length, time
and mass change ``peak_von_mises`` only. The ground truth decides which metrics a horizon has, so that all models are compared on the same trajectories; metrics
of stress also need a stress of the prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int64

from gpe_pl.metrics.contact import bounce_heights, boundary_gaps, contact_limits, contact_times, in_first_contact
from gpe_pl.metrics.deformation import BodyMotion, body_motion, rotation_angle, strain_energy
from gpe_pl.trajectory.cells import bodies
from gpe_pl.trajectory.state import von_mises
from gpe_pl.trajectory.trajectory import Trajectory

UNITS: dict[str, str] = {
    "deformation_ratio": "1",
    "deformation_error": "1",
    "rotation_error": "deg",
    "strain_energy_ratio": "1",
    "bounce_height_ratio": "1",
    "contact_time_ratio": "1",
    "peak_von_mises": "Pa",
    "peak_von_mises_ratio": "1",
    "contact_von_mises_error": "1",
}
"""Metrics of ``body_metrics`` and their units."""

STRESS = ("peak_von_mises", "peak_von_mises_ratio", "contact_von_mises_error")
"""Metrics of ``body_metrics`` that need a stress of the prediction."""

SMALLEST_DEFORMATION = 1e-4
"""Deformations are not compared if that of the ground truth is smaller [rest spacings], because it may be rounding of stored positions."""

SMALLEST_BOUNCE = 0.1
"""Bounce heights are not compared if the body rises less than this in the ground truth [rest spacings]."""


@dataclass(frozen=True)
class Bodies:
    """The bodies of a trajectory and what the metrics need of them. Results are computed when they are first used.

    Attributes:
        trajectory: prediction or ground truth with a mesh, in a domain that is not periodic.
        nodes: nodes of each body.
    """

    trajectory: Trajectory
    nodes: list[Int64[np.ndarray, "_"]]

    @classmethod
    def of(cls, trajectory: Trajectory) -> Bodies | None:
        """Return the bodies of a trajectory; None if it has no mesh or a periodic domain, where a body can be in several images."""
        if trajectory.cells is None or trajectory.rest_pos is None or any(trajectory.metadata.periodic):
            return None
        nodes = bodies(trajectory.cells, trajectory.num_nodes)
        return cls(trajectory, nodes) if nodes else None

    def predicted(self, prediction: Trajectory) -> Bodies:
        """Return these bodies with positions and stress of a rollout of the same scene. Everything else is taken from this trajectory."""
        return replace(self, trajectory=replace(self.trajectory, pos=prediction.pos, stress=prediction.stress))

    @cached_property
    def motions(self) -> list[BodyMotion]:
        """Motion of each body."""
        t = self.trajectory
        assert t.rest_pos is not None
        return [body_motion(t.rest_pos[own], t.pos[:, own], t.mass[own]) for own in self.nodes]

    @cached_property
    def mass(self) -> Float[np.ndarray, "node"]:
        """Mass of the nodes of all bodies as a fraction of their total."""
        mass = np.concatenate([motion.mass for motion in self.motions])
        return np.asarray(mass / mass.sum())

    @cached_property
    def field(self) -> Float[np.ndarray, "frame node dim"]:
        """Deformation field of all bodies [m]; nodes are in the order of ``nodes``."""
        return np.concatenate([motion.field for motion in self.motions], axis=1)

    @cached_property
    def rotation(self) -> Float[np.ndarray, "frame body dim dim"]:
        """Rotation of each body since it was undeformed."""
        return np.stack([motion.rotation for motion in self.motions], axis=1)

    @cached_property
    def has_rods(self) -> bool:
        """Whether a body in 3D is straight at rest, so that its rotation about its own axis is arbitrary."""
        t = self.trajectory
        assert t.rest_pos is not None
        return t.metadata.dim == 3 and any(_is_straight(t.rest_pos[own]) for own in self.nodes)

    @cached_property
    def energy(self) -> Float[np.ndarray, "frame"] | None:
        """Elastic energy of all bodies [J]; None if it is not known."""
        return strain_energy(self.trajectory)

    @cached_property
    def gap(self) -> Float[np.ndarray, "frame body"]:
        """Smallest distance of each body to walls and obstacles [m]."""
        return boundary_gaps(self.trajectory, self.nodes)

    @cached_property
    def height(self) -> Float[np.ndarray, "frame body"] | None:
        """Height of the centre of mass of each body [m], against gravity; None without gravity."""
        gravity = np.array(self.trajectory.metadata.gravity)
        strength = np.abs(gravity).max(initial=0.0)  # first, so that no square underflows
        if strength == 0:
            return None
        up = -gravity / strength
        return np.stack([motion.centre @ (up / np.linalg.norm(up)) for motion in self.motions], axis=1)

    @cached_property
    def von_mises(self) -> Float[np.ndarray, "frame node"] | None:
        """Von Mises stress at the nodes of all bodies [Pa], in the order of ``nodes``; None without a stress."""
        stress = self.trajectory.stress
        return None if stress is None else von_mises(np.asarray(stress.node, np.float64)[:, np.concatenate(self.nodes)])


def _is_straight(pos: Float[np.ndarray, "node dim"]) -> bool:
    """Tell whether nodes lie on one line, up to a millionth of its length."""
    sizes = np.linalg.svd(pos.astype(np.float64) - pos.mean(axis=0, dtype=np.float64), compute_uv=False)
    return bool(sizes[1:2].max(initial=0.0) <= 1e-6 * sizes[0])


def body_metrics(prediction: Bodies, truth: Bodies, num_steps: int) -> dict[str, float]:
    """Compute the metrics of bodies over frames 1 to ``num_steps``.

    ======================== ==== ======================================================================================================
    deformation_ratio        1    rms over frames and mass of the deformation field u of the prediction, over that of the ground truth û
    deformation_error        1    ‖u − û‖ / ‖û‖, each in the frame of its own body, with the same norm
    rotation_error           deg  angle between the rotations of a body in prediction and ground truth, mean over frames and bodies
    strain_energy_ratio      1    elastic energy in all cells, mean over frames, over that of the ground truth
    bounce_height_ratio      1    largest rise of the centre of mass after the first contact, over that of the ground truth; sums over bodies
    contact_time_ratio       1    time in contact with walls and obstacles, over that of the ground truth; sums over bodies
    peak_von_mises           Pa   largest von Mises stress at a node of the prediction
    peak_von_mises_ratio     1    the same over the largest of the ground truth
    contact_von_mises_error  1    ‖σ − σ̂‖ / ‖σ̂‖ of the von Mises stress over the frames and nodes of each body's first contact in the ground truth
    ======================== ==== ======================================================================================================

    A metric is left out if the ground truth has nothing to compare with: no deformation above ``SMALLEST_DEFORMATION``, no bounce above ``SMALLEST_BOUNCE``,
    no contact, no gravity, no stress, or no known Poisson's ratio. Straight rods in 3D have no ``rotation_error`` and no ``deformation_error``, because a turn
    about their axis does not show. ``deformation`` and ``contact`` define deformation, energy and contact.

    Args:
        prediction: bodies of a rollout, with finite positions in these frames.
        truth: bodies of the same scene from a solver.
        num_steps: number of steps.
    """
    until, spacing = num_steps + 1, truth.trajectory.metadata.spacing
    values = {}
    if not truth.has_rods:
        apart = prediction.rotation[1:until].swapaxes(-1, -2) @ truth.rotation[1:until]
        values["rotation_error"] = float(rotation_angle(apart).mean())
    size = _norm(truth.field[1:until], truth.mass)
    if size > SMALLEST_DEFORMATION * spacing:
        values["deformation_ratio"] = _norm(prediction.field[1:until], truth.mass) / size
        if not truth.has_rods:
            values["deformation_error"] = _norm(prediction.field[1:until] - truth.field[1:until], truth.mass) / size
        if truth.energy is not None and prediction.energy is not None:
            values["strain_energy_ratio"] = float(prediction.energy[1:until].mean() / truth.energy[1:until].mean())
    return values | _contact_metrics(prediction, truth, until) | _peak_stress(prediction, truth, until)


def _norm(field: np.ndarray, mass: np.ndarray) -> float:
    """Return the root mean square of a field [frame, node, dim] over frames and mass."""
    return math.sqrt(np.einsum("n,fnd,fnd->", mass, field, field) / len(field))


def _contact_metrics(prediction: Bodies, truth: Bodies, until: int) -> dict[str, float]:
    metadata, values = truth.trajectory.metadata, {}
    limit = contact_limits(truth.gap, metadata.spacing)
    gap, own_gap = truth.gap[:until], prediction.gap[:until]
    time = contact_times(gap, limit, metadata.frame_dt).sum()
    if time > 0:
        values["contact_time_ratio"] = float(contact_times(own_gap, limit, metadata.frame_dt).sum() / time)
    if truth.height is not None and prediction.height is not None:
        bounce = bounce_heights(truth.height[:until], gap, limit).sum()
        if bounce > SMALLEST_BOUNCE * metadata.spacing:
            values["bounce_height_ratio"] = float(bounce_heights(prediction.height[:until], own_gap, limit).sum() / bounce)
    if truth.von_mises is not None and prediction.von_mises is not None:
        window = np.repeat(in_first_contact(gap, limit), [len(own) for own in truth.nodes], axis=1)
        window[0] = False  # frame 0 is the shared start
        true = truth.von_mises[:until][window]
        if true.any():
            error = float(np.linalg.norm(prediction.von_mises[:until][window] - true) / np.linalg.norm(true))
            values["contact_von_mises_error"] = error if math.isfinite(error) else math.inf
    return values


def _peak_stress(prediction: Bodies, truth: Bodies, until: int) -> dict[str, float]:
    if prediction.von_mises is None or truth.von_mises is None:
        return {}
    peak, true = (float(stress[1:until].max()) for stress in (prediction.von_mises, truth.von_mises))
    peak = math.inf if math.isnan(peak) else peak
    return {"peak_von_mises": peak} | ({"peak_von_mises_ratio": peak / true} if true > 0 else {})
