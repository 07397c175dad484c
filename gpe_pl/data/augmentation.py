"""Augmentation of training windows by symmetries of mechanics: mirror images, rotations, and frames of reference that move.

All of them are exact: the image of a window, with its walls, is a window that the same solver could have made. Each sample draws its own image.

- A mirror image maps the domain onto itself.
- A rotation turns walls along with the scene, so the walls of its image are oblique.
- The vertical is the axis of gravity; without gravity, the axis along which walls face mostly one way (``trajectory.reflection.level_axes``).
- Quarter turns rotate gravity along with the scene. A model that never saw another direction of gravity may have learned which way is down.
- A frame of reference that moves (Galilean shift) adds one velocity to everything. Walls that were at rest then move, because friction and contact depend on
  velocities relative to walls. Without moving walls the image would be wrong wherever a wall is near.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.boundary import BoundaryMotion
from gpe_pl.trajectory.reflection import Reflection, Rotation, level_axes
from gpe_pl.trajectory.trajectory import Trajectory

MIRROR_STREAM, TURN_STREAM, BOOST_STREAM, QUARTER_STREAM = 1, 2, 3, 4
"""Further components of the seed, which make the draws independent of the noise and of each other."""

NUM_TURNS = {2: 4, 3: 24}
"""Number of rotations that map axes onto axes, by dimension."""


ONE_SIDED = 0.7
"""Accelerations whose mean is larger than this fraction of their root mean square come from a pull that acts on all nodes."""


class AugmentationError(GpeError, ValueError):
    """Raised when the scenes do not have a symmetry; the message names the setting."""


@dataclass(frozen=True)
class Augmentation:
    """Images of training windows.

    Attributes:
        mirror: mirror each window at random. Every level axis is mirrored with probability 1/2, independently of the others.
        rotate: turn each window about the vertical by a random angle; in 3D.
        quarter_turns: turn each window, with its gravity, by one of the rotations that map axes onto axes, drawn uniformly.
        boost_speed: speed [m/s] up to which a random velocity, along each level axis, is added to the scene and its walls.
    """

    mirror: bool = False
    rotate: bool = False
    quarter_turns: bool = False
    boost_speed: float = 0.0

    @property
    def is_beyond_mirror(self) -> bool:
        """Whether images differ by more than a reflection."""
        return self.rotate or self.quarter_turns or self.boost_speed > 0

    def check(self, trajectory: Trajectory) -> None:
        """Check that a scene has the symmetries.

        Raises:
            AugmentationError: windows are to be turned in 2D, without one vertical axis, in a periodic domain, or with nodes that are held along some axes;
                or moved in a periodic domain.
        """
        metadata = trajectory.metadata
        if self.rotate and (metadata.dim != 3 or len(_level(trajectory)) < 2):
            raise AugmentationError(
                "training.rotate=true: needs scenes in 3D with gravity along one axis, or without gravity and with walls that face mostly one way along "
                "one axis at most; choose training.mirror=true"
            )
        if self.rotate and "sliding" in (metadata.loads or ()):
            raise AugmentationError(
                "training.rotate=true: some nodes are held along some axes only, which stay as they are; choose training.mirror=true"
            )
        if self.is_beyond_mirror and any(metadata.periodic):
            raise AugmentationError(
                "training.rotate, quarter_turns and boost_speed: not in periodic domains, which stay as they are; leave them off"
            )

    def is_idle(self, beginnings: Iterable[Trajectory]) -> bool:
        """Return whether mirror images or velocities are wanted and no scene has a level axis for them, as with gravity that is not along an axis.

        Args:
            beginnings: first frames of trajectories, which are read if images need a level axis.
        """
        return (self.mirror or self.boost_speed > 0) and not any(_level(trajectory) for trajectory in beginnings)

    def hidden_pull(self, beginnings: Iterable[Trajectory]) -> list[int]:
        """Return the axes that images turn over although nodes accelerate along them, as where data store no gravity but have some.

        Args:
            beginnings: first frames of trajectories, which are read if images turn something over.
        """
        found: dict[int, list[np.ndarray]] = {}
        for trajectory in beginnings if self.mirror or self.rotate else ():
            if any(trajectory.metadata.gravity) or trajectory.num_frames < 3:
                continue
            vel = integrators.velocities(trajectory.pos.astype(np.float64), trajectory.metadata.frame_dt, trajectory.metadata.periodicity)
            for axis in _level(trajectory):
                found.setdefault(axis, []).append(np.diff(vel, axis=0)[..., axis].ravel())
        return [axis for axis, own in found.items() if _is_one_sided(np.concatenate(own))]

    def reflection(self, trajectory: Trajectory, seed: int, sample: int) -> Reflection:
        """Return the reflection of a sample."""
        bounds = trajectory.metadata.bounds
        if not self.mirror:
            return Reflection.of(bounds, ())
        rng = np.random.default_rng((seed, sample, MIRROR_STREAM))
        return Reflection.of(bounds, [axis for axis in _level(trajectory) if rng.random() < 0.5])

    def moved(self, trajectory: Trajectory, frame: int, seed: int, sample: int) -> Trajectory:
        """Return a window turned and seen from a moving frame of reference. At ``frame`` this frame coincides with the one at rest."""
        metadata, level = trajectory.metadata, _level(trajectory)
        if self.rotate:
            axis = next((axis for axis in range(metadata.dim) if axis not in level), metadata.dim - 1)
            angle = np.random.default_rng((seed, sample, TURN_STREAM)).uniform(0, 2 * np.pi)
            trajectory = Rotation.about(axis, angle, [(low + high) / 2 for low, high in metadata.bounds]).trajectory(trajectory)
        if self.boost_speed > 0:
            velocity = np.random.default_rng((seed, sample, BOOST_STREAM)).uniform(-self.boost_speed, self.boost_speed, metadata.dim)
            velocity[[axis for axis in range(metadata.dim) if axis not in level]] = 0.0
            trajectory = boosted(trajectory, velocity, frame)
        if self.quarter_turns:
            number = np.random.default_rng((seed, sample, QUARTER_STREAM)).integers(NUM_TURNS[metadata.dim])
            trajectory = turned_with_gravity(trajectory, int(number))
        return trajectory

    def extremes(self, trajectory: Trajectory) -> list[Trajectory]:
        """Return a trajectory and its images that widen the range of scenes in training: with the fastest and slowest walls that ``moved`` reaches without
        turning the scene, and with all directions of gravity.
        """
        images = [trajectory]
        if self.boost_speed > 0:
            images += [boosted(trajectory, velocity, 0) for velocity in self._extreme_boosts(trajectory)]
        if self.quarter_turns:
            images = [turned_with_gravity(image, number) for image in images for number in range(NUM_TURNS[trajectory.metadata.dim])]
        return images

    def _extreme_boosts(self, trajectory: Trajectory) -> list[np.ndarray]:
        """Return the velocities [dim] that give some boundary node at some frame the highest and the lowest speed; none without boundary nodes."""
        boundary, level = trajectory.boundary, _level(trajectory)
        own = (boundary.vel if boundary.motion is None else boundary.motion.vel).reshape(-1, trajectory.metadata.dim).astype(np.float64)
        if not len(own):
            return []
        faster, slower = np.zeros((2, *own.shape))
        faster[:, level] = np.where(own < 0, -self.boost_speed, self.boost_speed)[:, level]
        slower[:, level] = -own.clip(-self.boost_speed, self.boost_speed)[:, level]
        speeds = [np.linalg.norm(own + added, axis=1) for added in (faster, slower)]
        return [faster[speeds[0].argmax()], slower[speeds[1].argmin()]]


def turned_with_gravity(trajectory: Trajectory, number: int) -> Trajectory:
    """Return a trajectory turned about the middle of its domain, with its gravity and bounds; see ``Rotation.between_axes``."""
    metadata, bounds = trajectory.metadata, np.array(trajectory.metadata.bounds)
    turn = Rotation.between_axes(number, bounds.mean(axis=1).tolist())
    corners = turn.point(bounds.T)
    image = turn.trajectory(trajectory)
    source = np.abs(turn.matrix).argmax(axis=1)  # the axis that each axis of the image was
    return replace(
        image,
        metadata=replace(
            metadata,
            bounds=tuple(zip(corners.min(axis=0).tolist(), corners.max(axis=0).tolist(), strict=True)),
            gravity=tuple(turn.vector(np.array(metadata.gravity)).tolist()),
        ),
        prescribed=None if trajectory.prescribed is None else np.ascontiguousarray(trajectory.prescribed[:, source]),
    )


def _is_one_sided(values: np.ndarray) -> bool:
    """Whether values have nearly one sign and size: their mean is larger than ``ONE_SIDED`` times their root mean square."""
    return bool(abs(values.mean()) > ONE_SIDED * np.sqrt(np.square(values).mean()))


def _level(trajectory: Trajectory) -> list[int]:
    return level_axes(trajectory.metadata.gravity, trajectory.boundary.normal)


def boosted(trajectory: Trajectory, velocity: np.ndarray, frame: int) -> Trajectory:
    """Return a trajectory to which a velocity [dim] in m/s is added, with its walls. At ``frame`` all positions are the same."""
    boundary, num_frames = trajectory.boundary, trajectory.num_frames
    way = (np.arange(num_frames) - frame)[:, None, None] * trajectory.metadata.frame_dt * velocity
    still = BoundaryMotion(*(np.broadcast_to(x, (num_frames, *x.shape)) for x in (boundary.pos, boundary.vel, boundary.normal)))
    motion = boundary.motion or still
    motion = BoundaryMotion((motion.pos + way).astype(motion.pos.dtype), (motion.vel + velocity).astype(motion.vel.dtype), motion.normal)
    return replace(
        trajectory,
        pos=(trajectory.pos + way).astype(trajectory.pos.dtype),
        vel=(trajectory.vel + velocity).astype(trajectory.vel.dtype),
        boundary=replace(boundary, pos=motion.pos[0], vel=motion.vel[0], shapes=(), motion=motion),
    )
