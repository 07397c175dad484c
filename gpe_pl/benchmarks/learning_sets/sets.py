"""Public learning sets: where their files are, how they are split, and what was published of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from gpe_pl.data.importers.source import Format

SetName = Literal["beam", "fluidfall", "boxbath", "rigidfall", "ricegrip"]

POSITION, VELOCITY, STRESS = "position, relative L2", "velocity, relative L2", "stress, relative L2"
FULL, ONE_STEP = "full rollout, RMS distance [m]", "one step, RMS distance [m]"
SPACING = "spacing of the settled liquid over the truth's"
RIGIDITY = "change of distances in a body over its size"
STOPPED = "stopped rollouts"
"""Whether a rollout stopped early, 0 or 1. It has no row of its own."""
QUANTITIES = (POSITION, VELOCITY, STRESS, FULL, ONE_STEP, SPACING, RIGIDITY)
"""Quantities in the order of the table."""


@dataclass(frozen=True)
class LearningSet:
    """A public learning set.

    Attributes:
        source: its folder in the user's folder.
        origin: where to get it.
        format: format of ``convert``.
        digest: digest of the published files (``suite.digest_of``); None accepts any.
        num_trajectories, num_frames, materials: number of trajectories, number of frames of each, and materials after the import. Figures on other files would
            not be comparable.
        start: frame of the stored trajectory at which rollouts start.
        leave_out: trajectories that are the test one after the other, by number; with none, there is one split.
        splits: numbers of the trajectories of each split; None takes the published split.
        is_relative: whether errors are relative L2 norms of position, velocity and stress per frame; else RMS distances in m.
        published: published figures by quantity.
        note: where these figures are from.
    """

    source: str
    origin: str
    format: Format
    digest: str | None
    num_trajectories: int
    num_frames: int
    materials: frozenset[str]
    start: int
    leave_out: tuple[int, ...] = ()
    splits: Mapping[str, list[int]] | None = None
    is_relative: bool = False
    published: Mapping[str, float] = field(default_factory=dict)
    note: str = ""

    def parts(self) -> dict[str, dict[str, Any]]:
        """Return the settings of ``convert`` for each split, by a label."""
        if self.leave_out:
            return {f"without {k}": {"leave_out": k} for k in self.leave_out}
        return {"": {} if self.splits is None else {"splits": dict(self.splits)}}


SETS: dict[SetName, LearningSet] = {
    "beam": LearningSet(
        "database_beam",
        "data/database_beam of github.com/quercushernandez/ThermodynamicsGNN",
        "thermognn",
        digest="aa3b401f5e733ff7848ec866180fa01640144f1e07d1f4e5ebba1fed9908f77f",
        num_trajectories=52,
        num_frames=22,
        materials=frozenset({"elastomer"}),
        start=1,  # frame 0 is the one that the importer puts before the first
        is_relative=True,
        published={POSITION: 4.1e-3, VELOCITY: 1.7e-2, STRESS: 9.5e-2},
        note="the published weights of ThermodynamicsGNN on the published split",
    ),
    "fluidfall": LearningSet(
        "data_FluidFall",
        "data/data_FluidFall of github.com/YunzhuLi/DPI-Net",
        "dpinet",
        digest="e11d55890dcd31bf7051db3e188ac77f6df11ccbe723d7e739b1b9365db22563",
        num_trajectories=5,
        num_frames=121,
        materials=frozenset({"fluid"}),
        start=5,
        leave_out=(0, 1, 2, 3, 4),
        published={FULL: 0.0415, ONE_STEP: 5.6e-4},
        note="the published weights of DPI-Net on the same rollouts, which were not in their training",
    ),
    "boxbath": LearningSet(
        "data_BoxBath",
        "data/data_BoxBath of github.com/YunzhuLi/DPI-Net",
        "dpinet",
        digest="1bd035050491beb10dcf62caebbe2b12c62ae3d1ed799662bf1c83273a1c1c4b",
        num_trajectories=5,
        num_frames=151,
        materials=frozenset({"fluid", "solid"}),
        start=1,
        leave_out=(0, 1, 2, 3, 4),
    ),
    "rigidfall": LearningSet(
        "data_RigidFall/demo",
        "data/data_RigidFall of github.com/YunzhuLi/VGPL-Dynamics-Prior",
        "dpinet",
        digest="d9e07aaa207846089af6122d5f06eb65c419d4feff9647ed0112933e5dd78ebf",
        num_trajectories=10,
        num_frames=151,
        materials=frozenset({"solid"}),
        start=3,
        splits={"val": [7], "test": [8, 9]},
    ),
    "ricegrip": LearningSet(
        "data_RiceGrip",
        "data/data_RiceGrip of github.com/YunzhuLi/DPI-Net",
        "dpinet",
        digest="4c04b66559f57e4100f3033dc2daf0187be1627e4610a59f63852beec29f68ee",
        num_trajectories=5,
        num_frames=41,
        materials=frozenset({"snow"}),
        start=1,
        splits={"val": [3], "test": [4]},
    ),
}
