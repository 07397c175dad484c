"""Faults of checkpoints: damaged files, files of another model, and files that carry code.

The functions ``load_…`` write a faulty checkpoint, made from the ``sound`` one, into the empty folder ``folder``. They load it and return the verdict.
"""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch

from gpe_pl.benchmarks.faults.stores import damages
from gpe_pl.benchmarks.faults.verdict import Fault, Verdict, verdict_of
from gpe_pl.learned.simulator import LearnedSimulator

MAX_WEIGHTS = 16
"""Approximate number of weights that are removed or made not finite; the others are stored in the same way."""
TRACE = "executed"
"""Name of the file that an executed payload creates."""


def load_damaged(sound: Path, damage: Callable[[bytes], bytes], folder: Path) -> Verdict:
    """Load a checkpoint whose bytes were damaged."""
    path = folder / sound.name
    path.write_bytes(damage(sound.read_bytes()))
    return verdict_of(lambda: LearnedSimulator.from_checkpoint(path), partial(_has_weights, _weights(sound)))


@cache
def _weights(sound: Path) -> dict[str, torch.Tensor]:
    return LearnedSimulator.from_checkpoint(sound).state_dict()


def _has_weights(expected: dict[str, torch.Tensor], simulator: LearnedSimulator) -> bool:
    own = simulator.state_dict()
    return own.keys() == expected.keys() and all(torch.equal(own[k], v) for k, v in expected.items())


# --- another model ------------------------------------------------------------------------------------------------------------------------

OTHER_MODELS: tuple[tuple[str, Any], ...] = (
    ("model", "gpe_pl.models.gns.GNS"),
    ("model", "gpe_pl.models.cconv.ContinuousConvNet"),
    ("model", "gpe_pl.models.nothing.GPE"),
    ("model", "os.system"),
    ("model", "gpe_pl.models.gpe.os.system"),
    ("model", 7),
    ("settings", {"hidden_channels": 17}),
    ("settings", {"hidden_channels": -1}),
    ("settings", {"hidden_channels": "many"}),
    ("settings", {"hidden_channels": 10**9}),
    ("settings", {"num_message_passing_steps": 5}),
    ("settings", {"unheard_of": 1}),
    ("settings", {"interaction": "none"}),
    ("settings", 3),
    ("graph", {"history": 3}),
    ("graph", {"history": -3}),
    ("graph", {"unheard_of": 1}),
    ("graph", None),
    ("metadata", {"materials": ("sand", "snow")}),
    ("metadata", {"materials": ("lava",)}),
    ("metadata", {"spacing": float("nan")}),
    ("metadata", {"bounds": ()}),
    ("metadata", {"frame_dt": "soon"}),
    ("metadata", None),
    ("format", 0),
    ("format", None),
)


def load_changed(sound: Path, key: str, value: Any, folder: Path) -> Verdict:
    """Load a checkpoint in whose description the entry ``key`` is replaced by ``value``."""
    stored = torch.load(sound, weights_only=True)
    description = stored["simulator"]
    changed = {**description[key], **value} if isinstance(value, dict) and isinstance(description[key], dict) else value
    return _load_saved({**stored, "simulator": {**description, key: changed}}, folder)


def load_without(sound: Path, key: str, folder: Path) -> Verdict:
    """Load a checkpoint without ``key``: the name of a weight, ``state_dict`` (all weights), or ``simulator`` (the description)."""
    stored = torch.load(sound, weights_only=True)
    if key in stored:
        del stored[key]
    else:
        del stored["state_dict"][key]
    return _load_saved(stored, folder)


def load_content(content: Any, folder: Path) -> Verdict:
    """Load a PyTorch file that is not a checkpoint."""
    return _load_saved(content, folder)


def load_not_finite(sound: Path, key: str, value: float, folder: Path) -> Verdict:
    """Load a checkpoint in which a number of the weight ``key`` is replaced by ``value``, which is not finite."""
    stored = torch.load(sound, weights_only=True)
    stored["state_dict"][key].view(-1)[0] = value
    return _load_saved(stored, folder)


