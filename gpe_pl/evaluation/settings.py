"""Settings of an evaluation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from gpe_pl.errors import GpeError
from gpe_pl.schema import Split

Export = Literal["vtk", "npz", "mp4", "svg", "pdf", "model", "onnx", "page"]


def _different(splits: list[Split]) -> list[Split]:
    """Raise an error for a split that is given twice. Its scenes would count twice, and confidence intervals would be too narrow."""
    if twice := [split for split in dict.fromkeys(splits) if splits.count(split) > 1]:
        raise ValueError(f"must have each split once, {twice[0]} occurs {splits.count(twice[0])} times")
    return splits


class StartError(GpeError, ValueError):
    """Raised if ``start_time`` leaves too few frames before it, or is between two frames."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation.

    Attributes:
        splits: splits of the data set.
        horizons: horizons [s], each at the nearest frame (see ``horizons``); the full length is always added.
        num_trajectories: number of trajectories per split, from its start; None takes all.
        start_time: time at which rollouts start [s]. Set it to compare models with different histories or frames from the same instant. None takes the first
            frame with enough history. 0 starts at the first frame of short data: all velocities of the history are then the stored velocity of that frame.
        containment: put particles that cross a wall back on its surface.
        num_uncontained: number of trajectories per split that are also rolled out without containment, which shows what it corrects; None takes all.
        clamp_parameters: clamp material parameters outside the trained range to the nearest trained value.
        static_friction: nodes that walls support stay in place if they are slower than this fraction of the speed that gravity gives in one frame (see
            ``nn.static_friction``), and planes act by Coulomb's law (``nn.friction_cone``), unless it is 0; None takes the model's own value.
        mirror_average: average each step over the scene and its mirror images (see ``learned.mirror_average``); None takes the model's own value.
        material_controls: roll scenes with unseen parameters out with other parameters, too (see ``material_controls``).
        num_pictures: number of trajectories per split that get a figure, an animation and a viewer. With 0, no curve of errors is drawn, either.
        quantities: also write energy, momentum, run-out, bounce height, deflection and peak stress (see ``metrics.quantities``): over time for the
            trajectories with pictures, and one number per trajectory as a table and parity plots.
        export: what to write for other programs: the trajectories with pictures as ``vtk`` series, ``npz`` and ``mp4``, figures also as ``svg`` or ``pdf``,
            the ``model`` (see ``export.program``), its network as ``onnx`` (see ``export.onnx_network``), and a ``page`` on which the model runs in a
            browser (see ``export.play_page``), with films of these trajectories.
    """

    splits: Annotated[list[Split], Field(min_length=1), AfterValidator(_different)] = field(default_factory=lambda: ["test", "test_unseen"])
    horizons: list[Annotated[float, Field(gt=0)]] = field(default_factory=lambda: [0.025, 0.1, 0.25, 0.5])
    num_trajectories: Annotated[int, Field(ge=1)] | None = None
    start_time: Annotated[float, Field(ge=0)] | None = None
    containment: bool = True
    num_uncontained: Annotated[int, Field(ge=0)] | None = None
    clamp_parameters: bool = True
    static_friction: Annotated[float, Field(ge=0, lt=1)] | None = None
    mirror_average: bool | None = None
    material_controls: bool = False
    num_pictures: Annotated[int, Field(ge=0)] = 2
    quantities: bool = False
    export: list[Export] = field(default_factory=list)

    def first_frame(self, history: int, frame_dt: float) -> int:
        """Return the frame at which rollouts of a model with this history [frames] start.

        Raises:
            StartError: ``start_time`` leaves too little history, or is between frames.
        """
        if self.start_time is None:
            return history
        if self.start_time == 0:
            return 0
        frame, key = round(self.start_time / frame_dt), f"evaluation.start_time={self.start_time:g}"
        if frame < history:
            raise StartError(
                f"{key}: graph.history={history} needs as many frames of {frame_dt:g} s before it; choose at least {history * frame_dt:g}"
            )
        if abs(frame * frame_dt - self.start_time) > 1e-6 * frame_dt:
            raise StartError(f"{key}: is between two frames of {frame_dt:g} s; choose {frame * frame_dt:g}")
        return frame
