"""Gradients through long rollouts with little memory: the states of every ``SEGMENT``-th frame are stored, and the backward pass computes the others again.

``torch.utils.checkpoint`` stores no activations either, but it keeps the graph of each step, which takes more memory than the states do. Here the forward pass
has no graph at all. The backward pass advances a segment without gradients, then computes its steps again one by one from the last to the first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import SimulationError, sound
from gpe_pl.trajectory.state import State

Path = tuple[str, ...]
"""Names of nested fields of a state, such as ``("boundary", "pos")``."""
Place = tuple[Any, ...]
"""Number of a scene, and the path of a tensor in its state."""


SEGMENT = 20
"""Largest number of steps between stored states."""


class Checkpointed:
    """A learned simulator whose steps keep neither activations nor most states for gradients.

    Gradients reach the tensors of the states, and not the weights of the model.
    """

    def __init__(self, simulator: LearnedSimulator) -> None:
        self.simulator = simulator
        self._segment: _Segment | None = None
        self._returned: list[State | SimulationError] = []

    def step(self, state: State) -> State:
        return sound(*self.step_all([state]))

    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        given = {place: tensor for place, tensor in _places(states).items() if tensor.requires_grad}
        if not given or not torch.is_grad_enabled():
            return self.simulator.next_states(states)
        before = _replaced(states, {place: tensor.detach() for place, tensor in given.items()})
        goes_on = len(states) == len(self._returned) and all(own is last for own, last in zip(states, self._returned, strict=True))
        if self._segment is None or not goes_on or self._segment.length == SEGMENT:
            self._segment = _Segment(self.simulator, before)
        step = _Step(self._segment, self._segment.length, [*given])
        self._segment.length += 1
        outputs: tuple[Tensor, ...] = _Recomputed.apply(step, before, *given.values())
        values = dict(zip(step.computed, outputs, strict=True))
        self._returned = _replaced(step.after, {**{place: given[source] for place, source in step.kept.items()}, **values})
        step.after = []  # the graph keeps the step
        return self._returned


@dataclass
class _Segment:
    """Steps of the same scenes one after the other.

    Attributes:
        simulator: the model.
        first: states before the first step, without gradients.
        length: number of steps.
    """

    simulator: LearnedSimulator
    first: list[State]
    length: int = 0
    _known: list[list[Any]] = field(default_factory=list)

    def before(self, number: int) -> list[State]:
        """Return the states before a step. Call it for the last step first: states before it are computed then, and are forgotten one by one."""
        if len(self._known) <= number:
            self._known = [self.first]
            with torch.no_grad():
                for _ in range(number):
                    self._known.append(self.simulator.next_states(self._known[-1]))
        del self._known[number + 1 :]
        return self._known[number]


@dataclass
class _Step:
    """One step of several scenes as a function of the tensors that need gradients.

    Attributes:
        segment: the steps around it.
        number: number of the step in its segment.
        inputs: places of the tensors that need gradients.
        after: states after the step, without gradients; errors of scenes that failed.
        computed: places of the tensors that the step computed.
        kept: places of inputs that the step returned unchanged, by their places after the step.
    """

    segment: _Segment
    number: int
    inputs: list[Place]
    after: list[State | SimulationError] = field(default_factory=list)
    computed: list[Place] = field(default_factory=list)
    kept: dict[Place, Place] = field(default_factory=dict)

    def run(self, states: list[State]) -> list[Tensor]:
        """Advance the scenes without gradients, and return what the step computed."""
        before = {id(tensor): place for place, tensor in _places(states).items()}
        self.after = self.segment.simulator.next_states(states)
        found = {place: tensor for place, tensor in _places(self.after).items() if id(tensor) not in before}
        self.computed = [*found]
        same = {place: before[id(tensor)] for place, tensor in _places(self.after).items() if id(tensor) in before}
        self.kept = {place: source for place, source in same.items() if source in self.inputs}
        return [*found.values()]

    def again(self) -> tuple[list[Tensor], list[Tensor]]:
        """Compute the step again with gradients, and return its inputs and what it computed."""
        states = self.segment.before(self.number)
        own = _places(states)
        inputs = [own[place].detach().requires_grad_() for place in self.inputs]
        with torch.enable_grad():
            after = _places(self.segment.simulator.next_states(_replaced(states, dict(zip(self.inputs, inputs, strict=True)))))
        return inputs, [after[place] for place in self.computed]


class _Recomputed(torch.autograd.Function):
    """A step whose backward pass computes it again, because its forward pass kept no graph."""

    @staticmethod
    def forward(ctx: Any, step: _Step, before: list[State], *_: Tensor) -> tuple[Tensor, ...]:
        ctx.step = step
        return tuple(step.run(before))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        inputs, outputs = ctx.step.again()
        pairs = [(output, gradient) for output, gradient in zip(outputs, gradients, strict=True) if output.requires_grad]
        if not pairs:
            return None, None, *(None for _ in inputs)
        computed, arriving = zip(*pairs, strict=True)
        return None, None, *torch.autograd.grad(computed, inputs, arriving, allow_unused=True)


def _places(states: Sequence[State | SimulationError]) -> dict[Place, Tensor]:
    """Return all tensors of floating-point numbers in states, by place."""
    return {(k, *path): tensor for k, state in enumerate(states) if isinstance(state, State) for path, tensor in _tensors(state).items()}


def _replaced(states: Sequence[Any], values: Mapping[Place, Tensor]) -> list[Any]:
    """Return states with other tensors at these places."""
    own: list[dict[Path, Tensor]] = [{} for _ in states]
    for (scene, *path), tensor in values.items():
        own[scene][tuple(path)] = tensor
    return [_with(state, found) for state, found in zip(states, own, strict=True)]


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