def _load_saved(content: Any, folder: Path) -> Verdict:
    path = folder / "other.ckpt"
    torch.save(content, path)
    return verdict_of(lambda: LearnedSimulator.from_checkpoint(path), lambda _: False)


# --- code ---------------------------------------------------------------------------------------------------------------------------------


class Payload:
    """Object that calls a function when it is unpickled."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def payload(kind: str, folder: Path) -> Payload:
    """Return an object whose code creates a file, in one of several ways."""
    trace = str(folder / TRACE)
    found: dict[str, Payload] = {
        "system": Payload(os.system, f"touch {trace}"),
        "eval": Payload(eval, f"open({trace!r}, 'w')"),
        "exec": Payload(exec, f"open({trace!r}, 'w')"),
        "open": Payload(open, trace, "w"),
        "mkdir": Payload(os.mkdir, trace),
        "touch": Payload(Path.touch, Path(trace)),
    }
    return found[kind]


PAYLOADS = ("system", "eval", "exec", "open", "mkdir", "touch")
PLACES = ("whole", "description", "settings", "weights", "optimizer", "key", "pickle", "pickle in zip")


def load_hostile(sound: Path, kind: str, place: str, folder: Path) -> Verdict:
    """Load a checkpoint that contains code of a ``kind`` (see ``payload``) at a ``place``, such as ``whole`` or ``settings``."""
    code, path = payload(kind, folder), folder / "hostile.ckpt"
    stored = torch.load(sound, weights_only=True)
    if place == "whole":
        stored = code
    elif place == "description":
        stored["simulator"] = code
    elif place == "settings":
        stored["simulator"]["settings"]["hidden_channels"] = code
    elif place == "weights":
        stored["state_dict"]["simulator.model.extra"] = code
    elif place == "optimizer":
        stored["optimizer_states"] = [{"state": code}]
    elif place == "key":
        stored[code] = 1
    if place == "pickle":
        path.write_bytes(pickle.dumps(code))
    elif place == "pickle in zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps(code, protocol=2))
            archive.writestr("archive/version", "3\n")
    else:
        torch.save(stored, path)
    (folder / TRACE).unlink(missing_ok=True)
    verdict = verdict_of(lambda: LearnedSimulator.from_checkpoint(path), lambda _: False)
    return Verdict("executed", f"{kind} in {place}") if (folder / TRACE).exists() else verdict


def _others(sound: Path) -> Iterator[tuple[str, str, Callable[[Path], Verdict]]]:
    for key, value in OTHER_MODELS:
        yield "checkpoint, another model", f"{key}: {value}", partial(load_changed, sound, key, value)
    stored = torch.load(sound, weights_only=True)
    weights = [k for k, v in stored["state_dict"].items() if v.is_floating_point() and v.numel() and "trained_" not in k]
    weights = weights[:: max(1, len(weights) // MAX_WEIGHTS)]
    for key in ("simulator", "state_dict", *weights):
        yield "checkpoint, something missing", key, partial(load_without, sound, key)
    for key in weights:
        for value in (float("nan"), float("inf")):
            yield "checkpoint, not finite", f"{key}: {value}", partial(load_not_finite, sound, key, value)
    contents: tuple[Any, ...] = (torch.zeros(3), [1, 2], {}, 5, "text", None, {"simulator": None}, {"simulator": {}, "state_dict": []})
    for content in contents:
        yield "checkpoint, another model", f"content {content}", partial(load_content, content)
    for kind in PAYLOADS:
        for place in PLACES:
            yield "checkpoint, code in it", f"{kind} in {place}", partial(load_hostile, sound, kind, place)


def faults(sound: Path, num_damages: int, seed: int = 0) -> list[Fault]:
    """Return faults of a checkpoint: damaged bytes of a sound one, and files with other content."""
    found = [Fault(f"checkpoint, {kind}", name, partial(load_damaged, sound, damage)) for kind, name, damage in damages(num_damages, seed)]
    return found + [Fault(*other) for other in _others(sound)]
