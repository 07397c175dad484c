"""Error bands of rollouts, from calibration scenes: how far nodes can be from where a model predicts them.

The band of a node in a frame is the ball around its predicted position with radius ``factor · scale``. The scale comes from the prediction alone
(``scale_of``). The factor of each frame comes from the errors on calibration scenes (``metrics.conformal``). There are two kinds of factors, with these
guarantees for a new scene that is exchangeable with the calibration scenes, in each frame:

- ``nodes``: the expected fraction of the scene's nodes inside their bands is at least the level.
- ``scene``: with a probability of at least the level, at least this fraction of the scene's nodes is inside. These bands are wider.

Nodes whose motion is given do not count, and neither do nodes that are not in an open scene at the frame (``metrics.compared``). A frame in which no node
counts is covered.

Both hold on average over calibration sets, for one frame at a time and not for all frames at once. They do not hold for scenes unlike the calibration scenes.

``python -m gpe_pl.evaluate … calibrate=true`` stores bands beside a checkpoint as ``{stem}.bands.json``, and those of an ensemble beside its first checkpoint
as ``{stem}.ensemble_{digest of the checkpoints}.bands.json``. The file holds the checksums of the checkpoints, so bands of other checkpoints are never used.
It is plain JSON.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, field
from hashlib import sha256
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gpe_pl.files import sealed
from gpe_pl.learned.pretrained import checkpoint_path
from gpe_pl.learned.verdicts import checksum
from gpe_pl.metrics import compared, displacement
from gpe_pl.metrics.conformal import conformal_factor, conformal_factor_of_nodes
from gpe_pl.metrics.open_scenes import places
from gpe_pl.trajectory.trajectory import Trajectory

log = logging.getLogger(__name__)

Guarantee = Literal["nodes", "scene"]
"""What bands promise: a fraction of the nodes on average, or this fraction with a probability."""
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Nominal coverages of stored bands."""
LEVEL = 0.9
"""Nominal coverage of bands if nothing else is said."""
FLOOR_SPACINGS = 0.01
"""Scale of a node on which the members of an ensemble agree [spacings]."""
DIGITS = 4
"""Significant digits of stored numbers. Factors are rounded up, so that rounding loses no coverage."""


