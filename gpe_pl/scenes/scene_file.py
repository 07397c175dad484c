"""Scene files: a ``Scene`` as YAML.

Example::

    box: [1.0, 1.0]
    bodies:
      - {block: sand, at: [0.1, 0.0], size: [0.2, 0.4], friction_angle: 30}
    obstacles:
      - {circle: [0.7, 0.2], radius: 0.1}
      - {mesh: part.stl, at: [0.4, 0.0], size: 0.2}
    openings:
      - {inlet: sand, side: y_high, at: [0.4, 0.8], size: [0.1, 0.2], speed: 1.0}
      - {outlet: x_high, at: [0.9, 0.0], size: [0.1, 1.0]}

Keys are the arguments of ``Scene`` and its methods. The first key of a part names its kind, and holds the first argument. Paths are relative to the scene file.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from gpe_pl.errors.printable import did_you_mean
from gpe_pl.geometry.shapes import Box, Polygon
from gpe_pl.scenes.obstacles import FRICTION, Circle
from gpe_pl.scenes.scene import Scene, SceneFault

MOST_BYTES = 1_000_000
"""Largest scene file [bytes]."""
LISTS = ("bodies", "obstacles", "openings")
TOP = ("box", "gravity", "friction", "title", "seed", "spacing", "frame_dt", *LISTS)
BODIES = ("block", "ball", "polygon", "image")
OPENINGS = ("inlet", "outlet")


class _Loader(yaml.SafeLoader):
    """Loader of YAML that refuses a key given twice, and reads 1e5 as a number. YAML 1.1 takes the last value of a key, and reads 1e5 as text."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        lines: dict[Any, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key.value, str):
                raise SceneFault({f"line {line}": "a key must be a word"})
            if lines.setdefault(key.value, line) != line:
                raise SceneFault({str(key.value): f"occurs in line {lines[key.value]} and again in line {line}; put all into one"})
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789"))


def _box(low: Any, high: Any, friction: float = FRICTION) -> Box:
    return Box(tuple(map(float, low)), tuple(map(float, high)), float(friction))


def _polygon(corners: Any, friction: float = FRICTION) -> Polygon:
    return Polygon(tuple((float(x), float(y)) for x, y in corners), float(friction))


SHAPES: dict[str, Callable[..., Any]] = {"circle": Circle, "box": _box, "polygon": _polygon}


def read_scene(path: Path | str) -> Scene:
    """Return the scene in a file.

    Raises:
        SceneFault: the file cannot be read, or a key or value is wrong; the message names it.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise SceneFault({str(path): f"has more than {MOST_BYTES:,} bytes, too many for a scene"})
        values = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # a SafeLoader
    except FileNotFoundError:
        raise SceneFault({str(path): f"no such file (searched from {Path.cwd()})"}) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        raise SceneFault(
            {str(path): f"is no YAML{f', at line {mark.line + 1}' if mark else ''}: {getattr(error, 'problem', error)}"}
        ) from None
    if not isinstance(values, Mapping):
        raise SceneFault({str(path): "must be a table with the keys box and bodies"})
    for key in values:
        if key not in TOP:
            raise SceneFault({str(key): f"unknown key{did_you_mean(str(key), TOP)}; keys are {', '.join(TOP)}"})
    if "box" not in values:
        raise SceneFault({"box": "is missing; give the sides [m], such as box: [1.0, 1.0]"})
    given = {key: value for key, value in values.items() if key not in LISTS}
    scene = Scene(**{**given, "title": str(given.get("title", path.stem))})
    for number, part in enumerate(_list(values, "bodies"), 1):
        kind, first, given = _kind(f"bodies, part {number}", part, BODIES)
        material = str(first)
        if kind == "image":
            given["path"] = path.parent / str(given.get("path", ""))
        where = f"{kind} {number} ({material})"
        scene = _called(where, getattr(scene, kind), (material,), given)
    for number, part in enumerate(_list(values, "obstacles"), 1):
        where = f"obstacle {number}"
        kind, first, given = _kind(where, part, (*SHAPES, "mesh"))
        if kind == "mesh":
            scene = _called(where, scene.obstacle, (), {**given, "mesh": path.parent / str(first)}, without=("shape",))
        else:
            scene = scene.obstacle(_called(where, SHAPES[kind], (first,), given))
    for number, part in enumerate(_list(values, "openings"), 1):
        kind, first, given = _kind(f"openings, part {number}", part, OPENINGS)
        where = f"{kind} {number}" + (f" ({first})" if kind == "inlet" else "")
        scene = _called(where, getattr(scene, kind), (str(first),), given)
    return scene


def _list(values: Mapping[str, Any], key: str) -> list[Any]:
    parts = values.get(key) or []
    if not isinstance(parts, list):
        raise SceneFault({key: "must be a list, each part after a dash"})
    return parts


def _kind(where: str, part: Any, known: tuple[str, ...]) -> tuple[str, Any, dict[str, Any]]:
    """Return the kind of a part, the value of this key, and the others."""
    if not isinstance(part, Mapping) or not part:
        raise SceneFault({where: f"must be a table that begins with one of {', '.join(known)}"})
    found = [key for key in part if key in known]
    if len(found) != 1:
        first = str(next(iter(part)))
        raise SceneFault({where: f"needs one of the keys {', '.join(known)}{did_you_mean(first, known) if not found else ''}"})
    return found[0], part[found[0]], {str(key): value for key, value in part.items() if key != found[0]}


def _called(
    where: str, target: Callable[..., Any], arguments: tuple[Any, ...], given: dict[str, Any], without: tuple[str, ...] = ()
) -> Any:
    """Call a target with the values of a part; missing and unknown keys and values of a wrong kind are named."""
    parameters = [p for p in [*inspect.signature(target).parameters.values()][len(arguments) :] if p.name not in without]
    names = [p.name for p in parameters if p.kind is not p.VAR_KEYWORD]
    open_ended = len(names) < len(parameters)
    for key in given:
        if key not in names and not open_ended:
            raise SceneFault({where: f"{key}: unknown key{did_you_mean(key, names)}; keys are {', '.join(names)}"})
    missing = [p.name for p in parameters if p.name in names and p.default is p.empty and p.name not in given]
    if missing:
        misspelt = next((key for key in given if key not in names and did_you_mean(key, missing)), None)
        hint = f"; {misspelt}: unknown key{did_you_mean(misspelt, missing)}" if misspelt else ""
        raise SceneFault({where: f"{', '.join(missing)}: missing{hint}"})
    try:
        return target(*arguments, **given)
    except (TypeError, ValueError) as error:
        if isinstance(error, SceneFault):
            raise
        raise SceneFault({where: f"has a value of a wrong kind ({error})"}) from None
