"""Training scenes that models chose: which ones a data set has, and how they were chosen.

Scenes of the split ``train`` have numbers, from which their seeds and parameter values follow. A data set without choices has the numbers 0, 1, 2, …; a choice
adds others. The file ``chosen_scenes.json`` beside ``dataset.json`` lists all choices in their order, so that the scenes of a data set stay the same when it
grows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from gpe_pl.files import sealed

SPEC_FILE = "dataset.json"
CHOICES_FILE = "chosen_scenes.json"
ADVICE = "delete the folder of the data set, and simulate it again"


@dataclass(frozen=True, config={"extra": "forbid"})
class Choice:
    """Scenes that came to a data set together.

    Attributes:
        scenes: numbers of the scenes.
        models: fingerprints of the models that chose them; none for the scenes of the data set before its first choice.
        num_candidates: number of scenes among which was chosen.
        num_frames: number of predicted frames.
        spread: disagreement of the models in each scene [spacings] (see ``evaluation.active``).
        median_spread: median of the disagreement over all candidates [spacings].
    """

    scenes: list[int]
    models: list[str]
    num_candidates: int
    num_frames: int
    spread: list[float]
    median_spread: float


def read(folder: Path) -> list[Choice]:
    """Return the choices of a data set; none if nothing was chosen.

    Raises:
        SealError: the file is damaged.
    """
    path = folder / CHOICES_FILE
    if not path.is_file():
        return []
    values = sealed.read(path, ADVICE)
    try:
        return TypeAdapter(list[Choice]).validate_python(values.get("choices"))
    except ValidationError as error:
        raise sealed.SealError(f"{path}: does not list choices ({error.error_count()} faults); {ADVICE}") from None


def write(folder: Path, choices: Sequence[Choice]) -> None:
    """Write the choices of a data set."""
    folder.mkdir(parents=True, exist_ok=True)
    sealed.write(folder / CHOICES_FILE, {"choices": [asdict(choice) for choice in choices]})  # type: ignore[call-overload]


def scene_numbers(stored: dict[str, Any]) -> list[int]:
    """Return the numbers of the training scenes in the stored specification of a data set."""
    chosen = stored.get("train_scenes")
    return [*chosen] if isinstance(chosen, list) else [*range(int(stored.get("num_train", 0)))]