@dataclass(frozen=True, config={"extra": "forbid", "strict": True})
class Bands:
    """Factors of error bands.

    Attributes:
        checkpoints: SHA-256 of each member's checkpoint.
        dataset, split: name of the calibration data, and their split.
        split_checksum: checksum of the calibration scenes.
        num_scenes: number of calibration scenes.
        start_frame: frame of the scenes at which rollouts start.
        frame_dt: time between frames [s].
        containment: whether rollouts are contained in walls.
        settings: other settings with which rollouts differ from those of the model by default, by key.
        spacing: rest spacing of nodes [m]; None in earlier files.
        scenes: identities of the calibration scenes (see ``identity``); empty in earlier files.
        nodes, scene: factors of frames 1, 2, … by level; None where there are too few scenes, or too many rollouts failed.
        spread: largest mean spread of an ensemble over the nodes of a calibration scene whose rollout reaches the frame, in frames 1, 2, … [m]; empty for a
            single model.
        features: lowest and highest values of features in calibration scenes, by name (see ``unlike``).
    """

    checkpoints: list[str]
    dataset: str
    split: str
    split_checksum: str
    num_scenes: int
    start_frame: int
    frame_dt: float
    containment: bool
    nodes: dict[str, list[float | None]]
    scene: dict[str, list[float | None]]
    spread: list[float]
    features: dict[str, tuple[float, float]]
    settings: dict[str, bool | int | float] = field(default_factory=dict)
    spacing: float | None = None
    scenes: list[str] = field(default_factory=list)

    @property
    def num_frames(self) -> int:
        """Number of calibrated frames after the start."""
        return len(self.nodes[f"{LEVELS[0]:g}"])

    def factors(self, level: float, guarantee: Guarantee = "nodes") -> Float[np.ndarray, " frame"]:
        """Return the factors of frames 0, 1, …; the factor of frame 0 is 0.

        Raises:
            ValueError: bands of this level are not stored, or there is no such guarantee.
        """
        if guarantee not in get_args(Guarantee):
            raise ValueError(f"guarantee={guarantee!r}: must be {' or '.join(get_args(Guarantee))}")
        stored = self.nodes if guarantee == "nodes" else self.scene
        if f"{level:g}" not in stored:
            raise ValueError(f"level={level:g}: bands are stored for {', '.join(stored)}")
        return np.array([0.0, *(math.inf if factor is None else factor for factor in stored[f"{level:g}"])])

    def radius(
        self,
        prediction: Trajectory,
        spread: Float[np.ndarray, "frame node"] | None = None,
        level: float = LEVEL,
        guarantee: Guarantee = "nodes",
    ) -> Float[np.ndarray, "frame node"]:
        """Return the radii of the bands [m]. They are infinite in frames without calibration, and 0 for nodes whose motion is given.

        Args:
            prediction: rollout from ``start_frame`` of its scene on.
            spread: spread of an ensemble's members [m]; None for a single model.
            level: one of ``LEVELS``.
            guarantee: what the bands promise.

        Raises:
            ValueError: bands of this level are not stored, or bands of an ensemble are used without its spread.
        """
        if (spread is None) != (len(self.checkpoints) == 1):
            raise ValueError("bands of an ensemble need its spread; bands of a single model go without")
        factors = self.factors(level, guarantee)[: prediction.num_frames]
        factors = np.pad(factors, (0, prediction.num_frames - len(factors)), constant_values=math.inf)
        return np.where(prediction.is_predicted, factors[:, None] * scale_of(prediction, spread), 0.0)

    def unfit(
        self,
        start_frame: int,
        frame_dt: float,
        spacing: float,
        containment: bool,
        settings: Mapping[str, bool | int | float],
        split_checksum: str,
    ) -> str:
        """Return why the bands promise nothing for rollouts of a split, in words for a message; an empty text if they do."""
        if split_checksum == self.split_checksum:
            return "these scenes are the calibration scenes"
        if not math.isclose(frame_dt, self.frame_dt, rel_tol=1e-6):
            return f"frames are {frame_dt:g} s long, in calibration {self.frame_dt:g} s"
        if self.spacing is not None and not math.isclose(spacing, self.spacing, rel_tol=1e-3):
            return f"nodes are {spacing:g} m apart, in calibration {self.spacing:g} m"
        for key in {**self.settings, **settings}:
            own, known = (values.get(key, "the default") for values in (settings, self.settings))
            if own != known:
                return f"{key} is {str(own).lower()}, in calibration {str(known).lower()}"
        if start_frame != self.start_frame:
            return f"rollouts start at frame {start_frame}, in calibration at frame {self.start_frame}"
        if containment != self.containment:
            return f"evaluation.containment={str(containment).lower()}, in calibration {str(self.containment).lower()}"
        return ""


def identity(truth: Trajectory) -> str:
    """Return a digest of the first frame of a scene and of its material parameters, by which a scene is known again in another split or data set."""
    values = (truth.pos[0], truth.vel[0], truth.material_params)
    return sha256(b"".join(np.ascontiguousarray(own).tobytes() for own in values)).hexdigest()[:16]


def scale_of(prediction: Trajectory, spread: Float[np.ndarray, "frame node"] | None) -> Float[np.ndarray, "frame node"]:
    """Return how uncertain the predicted positions of nodes are relative to each other in a frame [m].

    It is one spacing for a single model, so that all nodes have the same band in a frame. For an ensemble, it is
    √(spread · spacing) plus ``FLOOR_SPACINGS`` spacings: errors grow more slowly than the spread.
    """
    spacing = prediction.metadata.spacing
    return np.full(prediction.pos.shape[:2], spacing) if spread is None else np.sqrt(spread * spacing) + FLOOR_SPACINGS * spacing


def errors_of(prediction: Trajectory, truth: Trajectory) -> Float[np.ndarray, "frame node"]:
    """Return the distances of the nodes of the ground truth from it [m].

    They are infinite in frames that a stopped rollout lacks, and NaN for nodes that do not count (``metrics.compared``).
    """
    prediction = prediction.with_nodes_of(truth)
    distance = np.linalg.norm(displacement(places(prediction), places(truth)[: prediction.num_frames], truth.metadata), axis=-1)
    missing = truth.num_frames - prediction.num_frames
    distance = np.pad(distance, ((0, missing), (0, 0)), constant_values=math.inf)
    return np.where(compared(prediction, truth), np.where(np.isfinite(distance), distance, math.inf), math.nan)


