"""Decks and results of CalculiX become trajectories with clamps, forces, stress and constants of materials; others are refused by name."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.data.importers import ImportFailure, ImportSettings, import_dataset
from gpe_pl.data.importers.pressures import FACES, corner_areas
from gpe_pl.fit import fit
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.quantities import quantities
from gpe_pl.metrics.rollouts import rollout_metrics
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.elastic_motion import LOGARITHM_SCALE
from gpe_pl.rollout.loop import rollout
from gpe_pl.trajectory.store import iter_trajectories
from gpe_pl.trajectory.strain import lame_parameters
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import compose

SIZE, DT, FRAMES = 0.1, 0.01, 6
POINTS = SIZE * np.argwhere(np.ones((3, 2, 2)))
IDS = 101 + 2 * np.arange(12)
"""Numbers of nodes in the files, with gaps."""
CELLS = [[0, 4, 6, 2, 1, 5, 7, 3], [4, 8, 10, 6, 5, 9, 11, 7]]
DECK = """** two cubes
*NODE, NSET=ALL
{nodes}
*ELEMENT, TYPE=C3D8, ELSET=BODY
*NSET, NSET=clamped, GENERATE
101, 107, 2
*NSET, NSET=TIP
117, 119,
121, 123
*MATERIAL, NAME=Rubber
*ELASTIC
2e6, 0.4
*DENSITY
1200.
*SOLID SECTION, ELSET=BODY, MATERIAL=RUBBER
*AMPLITUDE, NAME=RISE
0., 0., 0.02, 1.,
1., 1.
*BOUNDARY
Clamped, 1, 3
*STEP, NLGEOM,
INC=100
*DYNAMIC, DIRECT
0.01, 0.06
*CLOAD, AMPLITUDE=RISE
TIP, 2, -4.
*CLOAD
117, 1, 0.5
*DLOAD
BODY, GRAV, 9.81, 0., 0., -1.
*NODE FILE
U
*END STEP
"""


def row(mark: str, number: int, values: np.ndarray) -> str:
    return f" {mark}{number:10d}" + "".join(f"{value:12.5E}" for value in values)


def displacements(scale: float) -> np.ndarray:
    """Return displacements [frame, node, 3] that grow with the distance from the clamp."""
    time = DT * np.arange(1, FRAMES + 1)[:, None, None]
    return scale * np.sin(40 * time) * (POINTS[:, :1] ** 2) * np.array([0.1, -1.0, 0.3])


def stresses() -> np.ndarray:
    """Return stresses [frame, node, 6] in the order of the files, which tell their place."""
    return 100.0 * np.arange(1, FRAMES + 1)[:, None, None] + 10.0 * np.arange(12)[:, None] + np.arange(6)


def results(moved: np.ndarray, times: np.ndarray, code: int = 1) -> str:
    lines = ["    1C", "    1UMAT    1RUBBER", f"    2C{len(IDS):30d}{1:38d}"]
    lines += [row("-1", int(node), x) for node, x in zip(IDS, POINTS, strict=True)]
    lines += [" -3", f"    3C{2:30d}{1:38d}"]
    for k, cell in enumerate(CELLS, start=1):
        lines += [f" -1{k:10d}{code:5d}{0:5d}{1:5d}", " -2" + "".join(f"{IDS[node]:10d}" for node in cell)]
    lines.append(" -3")
    for time, u, s in zip(times, moved, stresses(), strict=True):
        for name, names, values in (("DISP", ("D1", "D2", "D3", "ALL"), u), ("STRESS", ("SXX", "SYY", "SZZ", "SXY", "SYZ", "SZX"), s)):
            lines += [f"  100CL  101{time:12.5E}{len(IDS):12d}{'':20}{1:1d}{1:5d}{'':10}{1:2d}", f" -4  {name:8}{len(names):5d}    1"]
            lines += [f" -5  {component:8}    1    2    1    0" for component in names]
            lines += [*(row("-1", int(node), x) for node, x in zip(IDS, values, strict=True)), " -3"]
    return "\n".join([*lines, " 9999"]) + "\n"


def without_a_node(results: str) -> str:
    """Remove node 109 from the displacements of one frame, as with NSET."""
    blocks = results.split("  100CL")
    blocks[5] = "\n".join(line for line in blocks[5].split("\n") if not line.startswith(f" -1{109:10d}"))
    assert "DISP" in blocks[5]
    return "  100CL".join(blocks)


def write(folder: Path, edit: Callable[[str], str] = str, edit_results: Callable[[str], str] = str, step: float = DT) -> None:
    nodes = "\n".join(f"{node}, {x:.6g}, {y:.6g}, {z:.6g}" for node, (x, y, z) in zip(IDS, POINTS, strict=True))
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(3):
        times = step * np.arange(1, FRAMES + 1)
        (folder / f"beam_{k}.inp").write_text(edit(DECK.format(nodes=nodes)))
        (folder / f"beam_{k}.frd").write_text(edit_results(results(displacements(1 + k), times)))


def imported(tmp_path: Path, **settings: object) -> list[Trajectory]:
    report = import_dataset(tmp_path / "data", ImportSettings("calculix", str(tmp_path / "raw"), "set", **settings))  # type: ignore[arg-type]
    assert not report.refusals
    return [t for split in report.splits for t in iter_trajectories(tmp_path / "data" / "set" / "imported", split)]


def test_a_computation_becomes_a_trajectory(tmp_path: Path) -> None:
    write(tmp_path / "raw")
    found = imported(tmp_path)
    assert len(found) == 3
    scale = [np.abs(t.pos[1] - t.pos[0]).max() for t in found]
    own, u = found[int(np.argmin(scale))], displacements(1.0)
    assert own.num_frames == FRAMES + 1 and own.metadata.frame_dt == pytest.approx(DT)
    np.testing.assert_allclose(own.pos[1:] - own.pos[:1], u, atol=1e-7)
    assert own.rest_pos is not None and own.cells is not None and own.cell_dim == 3
    np.testing.assert_allclose(own.rest_pos - own.rest_pos[0], POINTS, atol=1e-7)
    assert own.cells.tolist() == CELLS
    assert own.prescribed is not None and own.prescribed.tolist() == [[True] * 3] * 4 + [[False] * 3] * 8
    assert own.metadata.param_names == ("youngs_modulus", "poisson_ratio") and own.metadata.materials == ("solid",)
    np.testing.assert_allclose(own.material_params, np.tile([2e6, 0.4], (12, 1)), rtol=1e-6)
    np.testing.assert_allclose(own.mass, 1200 * SIZE**3 / 8 * np.repeat([1, 2, 1], 4), rtol=1e-6)
    assert own.metadata.gravity == (0.0, 0.0, -9.81)
    force = np.zeros((FRAMES + 1, 12, 3))
    force[:, 8:, 1] = -4.0 * np.array([0.25, 0.75, 1, 1, 1, 1, 1])[:, None]  # means over frames of a rise within two frames
    force[:, 8, 0] = 0.5
    assert own.force is not None
    np.testing.assert_allclose(own.force, force, rtol=1e-6)
    assert own.stress is not None and not own.stress.node[0].any()
    np.testing.assert_array_equal(own.stress.node[2, 3], 230 + np.array([0, 3, 5, 1, 4, 2]))


def test_materials_can_be_named_and_constants_given(tmp_path: Path) -> None:
    write(tmp_path / "raw", lambda deck: deck.replace("*ELASTIC\n2e6, 0.4\n", "*HYPERELASTIC\n1., 2.\n"))
    own, *_ = imported(tmp_path, materials={1: "elastomer"}, parameters={"elastomer": 7e5})
    assert own.metadata.materials == ("elastomer",)
    np.testing.assert_allclose(own.material_params[:, 0], 7e5)


def test_nodes_can_be_held_along_some_axes(tmp_path: Path) -> None:
    write(tmp_path / "raw", lambda deck: deck.replace("Clamped, 1, 3\n", "Clamped, 1, 2\n109, ZSYMM\nTIP, ENCASTRE\n"))
    own, *_ = imported(tmp_path)
    assert own.prescribed is not None
    assert own.prescribed.tolist() == [[True, True, False]] * 4 + [[False, False, True]] + [[False] * 3] * 3 + [[True] * 3] * 4
    assert own.metadata.loads == ("motion", "sliding", "force")


ELEMENTS = "\n".join(f"{k}, {', '.join(str(IDS[node]) for node in cell)}" for k, cell in enumerate(CELLS, start=1))


@pytest.mark.slow
@pytest.mark.parametrize(
    "lines",
    [
        "BODY, GRAV, 9.81, 0., 0., -10.",
        "BODY, GRAV, 9.81, , , -1.,",
        "1, GRAV, 9.81, 0., 0., -1.\n2, GRAV, 9.81, 0., 0., -1.",
        "BODY, GRAV, 5.81, 0., 0., -1.\nBODY, GRAV, 4., 0., 0., -1.",
    ],
)
def test_gravity_adds_up_and_its_direction_is_normalised(tmp_path: Path, lines: str) -> None:
    """As in CalculiX, which leaves empty fields 0."""
    write(
        tmp_path / "raw",
        lambda d: d.replace("ELSET=BODY\n", f"ELSET=BODY\n{ELEMENTS}\n", 1).replace("BODY, GRAV, 9.81, 0., 0., -1.", lines),
    )
    for own in imported(tmp_path):
        assert own.metadata.gravity == pytest.approx((0.0, 0.0, -9.81))


def test_forces_on_a_node_add_up_within_a_card(tmp_path: Path) -> None:
    write(tmp_path / "raw", lambda d: d.replace("117, 1, 0.5", "117, 1, 0.5\nTIP, 1, 0.25\n119, 3, "))
    with pytest.raises(ImportFailure, match="not enough values"):
        imported(tmp_path)
    write(tmp_path / "raw", lambda d: d.replace("117, 1, 0.5", "117, 1, 0.5\nTIP, 1, 0.25"))
    for own in imported(tmp_path):
        assert own.force is not None
        np.testing.assert_allclose(own.force[:, 8:, 0], np.tile([0.75, 0.25, 0.25, 0.25], (FRAMES + 1, 1)), rtol=1e-6)


def test_an_empty_last_axis_of_a_boundary_is_the_first_one(tmp_path: Path) -> None:
    write(tmp_path / "raw", lambda d: d.replace("Clamped, 1, 3\n", "Clamped, 2, , 0.\n"))
    for own in imported(tmp_path):
        assert own.prescribed is not None
        assert own.prescribed.tolist() == [[False, True, False]] * 4 + [[False] * 3] * 8


def test_damping_is_noted(tmp_path: Path) -> None:
    write(tmp_path / "raw", lambda d: d.replace("*DENSITY", "*DAMPING, ALPHA=0., BETA=1e-3\n*DENSITY"))
    report = import_dataset(tmp_path / "data", ImportSettings("calculix", str(tmp_path / "raw"), "set"))
    assert any("*DAMPING, which is not stored" in note for note in report.notes)


@pytest.mark.parametrize(
    ("edit", "edit_results", "message"),
    [
        (lambda d: d.replace("*DENSITY\n1200.\n", ""), str, "material RUBBER has no \\*DENSITY"),
        (
            lambda d: d.replace("*NODE FILE", "*EL FILE, GLOBAL=NO\nS\n*NODE FILE"),
            str,
            r"\*EL FILE with GLOBAL=NO writes results along local axes",
        ),
        (lambda d: d.replace("*MATERIAL", "*PRE-TENSION SECTION, NODE=1\n*MATERIAL"), str, r"\*PRE-TENSION SECTION couples nodes"),
        (lambda d: d.replace("*MATERIAL", "*NETWORK MPC, NODE=1\n*MATERIAL"), str, r"\*NETWORK MPC couples nodes"),
        (
            lambda d: d.replace("GRAV, 9.81, 0., 0., -1.", "BX, 5."),
            str,
            "BX is no pressure on a face P1 to P6; give forces on nodes as \\*CLOAD",
        ),
        (lambda d: d.replace("BODY, GRAV, 9.81, 0., 0., -1.", "7, P1, 5."), str, "element 7 is no linear solid"),
        (lambda d: d.replace("*DLOAD\nBODY, GRAV, 9.81, 0., 0., -1.", "*DSLOAD\nTOP, P, 5."), str, "unknown surface of elements 'TOP'"),
        (
            lambda d: d.replace("*DLOAD\nBODY, GRAV, 9.81, 0., 0., -1.", "*DFLUX\n1, S1, 5."),
            str,
            r"\*DFLUX is not read; .* pressures as \*DLOAD",
        ),
        (
            lambda d: d.replace("*STEP", "*EQUATION\n2\n1, 1, 1., 2, 1, -1.\n*STEP"),
            str,
            r"\*EQUATION couples nodes, .* compute the deck without it",
        ),
        (lambda d: d.replace("*STEP", "*Contact Pair, INTERACTION=A\nLOW, HIGH\n*STEP"), str, r"\*CONTACT PAIR couples nodes"),
        (
            lambda d: d.replace("*STEP", "*INITIAL CONDITIONS, TYPE=VELOCITY\nTIP, 3, 1.\n*STEP"),
            str,
            r"\*INITIAL CONDITIONS moves or strains bodies",
        ),
        (lambda d: d.replace("*STEP", "*TRANSFORM, NSET=TIP\n1., 0., 0., 0., 1., 0.\n*STEP"), str, r"\*TRANSFORM; give held axes"),
        (lambda d: d + "*STEP\n*END STEP\n", str, "has 2 steps, must have one"),
        (
            lambda d: d.replace("TYPE=C3D8,", "TYPE=S4,"),
            str,
            r"\*ELEMENT cannot be read \(TYPE=S4 is no solid; CalculiX gives shells and beams other nodes",
        ),
        (lambda d: d.replace("*DYNAMIC, DIRECT", "*STATIC, DIRECT"), str, r"\*STATIC is no dynamics; compute with \*DYNAMIC"),
        (lambda d: d.replace("*DYNAMIC, DIRECT\n0.01, 0.06\n", ""), str, r"has no \*DYNAMIC"),
        (
            lambda d: d.replace("*STEP, NLGEOM", "*STEP, AMPLITUDE=RAMP, NLGEOM"),
            str,
            r"AMPLITUDE=RAMP; give loads an \*AMPLITUDE of their own",
        ),
        (lambda d: d.replace("*CLOAD\n", "*CLOAD, TIME DELAY=0.03\n"), str, r"\*CLOAD cannot be read \(TIME DELAY is not read\)"),
        (lambda d: d.replace("NAME=RISE", "NAME=RISE, SHIFTX=0.1"), str, r"\*AMPLITUDE cannot be read \(SHIFTX is not read\)"),
        (lambda d: d.replace("117, 1, 0.5", "117, 1, 0.5\n999, 1, 0.5"), str, "node 999 has a force in the deck and is not in the results"),
        (lambda d: d.replace("117, 1, 0.5", "117, 2, 0.5"), str, "node 117 has forces with different amplitudes along axis 2"),
        (lambda d: d.replace("*DLOAD", "*DLOAD, AMPLITUDE=RISE"), str, "gravity with an amplitude"),
        (lambda d: d.replace("9.81, 0., 0., -1.", "9.81, 0., 0., 0."), str, "gravity has no direction"),
        (
            lambda d: d.replace("ELSET=BODY\n", f"ELSET=BODY\n{ELEMENTS}\n", 1).replace("BODY, GRAV", "2, GRAV"),
            str,
            "elements 1 and 2 have different gravity; a trajectory has one",
        ),
        (
            str,
            without_a_node,
            "has no DISP at node 109; write results of all nodes, without NSET",
        ),
        (lambda d: d.replace("TIP, 2, -4.", "TOP, 2, -4."), str, r"\*CLOAD cannot be read \(unknown set of nodes 'TOP'\)"),
        (
            lambda d: d.replace("TIP, 2, -4.", "TIP, 0, -4."),
            str,
            r"\*CLOAD cannot be read \(0 is no axis of a force; forces act along 1, 2 or 3\)",
        ),
        (lambda d: d.replace("AMPLITUDE=RISE", "AMPLITUDE=RISEE"), str, r"\*CLOAD cannot be read \(unknown amplitude 'RISEE'\)"),
        (lambda d: d.replace("*CLOAD, ", "*BOUNDARY, OP=NEW\nTIP, 3\n*CLOAD, "), str, r"\*BOUNDARY cannot be read \(OP=NEW releases nodes"),
        (lambda d: d.replace("1200.\n", "0.\n"), str, r"\*DENSITY cannot be read \(must be positive\)"),
        (lambda d: d.replace("*ELASTIC\n", "*ELASTIC, TYPE=ORTHO\n"), str, r"\*ELASTIC cannot be read \(TYPE=ORTHO; only isotropic"),
        (lambda d: d.replace("2e6, 0.4\n", "2e6, 0.4, 20.\n1e6, 0.4, 90.\n"), str, "constants that depend on the temperature"),
        (lambda d: d.replace("2e6, 0.4\n", "2e6, 0.4\n*PLASTIC\n1e4, 0.\n"), str, r"\*PLASTIC gives a material another law"),
        (
            lambda d: d.replace("*CLOAD, ", "*MODEL CHANGE, TYPE=ELEMENT, REMOVE\n2\n*CLOAD, "),
            str,
            r"\*MODEL CHANGE adds or removes elements",
        ),
        (str, lambda r: r.replace("    1    0    1", "    4    0    1"), "element 1 is quadratic or of an unknown type"),
        (str, lambda r: r.replace("DISP", "VELO"), "has no displacements"),
        (str, lambda r: r[: len(r) // 2], "is damaged or of another format .it ends within a block"),
        (str, lambda r: r.replace(" 5.00000E-02", " 5.50000E-02"), "intervals between results are .* DIRECT"),
        (str, lambda r: r.replace("1\n -1       101", "2\n -1       101"), "binary values"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(
    tmp_path: Path, edit: Callable[[str], str], edit_results: Callable[[str], str], message: str
) -> None:
    write(tmp_path / "raw", edit, edit_results)
    with pytest.raises(ImportFailure, match=message):
        imported(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "load",
    [
        "*DLOAD, AMPLITUDE=RISE\n2, P4, 50.",
        "*ELSET, ELSET=LAST\n2,\n*DLOAD, AMPLITUDE=RISE\nLAST, P4, 50.",
        "*SURFACE, NAME=END, TYPE=ELEMENT\n2, S4\n*DSLOAD, AMPLITUDE=RISE\nEND, P, 50.",
    ],
)
@pytest.mark.parametrize("follows", [True, False])
def test_pressures_become_forces_on_the_nodes_of_the_face(tmp_path: Path, load: str, follows: bool) -> None:
    """The end of the beam is pushed towards the clamp; on the deformed face if the deck has NLGEOM."""

    def edit(deck: str) -> str:
        deck = deck.replace("ELSET=BODY\n", f"ELSET=BODY\n{ELEMENTS}\n", 1).replace("*DLOAD\n", f"{load}\n*DLOAD\n")
        deck = deck.replace("*CLOAD, AMPLITUDE=RISE\nTIP, 2, -4.\n*CLOAD\n117, 1, 0.5\n", "")
        return deck if follows else deck.replace("NLGEOM,\n", "")

    write(tmp_path / "raw", edit)
    found = imported(tmp_path)
    own = found[int(np.argmin([np.abs(t.pos[1] - t.pos[0]).max() for t in found]))]
    assert own.force is not None and not own.force[:, :8].any()
    factor = np.array([0.25, 0.75, 1, 1, 1, 1, 1])  # means over frames of a rise within two frames
    pos = np.concatenate([POINTS[None], POINTS + displacements(1.0)]) if follows else np.repeat(POINTS[None], FRAMES + 1, axis=0)
    rise = np.array([0, 0.5, 1, 1, 1, 1, 1])[:, None] * 50.0
    across, up = pos[:, 10] - pos[:, 8], pos[:, 9] - pos[:, 8]  # the face is a parallelogram that moves as a whole
    at_ends = rise * np.cross(up, across)
    mean = (at_ends + np.concatenate([at_ends[1:], at_ends[-1:]])) / 2
    np.testing.assert_allclose(own.force[:, 8:].sum(axis=1), mean, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(own.force[:, 8:], np.repeat(mean[:, None] / 4, 4, axis=1), rtol=1e-4, atol=1e-7)
    if not follows:
        np.testing.assert_allclose(own.force[:, 8, 0], -50.0 * SIZE**2 / 4 * factor, rtol=1e-5)


@pytest.mark.parametrize("kind", FACES)
def test_a_pressure_on_all_faces_moves_no_element_and_does_the_work_of_its_volume(kind: str) -> None:
    """Forces on a closed surface add up to nothing, turn nothing, and Σ f · x = −3 p V."""
    unit = {
        "C3D4": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "C3D6": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]],
        "C3D8": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    }[kind]
    stretched = np.array(unit, float) @ np.array([[1.0, 0.2, 0.1], [0.0, 1.5, -0.3], [0.4, 0.0, 0.7]])
    force = np.zeros_like(stretched)
    for face in FACES[kind]:
        np.add.at(force, list(face), corner_areas(stretched[list(face)][None])[0])
    volume = {"C3D4": 1 / 6, "C3D6": 1 / 2, "C3D8": 1.0}[kind] * np.linalg.det([[1.0, 0.2, 0.1], [0.0, 1.5, -0.3], [0.4, 0.0, 0.7]])
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-14)
    np.testing.assert_allclose(np.cross(stretched, force).sum(axis=0), 0, atol=1e-14)
    assert (force * stretched).sum() == pytest.approx(-3 * volume)


def test_missing_results_are_named(tmp_path: Path) -> None:
    write(tmp_path / "raw")
    for file in (tmp_path / "raw").glob("*.frd"):
        file.unlink()
    with pytest.raises(ImportFailure, match=r"beam_0.frd is missing; run CalculiX: ccx -i beam_0"):
        imported(tmp_path, frame_dt=DT)


needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed (Debian: apt-get install calculix-ccx)")


@pytest.mark.slow
@needs_ccx
def test_results_of_calculix_itself(tmp_path: Path) -> None:
    """A cube that is clamped at one face and pulled at the other first accelerates by force over mass of its free half."""
    write(tmp_path / "raw")
    for k, file in enumerate(sorted((tmp_path / "raw").glob("*.inp"))):
        deck = file.read_text().replace("ELSET=BODY\n", f"ELSET=BODY\n{ELEMENTS}\n", 1)
        deck = deck.replace("TIP, 2, -4.", f"TIP, 2, {-4.0 - k}").replace("U\n*END", "U\n*EL FILE\nS\n*END")
        file.write_text(deck)
        subprocess.run(["ccx", "-i", file.stem], cwd=file.parent, check=True, capture_output=True, timeout=60)
    found = imported(tmp_path)
    assert len(found) == 3
    for own in found:
        assert own.num_frames == FRAMES + 1 and own.prescribed is not None and own.stress is not None and own.force is not None
        assert not np.ptp(own.pos[:, own.prescribed], axis=0).any()
        assert (own.pos[-1, 8:, 1] < own.pos[0, 8:, 1]).all()
        assert np.abs(own.stress.node[-1, :4, 0]).max() > np.abs(own.stress.node[-1, 8:, 0]).max()  # bending is largest at the clamp


def decks() -> Any:
    """Return the module of ``docs/fem_decks.py``."""
    spec = importlib.util.spec_from_file_location("fem_decks", Path(__file__).parents[4] / "docs" / "fem_decks.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules["fem_decks"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@needs_ccx
@pytest.mark.slow
@pytest.mark.parametrize("case", ["cantilever", *(pytest.param(case, marks=pytest.mark.long) for case in ("plate", "quarter"))])
def test_the_elastic_law_with_true_constants_follows_calculix(tmp_path: Path, case: str) -> None:
    """Clamps, planes of symmetry, forces, pressures and cells are those of CalculiX, which integrates plain hexahedra implicitly; nothing is trained."""
    made = decks()
    (tmp_path / "raw").mkdir()
    chosen = replace(made.CASES[case], element="C3D8", num_frames=25)
    for k in range(3):
        path = tmp_path / "raw" / f"{k}.inp"
        path.write_text(made.deck(replace(chosen, load=chosen.load * (1 + k / 8))))
        made.run(path)
    truth = imported(tmp_path, materials={1: "elastomer"})[0]
    m = truth.metadata
    build = GraphBuilder(GraphConfig(history=1, mesh=True, islands=True, cells=True), m)
    settings: dict[str, Any] = {"num_message_passing_steps": 1, "hidden_channels": 4, "elastic": True, "decoder": "contact"}
    simulator = LearnedSimulator(GPE(build.spec, **settings, only_contacts=True), build).eval()
    simulator.standardizer.mass.fill_(float(truth.mass.mean()))
    simulator.set_units_of(simulator.model)
    lam, mu = lame_parameters(chosen.modulus, chosen.poisson_ratio)
    unit = float(truth.mass.mean()) / (m.spacing * m.frame_dt**2)
    law = simulator.model.elastic_bodies.constants["elastomer"].logarithm  # type: ignore[union-attr,index]
    with torch.no_grad():
        law["bias"].copy_(torch.tensor([np.log(lam / unit), np.log(mu / unit), -20.0]) / LOGARITHM_SCALE)
    found = rollout(simulator, simulator.initial_state(truth, 1), truth.num_frames - 2, m)
    errors = {r.metric: r.value for r in rollout_metrics(found, truth.frames(1), ["full"])}
    assert found.termination is None and errors["displacement_error"] < 0.1
    assert np.abs(truth.pos - truth.pos[0]).max() > 0.1 * m.spacing


SMALL = {"cantilever": {"cells": (8, 2, 2), "num_frames": 40}, "plate": {"cells": (6, 6, 1), "size": 0.03, "num_frames": 30}}


@needs_ccx
@pytest.mark.long
@pytest.mark.parametrize("case", SMALL)
def test_a_short_training_answers_what_calculix_does(tmp_path: Path, case: str) -> None:
    """Deflection within 10 % and peak stress within 25 % of their largest values in the mean over time, in a scene with an unseen modulus and load."""
    made = decks()
    small = replace(made.CASES[case], **SMALL[case])
    for split, factors in {"train": [(0.6, 1.0), (1.0, 1.3), (1.7, 0.8)], "val": [(0.8, 1.0)], "test": [(1.25, 0.9)]}.items():
        (tmp_path / "raw" / split).mkdir(parents=True)
        for k, (stiffer, stronger) in enumerate(factors):
            path = tmp_path / "raw" / split / f"{k}.inp"
            path.write_text(made.deck(replace(small, modulus=small.modulus * stiffer, load=small.load * stronger)))
            made.run(path)
    import_dataset(tmp_path / "data", ImportSettings("calculix", str(tmp_path / "raw"), "set", materials={1: "elastomer"}))
    law = ("law=elastic", "model=gpe_tuned", "model.only_contacts=true", "model.viscous=false", "model.stress=true", "graph.history=1")
    steps = (
        "training.num_steps=200",
        "training.learning_rate=8e-3",
        "training.warmup_steps=20",
        "training.val_interval=100",
        "size.hidden_channels=8",
        "evaluation.num_pictures=0",
    )
    folders = (f"paths.data={tmp_path / 'data'}", f"paths.runs={tmp_path / 'runs'}")
    fit(compose("fit", "data=imported", "data.name=set", *law, *steps, "trainer.progress=false", "trainer.num_threads=1", *folders))
    simulator = LearnedSimulator.from_checkpoint(tmp_path / "runs" / "fit")
    truth = next(iter_trajectories(tmp_path / "data" / "set" / "imported", "test"))
    found = rollout(simulator, simulator.initial_state(truth, 1), truth.num_frames - 2, truth.metadata)
    own, expected = quantities(found), quantities(truth.frames(1))
    for name, limit in (("deflection", 0.1), ("peak stress", 0.25)):
        a, b = own[name].over_time, expected[name].over_time
        assert np.sqrt(np.mean((a - b) ** 2)) / b.max() < limit, name
