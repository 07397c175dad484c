"""A simulator that sees the mirror image of every scene, for checks of mirror symmetry."""

from __future__ import annotations

from dataclasses import dataclass, field

from gpe_pl.rollout.loop import Simulator
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.reflection import Reflection
from gpe_pl.trajectory.state import State


@dataclass(frozen=True)
class Mirrored:
    """Mirrors a state at a plane, makes the step, and mirrors the result back.

    A rollout equals that of the inner simulator if that simulator is mirror-symmetric. The image of a boundary has no shapes if one of them has no image
    (``geometry.shape_images``). The inner simulator then has to read boundary nodes, as learned simulators do. Containment goes
    outside: ``Contained(Mirrored(simulator, …), dt)``.

    Attributes:
        simulator: simulator that makes the steps.
        axis: axis normal to the plane.
        offset: position of the plane along the axis [m].
    """

    simulator: Simulator
    axis: int
    offset: float
    _images: dict[int, tuple[Boundary, Boundary]] = field(default_factory=dict, repr=False, compare=False)

    def step(self, state: State) -> State:
        after = self.simulator.step(self._reflection(state).state(state, self._boundary(state)))
        return self._reflection(state).state(after, state.boundary.at(1))

    def _reflection(self, state: State) -> Reflection:
        return Reflection.at(self.axis, self.offset, state.dim)

    def _boundary(self, state: State) -> Boundary:
        """Return the image of the boundary; that of a boundary at rest is made once, and so is its search tree."""
        boundary = state.boundary
        known = self._images.get(id(boundary))
        if known is not None and known[0] is boundary:
            return known[1]
        image = self._reflection(state).boundary(boundary)
        self._images.clear()
        self._images[id(boundary)] = boundary, image
        return image