def of_nodes_in(truth: Trajectory, values: Float[np.ndarray, "some_frames some_nodes"], filling: float) -> Float[np.ndarray, "frame node"]:
    """Return values of a rollout for all frames and nodes of its ground truth; those that a stopped rollout lacks are ``filling``."""
    missing = [(0, want - have) for want, have in zip(truth.pos.shape[:2], values.shape, strict=True)]
    return np.pad(values, missing, constant_values=filling)


def scores_of(
    prediction: Trajectory, truth: Trajectory, spread: Float[np.ndarray, "some_frames some_nodes"] | None
) -> Float[np.ndarray, "frame node"]:
    """Return errors over scales, for each frame of the ground truth and each node; NaN for nodes that do not count."""
    return errors_of(prediction, truth) / of_nodes_in(truth, scale_of(prediction, spread), 1.0)


def factors_of(scores: Sequence[Float[np.ndarray, "frame _"]], guarantee: Guarantee) -> dict[str, list[float | None]]:
    """Return the factors of frames 1, 2, … by level, as stored in ``Bands``. Frames that not all scenes have are left out.

    Args:
        scores: results of ``scores_of`` for each calibration scene.
        guarantee: what the bands promise.
    """
    num_frames = min(len(score) for score in scores)
    found: dict[str, list[float | None]] = {}
    for level in LEVELS:
        factors = []
        for frame in range(1, num_frames):
            counted = [score[frame][~np.isnan(score[frame])] for score in scores]
            of_frame = [own if len(own) else np.zeros(1) for own in counted]
            if guarantee == "nodes":
                factors.append(conformal_factor_of_nodes(of_frame, level))
            else:
                factors.append(conformal_factor([float(np.quantile(s, level, method="inverted_cdf")) for s in of_frame], level))
        found[f"{level:g}"] = [rounded_up(factor) if math.isfinite(factor) else None for factor in factors]
    return found


def rounded_up(value: float) -> float:
    """Return a number with ``DIGITS`` significant digits that is not smaller."""
    if value == 0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - DIGITS)
    return float(f"{math.ceil(value / unit) * unit:.{DIGITS}g}")


def path_beside(checkpoints: Sequence[Path | str]) -> Path:
    """Return the path of the bands of a model, or of an ensemble."""
    first, several = checkpoint_path(checkpoints[0]), ""
    if len(checkpoints) > 1:  # ensembles of the same first member keep their own bands
        several = ".ensemble_" + sha256(" ".join(checksum(checkpoint_path(c)) for c in checkpoints).encode()).hexdigest()[:8]
    return first.with_name(f"{first.stem}{several}.bands.json")


def write(path: Path, bands: Bands) -> None:
    """Write bands to a file, atomically and with a checksum."""
    sealed.write(path, asdict(bands))  # type: ignore[call-overload]


def read(*checkpoints: Path | str) -> Bands | None:
    """Return the bands of a model, given its checkpoint, or of an ensemble, given all. Return None if there are none, or if they are of other checkpoints.

    Raises:
        SealError: the file is damaged, or holds something else; the message names it.
        OSError: the file cannot be read.
    """
    path = path_beside(checkpoints)
    if not path.exists():
        return None
    advice = "delete it, and calibrate again with `python -m gpe_pl.evaluate … calibrate=true`"
    values = sealed.read(path, advice)
    try:
        bands = TypeAdapter(Bands).validate_json(json.dumps(values))
    except ValidationError as error:
        fault = error.errors()[0]
        raise sealed.SealError(f"{path}: {'.'.join(map(str, fault['loc']))}: {fault['msg']}; {advice}") from None
    if bands.checkpoints != [checksum(checkpoint_path(c)) for c in checkpoints]:
        log.warning("%s: holds error bands of another checkpoint than the one beside it, which are not used; %s", path, advice)
        return None
    return bands
