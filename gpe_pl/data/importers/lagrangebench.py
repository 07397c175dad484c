"""Importer of the particles of LagrangeBench, which has periodic domains.

``source`` is a folder with ``metadata.json`` and ``train.h5``, ``valid.h5`` and ``test.h5``. A file has a group per trajectory with ``position`` (float32
[frame, node, dim]) and ``particle_type`` ([node]; −1 padding, 0 fluid, 1 solid wall, 2 moving wall, 3 rigid body). The time between frames is
``dt × write_every``. Lengths and times are in units of the case, which are stored as m and s. The reference density is 1, so ``viscosity`` is kinematic.

Moving walls slide steadily along a periodic axis. They are stored at their first position, with their velocity. A file ``force.py`` in the folder is code and
is never run. The force of a dam break is gravity. Other forces, whose magnitude is ``g_ext_magnitude``, depend on the place and are not stored. Models without
absolute positions cannot learn them.

Source: Toshev et al. 2023, and the layout that github.com/tumaer/lagrangebench writes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from gpe_pl.data.importers import hdf5
from gpe_pl.data.importers.source import (
    SMALLEST,
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Refusal,
    Repair,
    Source,
    bounds_in,
    build,
    count_in,
    length_warning,
    number,
    read_json,
    typed,
)
from gpe_pl.data.importers.split_places import split_files
from gpe_pl.schema import STICKY

PADDING = -1
"""Particle type of padding nodes."""
TYPES = {0: "fluid", 1: "boundary", 2: "boundary", 3: "solid"}
DAM_BREAKS = ("DAM", "DB")
"""Values of ``case`` in dam breaks."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such files, one is damaged, or ``metadata.json`` lacks a value.
    """
    files, unread = split_files(path, (".h5",))
    folder = path if path.is_dir() else path.parent
    described = folder / "metadata.json"
    values = read_json(described)
    bounds = bounds_in(values, described)
    dim = len(bounds)
    periodic = values.get("periodic_boundary_conditions")
    if not isinstance(periodic, list) or len(periodic) < dim or not all(isinstance(p, bool) for p in periodic):
        raise ImportFailure(f"{described}: periodic_boundary_conditions = {periodic!r}, expected true or false for each of {dim} axes")
    notes, gravity = [], (0.0,) * dim
    strength = number({"g_ext_magnitude": 0.0, **values}, "g_ext_magnitude", described)
    if strength and values.get("case") in DAM_BREAKS:
        gravity = (0.0, -strength, 0.0)[:dim]
    elif strength:
        notes.append(
            f"an external force of magnitude {strength:g} that depends on the place: models without absolute positions cannot learn it"
        )
    if (folder / "force.py").exists():
        notes.append("force.py is code and was not run")
    parameters = {}
    if "viscosity" in values:
        viscosity = number(values, "viscosity", described, low=0.0)
        if viscosity > 0:
            parameters["fluid"] = viscosity
        else:
            notes.append("viscosity is 0, which cannot be stored: models take its logarithm (parameters={fluid: …})")
    if "write_every" not in values:
        notes.append("write_every is not in the source; every step of dt is taken for a frame (frame_dt=…)")
    facts = Facts(
        number(values, "dt", described, low=SMALLEST) * number({"write_every": 1, **values}, "write_every", described, low=1.0),
        bounds,
        tuple(periodic[:dim]),
        gravity,
        number(values, "dx", described, low=SMALLEST) if "dx" in values else None,
        number(values, "default_connectivity_radius", described, low=SMALLEST),
        parameters=parameters,
        notes=tuple(notes),
    ).overridden(settings)
    friction = 0.0 if values.get("free_slip") else STICKY

    lengths = {split: count_in(values, f"sequence_length_{split}", described) for split in ("train", "test")}
    most = count_in(values, "num_particles_max", described)

    def load(split: str, file: Path, name: str, facts: Facts) -> Loaded:
        with hdf5.opened(file) as opened:
            pos = hdf5.array(opened[name], "position", "frame, node, dim", "f")
            types = hdf5.array(opened[name], "particle_type", "node", "iu")
        if pos.shape[1:] != (len(types), dim):
            raise Refusal(f"position is {list(pos.shape)} for {len(types)} particle types in {dim}D")
        real = types != PADDING
        warnings = length_warning(len(pos), f"sequence_length_{split}", lengths.get(split))
        if most is not None and real.sum() > most:
            warnings.append(f"has {real.sum()} nodes, num_particles_max = {most}")
        nodes = typed(pos[:, real], types[real], TYPES, settings, friction=friction, warnings=warnings)
        if not real.all():
            nodes.repairs.append(Repair(f"{int((~real).sum())} padding nodes left out"))
        return build(nodes, facts)

    splits = {split: [Item(name, partial(load, split, file, name)) for name in hdf5.groups(file)] for split, file in files.items()}
    counts = {f"num_trajs_{split}": len(splits[split]) for split in ("train", "test") if split in splits}
    warnings = [
        f"{key} = {stated} in {described.name}, but the file holds {found} trajectories: is it complete?"
        for key, found in counts.items()
        if (stated := count_in(values, key, described)) not in (None, found)
    ]
    if values.get("dim", dim) != dim:
        warnings.append(f"dim = {values['dim']!r} in {described.name}, but bounds have {dim} axes, as the data must")
    return Source(facts, splits, (*unread, *warnings))
