"""Writes input decks of a cantilever, a clamped plate and a quarter of a plate under load, and runs CalculiX on them.

``python docs/fem_decks.py cantilever FOLDER`` writes ``FOLDER/{train,val,test}/NAME.inp``, and results beside them if ``ccx`` is installed (on Debian
``apt-get install calculix-ccx``). ``python -m gpe_pl.convert format=calculix source=FOLDER`` imports them. Young's modulus and the load differ between scenes.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

COUNTS = {"train": 20, "val": 2, "test": 4}
CCX = "ccx"


@dataclass(frozen=True)
class Case:
    """A block of hexahedra that is held at some sides and loaded along its last axis.

    Attributes:
        cells: number of cells along each axis.
        size: width of a cell [m].
        support: clamp the low ``end`` along x; all four ``sides``; or, for a ``quarter`` of a plate, the sides that are high along x and y, with rollers at
            the low ones, which are planes of symmetry.
        modulus, poisson_ratio, density: Young's modulus [Pa], Poisson's ratio and density [kg/m³].
        load: total force [N], or pressure [Pa] on the upper side of a quarter. It rises within ``rise`` [s] and then stays.
        element: kind of the hexahedra in CalculiX. C3D8I bends without locking, C3D8 is the plain one.
        frame_dt, num_frames: time between results [s] and their number.
    """

    cells: tuple[int, int, int]
    size: float
    support: Literal["end", "sides", "quarter"]
    modulus: float
    load: float
    frame_dt: float
    num_frames: int
    rise: float = 0.02
    poisson_ratio: float = 0.3
    density: float = 1000.0
    element: str = "C3D8I"


CASES = {
    "cantilever": Case((16, 2, 2), 0.01, "end", 1e6, -0.05, 4e-3, 60),
    "plate": Case((12, 12, 1), 0.015, "sides", 1e6, -20.0, 2e-3, 50),
    "quarter": Case((8, 8, 2), 0.01, "quarter", 1e6, 4000.0, 2e-3, 50),
}


def deck(case: Case) -> str:
    """Return the text of an input deck."""
    number = np.arange(np.prod([n + 1 for n in case.cells])).reshape([n + 1 for n in case.cells]) + 1
    points = case.size * np.argwhere(number > 0)
    low, high = slice(None, -1), slice(1, None)
    corners = [(low, low), (high, low), (high, high), (low, high)]
    cells = np.stack([number[(*xy, z)] for z in (low, high) for xy in corners], axis=-1).reshape(-1, 8)
    edge = np.zeros(number.shape, bool)
    edge[0 if case.support != "quarter" else -1] = True
    if case.support == "sides":
        edge[-1] = edge[:, 0] = True
    if case.support != "end":
        edge[:, -1] = True
    loaded = number[-1].ravel() if case.support == "end" else number[:, :, -1][~edge[:, :, -1]]
    lines = ["*NODE, NSET=ALL", *(f"{k}, {x:.9g}, {y:.9g}, {z:.9g}" for k, (x, y, z) in enumerate(points, start=1))]
    lines += [f"*ELEMENT, TYPE={case.element}, ELSET=BODY", *(f"{k}, {', '.join(map(str, own))}" for k, own in enumerate(cells, start=1))]
    lines += ["*NSET, NSET=CLAMPED", *(f"{node}," for node in number[edge])]
    lines += ["*NSET, NSET=LOADED", *(f"{node}," for node in loaded.ravel())]
    lines += ["*MATERIAL, NAME=RUBBER", "*ELASTIC", f"{case.modulus:.9g}, {case.poisson_ratio}", "*DENSITY", f"{case.density}"]
    lines += ["*SOLID SECTION, ELSET=BODY, MATERIAL=RUBBER", "*AMPLITUDE, NAME=RISE", f"0., 0., {case.rise}, 1., 1000., 1."]
    lines += ["*BOUNDARY", "CLAMPED, 1, 3"]
    if case.support == "quarter":
        lines += ["*NSET, NSET=ALONG_X", *(f"{node}," for node in number[0].ravel()), "*NSET, NSET=ALONG_Y"]
        lines += [*(f"{node}," for node in number[:, 0].ravel()), "*BOUNDARY", "ALONG_X, 1", "ALONG_Y, 2"]
        top = 1 + np.arange(len(cells)).reshape(case.cells)[:, :, -1].ravel()
        lines += ["*SURFACE, NAME=TOP", *(f"{cell}, S2" for cell in top)]
    lines += ["*STEP, NLGEOM, INC=100000"]
    lines += ["*DYNAMIC, DIRECT", f"{case.frame_dt:.9g}, {case.frame_dt * case.num_frames:.9g}"]
    if case.support == "quarter":
        lines += ["*DSLOAD, AMPLITUDE=RISE", f"TOP, P, {case.load:.9g}"]
    else:
        lines += ["*CLOAD, AMPLITUDE=RISE", f"LOADED, 3, {case.load / loaded.size:.9g}"]
    lines += ["*NODE FILE, FREQUENCY=1", "U, V", "*EL FILE, FREQUENCY=1", "S", "*END STEP"]
    return "\n".join(lines) + "\n"


def varied(case: Case, seed: int) -> Iterator[Case]:
    """Yield cases whose modulus and load differ by up to a factor of 2 from those of ``case``, either way."""
    random = np.random.default_rng(seed)
    while True:
        stiffer, stronger = 2.0 ** random.uniform(-1, 1, 2)
        yield replace(case, modulus=case.modulus * stiffer, load=case.load * stronger)


def run(path: Path) -> None:
    """Run CalculiX on a deck, and remove its files except for deck and results."""
    done = subprocess.run([CCX, "-i", path.stem], cwd=path.parent, capture_output=True, text=True)
    if done.returncode or not path.with_suffix(".frd").exists():
        sys.exit(f"{path}: CalculiX failed:\n{done.stdout[-1000:]}")
    for other in path.parent.glob(f"{path.stem}.*"):
        if other.suffix not in (".inp", ".frd"):
            other.unlink()
    (path.parent / "spooles.out").unlink(missing_ok=True)


def main() -> None:
    """Write the decks that the command line asks for, and run them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", choices=CASES)
    parser.add_argument("folder", type=Path)
    chosen = parser.parse_args()
    cases = varied(CASES[chosen.case], seed=0)
    if shutil.which(CCX) is None:
        print(f"{CCX} is not installed; only decks are written (Debian: apt-get install calculix-ccx)")
    for split, count in COUNTS.items():
        (chosen.folder / split).mkdir(parents=True, exist_ok=True)
        for k in range(count):
            path = chosen.folder / split / f"{chosen.case}_{k:02d}.inp"
            path.write_text(deck(next(cases)))
            if shutil.which(CCX) is not None:
                run(path)


if __name__ == "__main__":
    main()
