"""Splits of a source that differ from its own: by list, by leaving one trajectory out, or for a source with a lone split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from gpe_pl.data.importers.source import ImportFailure, ImportSettings, Item, Source
from gpe_pl.schema import SPLITS

LEFT_OUT = "test"
"""Split of the trajectory that ``leave_out`` names."""


def arranged(source: Source, settings: ImportSettings) -> Source:
    """Return a source with the splits that the settings ask for.

    ``splits`` and ``leave_out`` number the trajectories of all splits of the source together, from 0, in the order of ``schema.SPLITS``. Trajectories that
    ``splits`` does not list become ``train``; if it lists ``train``, they are left out. A source with one split, which is not ``train``, trains on it.

    Raises:
        ImportFailure: a number does not exist or is in two splits, or both settings are given.
    """
    found = [split for split in SPLITS if source.splits.get(split)]
    every = [item for split in found for item in source.splits[split]]
    if settings.splits is not None and settings.leave_out is not None:
        raise ImportFailure("splits and leave_out: give only one of them")
    wanted: Any = {LEFT_OUT: [settings.leave_out]} if settings.leave_out is not None else settings.splits
    if wanted is not None:
        return replace(source, splits=_listed(every, wanted, "leave_out" if settings.leave_out is not None else "splits"))
    if len(found) == 1 and found[0] != "train":
        note = f"the source has only {found[0]}, which became train; other splits are taken from its end (holdout=…), or chosen with splits=… or leave_out=…"
        return replace(source, splits={"train": every}, warnings=(*source.warnings, note))
    return source


def _listed(every: Sequence[Item], wanted: Mapping[str, list[int]], key: str) -> dict[str, list[Item]]:
    """Return the trajectories of each split, given their numbers; see ``arranged``."""
    place: dict[int, str] = {}
    for split, numbers in wanted.items():
        for number in numbers:
            if not 0 <= number < len(every):
                raise ImportFailure(f"{key}: there is no trajectory {number}; the source has 0 to {len(every) - 1}")
            if number in place:
                raise ImportFailure(f"{key}: trajectory {number} is in {place[number]} and in {split}")
            place[number] = split
    others = [] if "train" in wanted else [k for k in range(len(every)) if k not in place]
    numbers_of = {"train": others, **wanted}
    return {split: [every[k] for k in numbers_of[split]] for split in SPLITS if numbers_of.get(split)}
