"""Scores of the frames of rollouts, with gradients that need little memory.

The forward pass has no graph. It keeps the scores, which are single numbers, and the states of few frames. The backward pass goes from the last frame to the
first: it computes the states of a segment again, then each of its steps again with gradients, and adds what the score of that frame contributes. With segments
as long as the square root of the number of frames, memory grows like this root.

``torch.utils.checkpoint`` stores no activations either, but it keeps the graph of each step, and the distances from which scores are computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gpe_pl.learned.differentiable import Differentiable
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import Simulator, step_scenes
from gpe_pl.trajectory.state import State

Score = Callable[[int, int, State], Any]
"""Returns a number for scene, frame and state, or None if the frame has none. From tensors it computes a scalar tensor."""
Path = tuple[str, ...]
"""Names of nested fields of a state, such as ``("boundary", "pos")``."""
Place = tuple[Any, ...]
"""Number of a scene, and the path of a tensor in its state."""


def rollout_scores(simulator: Simulator, states: Mapping[int, State], num_steps: int, score: Score) -> dict[tuple[int, int], Any]:
    """Return the scores of rollouts by scene and frame, from 1 on. Frames that a failed rollout does not reach have none.

    Gradients reach the tensors of the initial states, and not the weights of a model. A score may depend on its own state only.

    Args:
        simulator: a learned simulator, or another one, which has no gradients.
        states: initial state of each scene, by its number.
        num_steps: number of frames of each rollout.
        score: what to compute in each frame.
    """
    given = {place: tensor for place, tensor in _places(states).items() if tensor.requires_grad}
    if not given or not torch.is_grad_enabled() or not isinstance(simulator, LearnedSimulator):
        values = {(k, frame): score(k, frame, item) for k, frame, item in _frames(simulator, states, num_steps)}
        return {key: value for key, value in values.items() if value is not None}
    run = _Run(
        Differentiable(simulator),
        _replaced(states, {place: tensor.detach() for place, tensor in given.items()}),
        [*given],
        num_steps,
        score,
    )
    found: Tensor = _Scores.apply(run, *given.values())
    return dict(zip(run.scored, found, strict=True))


@dataclass
class _Run:
    """Rollouts without a graph, and their backward pass.

    Attributes:
        simulator: the model.
        start: initial states, without gradients.
        given: places of the tensors in them for which gradients are sought.
        num_steps, score: as in ``rollout_scores``.
        scored: scene and frame of each score.
        stored: states of the first frame of each segment, by frame and scene.
    """

    simulator: Differentiable
    start: dict[int, State]
    given: list[Place]
    num_steps: int
    score: Score
    scored: list[tuple[int, int]] = field(default_factory=list)
    stored: dict[int, dict[int, State]] = field(default_factory=dict)

    def forward(self) -> Tensor:
        """Return the scores [score], and store what the backward pass needs."""
        length, values = math.isqrt(self.num_steps), list[Tensor]()
        self.stored = {0: self.start}
        for scene, frame, state in _frames(self.simulator, self.start, self.num_steps):
            if frame % length == 0 and frame < self.num_steps:
                self.stored.setdefault(frame, {})[scene] = state
            if (value := self.score(scene, frame, state)) is not None:
                self.scored.append((scene, frame))
                values.append(value)
        return torch.stack(values) if values else torch.zeros(0, dtype=torch.float64)

    def backward(self, gradient: Tensor) -> list[Tensor | None]:
        """Return the gradients of the given tensors from those of the scores [score]."""
        weights = {key: weight for key, weight in zip(self.scored, gradient, strict=True) if bool(weight != 0)}  # others may not be finite
        arriving: dict[Place, Tensor] = {}
        end = self.num_steps
        for first, states in reversed(self.stored.items()):
            befores: list[dict[int, State]] = [states, *({} for _ in range(first + 1, end))]
            with torch.no_grad():
                for scene, frame, state in _frames(self.simulator, states, end - first - 1):
                    befores[frame][scene] = state
            for frame in range(end, first, -1):
                arriving = self._step_back(frame, befores.pop(), arriving, weights)
            end = first
        return [arriving.get(place) for place in self.given]

    def _step_back(
        self, frame: int, before: dict[int, State], arriving: Mapping[Place, Tensor], weights: Mapping[tuple[int, int], Tensor]
    ) -> dict[Place, Tensor]:
        """Return the gradients of the states before a frame, from those of the states after it and the weights of its scores."""
        inputs = {place: tensor.detach().requires_grad_() for place, tensor in self._changing(before).items()}
        with torch.enable_grad():
            after = {scene: state for scene, _, state in _frames(self.simulator, _replaced(before, inputs), 1)}
            scores = [
                (self.score(scene, frame, state), weights[scene, frame]) for scene, state in after.items() if (scene, frame) in weights
            ]
        places = _places(after)
        pairs = [*scores, *((places[place], own) for place, own in arriving.items() if place in places)]
        outputs = [(output, own) for output, own in pairs if output.requires_grad]
        if not outputs:
            return {}
        computed, own = zip(*outputs, strict=True)
        found = torch.autograd.grad(computed, [*inputs.values()], own, allow_unused=True)
        return {place: tensor for place, tensor in zip(inputs, found, strict=True) if tensor is not None}

    def _changing(self, states: Mapping[int, State]) -> dict[Place, Tensor]:
        """Return the tensors on which gradients can depend: the given ones, and those that are not those of the start."""
        fixed = {id(tensor) for place, tensor in _places(self.start).items() if place not in self.given}
        return {place: tensor for place, tensor in _places(states).items() if id(tensor) not in fixed}


class _Scores(torch.autograd.Function):
    """Scores as a function of the given tensors."""

    @staticmethod
    def forward(ctx: Any, run: _Run, *_: Tensor) -> Tensor:
        ctx.run = run
        return run.forward()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        return None, *ctx.run.backward(*gradients)


def _frames(simulator: Simulator, states: Mapping[int, State], num_steps: int) -> Any:
    """Yield scene, frame and state of rollouts, until they end or fail."""
    for scene, frame, item in step_scenes(simulator, states, dict.fromkeys(states, num_steps)):
        if isinstance(item, State):
            yield scene, frame, item


def _places(states: Mapping[int, State]) -> dict[Place, Tensor]:
    """Return all tensors of floating-point numbers in states, by place."""
    return {(scene, *path): tensor for scene, state in states.items() for path, tensor in _tensors(state).items()}


def _replaced(states: Mapping[int, State], values: Mapping[Place, Tensor]) -> dict[int, State]:
    """Return states with other tensors at these places."""
    own: dict[int, dict[Path, Tensor]] = {scene: {} for scene in states}
    for (scene, *path), tensor in values.items():
        own[scene][tuple(path)] = tensor
    return {scene: _with(state, own[scene]) for scene, state in states.items()}


def _tensors(part: Any) -> dict[Path, Tensor]:
    """Return the tensors of floating-point numbers in a dataclass and in dataclasses inside it, by path."""
    found: dict[Path, Tensor] = {}
    for item in fields(part):
        value = getattr(part, item.name)
        if isinstance(value, Tensor):
            if value.is_floating_point():
                found[item.name,] = value
        elif is_dataclass(value):
            found |= {(item.name, *path): tensor for path, tensor in _tensors(value).items()}
    return found


def _with(part: Any, values: Mapping[Path, Tensor]) -> Any:
    """Return a dataclass with other tensors at these paths."""
    if not values:
        return part
    own: dict[str, Any] = {path[0]: tensor for path, tensor in values.items() if len(path) == 1}
    for name in {path[0] for path in values if len(path) > 1}:
        own[name] = _with(getattr(part, name), {path[1:]: tensor for path, tensor in values.items() if path[0] == name and len(path) > 1})
    return replace(part, **own)
