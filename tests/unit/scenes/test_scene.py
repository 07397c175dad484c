"""Scenes of a few lines: what they become at the spacing of a model, and what is said of impossible ones."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gpe_pl.evaluation.identification.scene import solver_of
from gpe_pl.geometry.sections import section, solid_within
from gpe_pl.geometry.shapes import Box
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import rollout
from gpe_pl.rollout.skips import Skips
from gpe_pl.scenes import predict
from gpe_pl.scenes.bodies import BodyFault
from gpe_pl.scenes.film import Film, FilmFault
from gpe_pl.scenes.obstacles import Circle
from gpe_pl.scenes.rollouts import predicted
from gpe_pl.scenes.scene import Scene, SceneFault
from gpe_pl.scenes.scene_file import read_scene
from gpe_pl.schema import node_code
from gpe_pl.trajectory.source_origin import origin_of

ROOT = Path(__file__).parents[3]
SPACING = 0.015625  # of the shipped model of sand


def bar(material: str, thickness: float) -> Scene:
    """Return an oblique bar, 0.4 m long, whose thickness is given in spacings of the model of sand."""
    along, across = 0.4 * np.sqrt(0.5) * np.array([1.0, 1.0]), thickness * SPACING * np.sqrt(0.5) * np.array([-1.0, 1.0])
    corners = 0.3 + np.array([[0.0, 0.0], along, along + across, across])
    return Scene(box=(1.0, 1.0)).polygon(material, corners.tolist())


@cache
def model(name: str) -> LearnedSimulator:
    return LearnedSimulator.from_checkpoint(name)


def test_a_scene_has_coordinates_of_its_own() -> None:
    """Those of imported data may have been moved; exports of their rollouts are moved back, and those of a scene stay where they are."""
    moved = model("sand").configured()
    values = json.loads(moved.builder.metadata.config)
    moved.builder = replace(moved.builder, metadata=replace(moved.builder.metadata, config=json.dumps({**values, "origin": [5.0, 0.0]})))
    assert origin_of(moved.builder.metadata) is not None
    _, metadata = column().state(moved)
    assert origin_of(metadata) is None and json.loads(metadata.config) == values


def column(**properties: Any) -> Scene:
    return Scene(box=(1.0, 1.0)).block("sand", at=(0.1, 0.0), size=(0.125, 0.25), **properties)


def test_a_block_becomes_a_lattice_with_masses_and_parameters() -> None:
    state, metadata = column(friction_angle=35, velocity=(1.0, 0.0)).ball("sand", at=(0.7, 0.6), radius=0.1).state(model("sand"))
    first = state.pos[:, 0] < 0.5
    assert first.sum() == 8 * 16
    assert np.abs(state.pos[first].min(axis=0) - (0.1 + SPACING / 2, SPACING / 2)).max() <= SPACING / 4
    assert np.unique(state.material_params[first]) == 35
    assert np.unique(state.material_params[~first]) == pytest.approx(31.25)  # the middle of 20 to 42.5
    assert np.unique(state.mass[first]) == pytest.approx(1600 * SPACING**2)
    assert (state.vel[first] == (1, 0)).all() and (state.vel[~first] == 0).all()
    assert state.mass[~first].sum() == pytest.approx(1600 * np.pi * 0.01, rel=0.05)
    assert metadata.bounds == ((0.0, 1.0), (0.0, 1.0)) and metadata.gravity == (0.0, -9.81)
    assert model("sand").untrained_scene(model("sand").standing(state, metadata)) == []


@pytest.mark.parametrize(("name", "material"), [("elastomer", "elastomer"), ("fem", "solid")])
def test_meshed_materials_get_cells(name: str, material: str) -> None:
    state, metadata = Scene(box=(1.0, 1.0)).block(material, at=(0.3, 0.3), size=(0.25, 0.2)).state(model(name))
    assert state.cells is not None and state.rest_pos is not None
    corners = state.pos[state.cells]
    area = 0.5 * np.linalg.det(corners[:, 1:] - corners[:, :1]).sum()
    assert area == pytest.approx(0.25 * 0.2 if material == "solid" else (15 / 16 * 0.25) * (12 / 13 * 0.2), rel=0.01)
    model(name).standing(state, metadata)


def test_liquid_fills_a_block_in_3d() -> None:
    scene = Scene(box=(1.0, 1.0, 1.0)).block("fluid", at=(0.0, 0.0, 0.0), size=(0.3, 0.3, 0.2)).obstacle(Circle((0.7, 0.5, 0.2), 0.1))
    state, _ = scene.state(model("fluid"))
    assert state.num_nodes == 6 * 6 * 4
    assert (state.node_type == node_code("fluid")).all()


def test_an_image_is_a_body_where_it_is_dark(tmp_path: Path) -> None:
    pixels = np.full((20, 40), 255, np.uint8)
    pixels[:10, :20] = 0  # upper left
    Image.fromarray(pixels).save(tmp_path / "body.png")
    state, _ = Scene(box=(1.0, 1.0)).image("sand", tmp_path / "body.png", at=(0.2, 0.2), size=(0.4, 0.2)).state(model("sand"))
    slack = SPACING
    assert (state.pos >= np.array([0.2, 0.3]) - slack).all() and (state.pos <= np.array([0.4, 0.4]) + slack).all()
    assert state.num_nodes * SPACING**2 == pytest.approx(0.2 * 0.1, rel=0.15)


def test_an_image_is_upright_as_viewers_show_it(tmp_path: Path) -> None:
    """A camera that was turned says so in the file."""
    pixels = np.full((40, 40), 255, np.uint8)
    pixels[:20, :20] = 0  # upper left as stored, upper right as shown
    tags = Image.Exif()
    tags[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "body.png", exif=tags)
    state, _ = Scene(box=(1.0, 1.0)).image("sand", tmp_path / "body.png", at=(0.2, 0.2), size=(0.4, 0.4)).state(model("sand"))
    assert (state.pos >= np.array([0.4, 0.4]) - SPACING).all() and (state.pos <= np.array([0.6, 0.6]) + SPACING).all()


def test_an_image_of_16_bits_is_that_of_8_and_other_ranges_are_refused(tmp_path: Path) -> None:
    pixels = np.full((40, 40), 255, np.uint8)
    pixels[:20], pixels[20:30] = 0, 40
    images: dict[str, np.ndarray] = {
        "8.png": pixels,
        "16.png": pixels.astype(np.uint16) * 257,
        "f.tiff": pixels.astype(np.float32) / 255,
        "i.tiff": pixels.astype(np.int32),
    }
    for name, values in images.items():
        Image.fromarray(values).save(tmp_path / name)

    def count(name: str) -> int:
        return Scene(box=(1.0, 1.0)).image("sand", tmp_path / name, at=(0.2, 0.2), size=(0.4, 0.4)).state(model("sand"))[0].num_nodes

    assert count("8.png") == count("16.png")
    for name, mode in (("f.tiff", "F"), ("i.tiff", "I")):
        with pytest.raises(BodyFault, match=f"has pixels of mode {mode}, whose range is not known; save it with 8 or 16 bits"):
            count(name)


def test_a_solved_scene_has_the_settings_of_its_solver() -> None:
    found = Scene(box=((0.5, 1.5), (0.0, 1.0))).block("sand", at=(0.9, 0.0), size=(0.1, 0.2)).solve(seconds=0.02).first
    solver: Any = solver_of(found.metadata)
    assert solver.bounds == found.metadata.bounds == ((0.5, 1.5), (0.0, 1.0))
    again = rollout(solver, found.state(0), found.num_frames - 1, found.metadata)
    np.testing.assert_array_equal(again.pos, found.pos)


@pytest.mark.parametrize("kind", [int, np.int64, np.float32, np.float64])
def test_numbers_of_numpy_are_numbers(kind: Any) -> None:
    box = (kind(1), kind(1))
    scene = Scene(box=box).block("sand", at=(0.1, 0.0), size=(0.2, 0.2), friction_angle=kind(30), density=kind(1500))
    state, _ = scene.state(model("sand"))
    assert (state.material_params == 30.0).all()


def test_a_model_of_a_periodic_domain_is_refused() -> None:
    simulator = model("sand").configured()
    simulator.builder = replace(simulator.builder, metadata=replace(simulator.builder.metadata, periodic=(True, False)))
    with pytest.raises(SceneFault, match="model: is for a periodic domain; scenes have walls"):
        Scene(box=(1.0, 1.0)).block("sand", at=(0.1, 0.0), size=(0.2, 0.2)).state(simulator)


@pytest.mark.parametrize(("gap", "is_told"), [(0.03, True), (0.2, False)])
def test_bodies_that_the_model_pushes_apart_from_the_start_are_told(gap: float, is_told: bool, caplog: pytest.LogCaptureFixture) -> None:
    scene = Scene(box=(1.0, 1.0)).block("elastomer", at=(0.2, 0.1), size=(0.2, 0.2))
    scene.block("elastomer", at=(0.2, 0.3 + gap), size=(0.2, 0.2)).state(model("elastomer"))
    assert ("block 1 (elastomer) and block 2 (elastomer) are" in caplog.text) == is_told


def test_a_polygon_is_a_body_in_either_direction() -> None:
    corners = [(0.2, 0.2), (0.6, 0.2), (0.4, 0.6)]
    counts = [Scene(box=(1.0, 1.0)).polygon("sand", order).state(model("sand"))[0].num_nodes for order in (corners, corners[::-1])]
    assert counts[0] == counts[1]
    assert counts[0] * SPACING**2 == pytest.approx(0.08, rel=0.05)


def cube(path: Path) -> Path:
    """Write a cube with a side of 2 from (10, 10, 10) on as ASCII STL."""
    low, corners = np.full(3, 10.0), np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 2)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = ["solid cube"]
    for a, b, c, d in faces:
        for triangle in ((a, b, c), (a, c, d)):
            vertices = "\n".join(f"vertex {x:g} {y:g} {z:g}" for x, y, z in low + corners[list(triangle)])
            lines.append(f"facet normal 0 0 0\nouter loop\n{vertices}\nendloop\nendfacet")
    path.write_text("\n".join([*lines, "endsolid cube"]))
    return path


def test_a_mesh_is_an_obstacle_by_its_section(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    scene = column().obstacle(mesh=cube(tmp_path / "part.stl"), at=(0.5, 0.1), size=0.2)
    shape = scene.state(model("sand"))[0].boundary.shapes[-1]
    points = np.array([[0.6, 0.2], [0.6, 0.4], [0.45, 0.2], [0.52, 0.2]])
    assert shape.signed_distance(points) == pytest.approx([-0.1, 0.1, 0.05, -0.02], abs=SPACING / 3)
    with pytest.raises(SceneFault, match=r"obstacle 1: .*part.stl: reaches from 10 to 12, 10 to 12 m; .*; give at=… and size=… in m"):
        column().obstacle(mesh=tmp_path / "part.stl").state(model("sand"))


def test_a_mesh_that_encloses_no_volume_tells_why(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    text = cube(tmp_path / "part.stl").read_text()
    facets = text.split("facet normal")
    (tmp_path / "open.stl").write_text("facet normal".join(facets[:-2]) + "endsolid cube")
    with pytest.raises(SceneFault, match=r"encloses no volume: 4 of its edges, such as that at \(.*\), belong to one triangle only"):
        column().obstacle(mesh=tmp_path / "open.stl", at=(0.5, 0.1), size=0.2).state(model("sand"))
    fin = "facet normal 0 0 0\nouter loop\nvertex 10 10 10\nvertex 10 10 12\nvertex 5 5 11\nendloop\nendfacet\n"
    (tmp_path / "fin.stl").write_text(text.replace("endsolid", fin + "endsolid"))
    with pytest.raises(SceneFault, match=r"edges, such as that at \(.*\), belong to "):
        column().obstacle(mesh=tmp_path / "fin.stl", at=(0.5, 0.1), size=0.2).state(model("sand"))


def test_a_section_of_a_tetrahedron_is_a_triangle() -> None:
    a, b, c, d = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    segments = section(np.array([[a, c, b], [a, b, d], [a, d, c], [b, c, d]]), 0.5)
    assert {tuple(np.round(point, 6)) for segment in segments for point in segment} == {(0, 0), (0.5, 0), (0, 0.5)}
    solid = solid_within(segments, ((-0.2, 1.0), (-0.2, 1.0)), 0.02, 0.4)
    assert solid.signed_distance(np.array([[0.1, 0.1], [0.6, 0.6]])) == pytest.approx([-0.1, 0.35 * 2**0.5], abs=2e-3)


def plate_through_a_solid() -> Scene:
    """Return a plate much thinner than the spacing that passes between nodes."""
    return Scene(box=(1.0, 1.0)).block("solid", (0.3, 0.3), (0.2, 0.2)).obstacle(Box((0.2, 0.3801), (0.6, 0.3804), 0.3))


FAULTS: list[tuple[Callable[[], Any], str]] = [
    (lambda: Scene(box=(1.0,)), "box: must have 2 or 3 sides [m], or (low, high) for each axis, such as (1.5, 1.0), got (1.0,)"),
    (lambda: Scene(box=(1.0, 1.0), gravity=(0, 0, -1)), "gravity: gravity=(0, 0, -1): must be 2 numbers"),
    (lambda: Scene(box=(1.0, 1.0), friction=-1.0), "friction: must be a number of at least 0, or one for each of x_high, x_low"),
    (lambda: Scene(box=(1.0, 1.0)).block("snad", (0, 0), (1, 1)), "block 1 (snad): unknown material; did you mean 'sand'?; known are sand"),
    (lambda: column(friction_angel=30), "block 1 (sand): friction_angel: unknown key; did you mean 'friction_angle'?; sand has friction_angle, cohesion"),
    (lambda: column(friction_angle=80), "block 1 (sand): friction_angle = 80.0 deg is outside 0 … 60, the solvers' limits"),
    (lambda: column(friction_angle="steep"), "block 1 (sand): friction_angle='steep': must be a number"),
    (lambda: column(velocity=1.0), "block 1 (sand): velocity=1.0: must be 2 numbers, one for each axis of the box"),
    (lambda: Scene(box=(1.0, 1.0)).block("sand", at=(0, 0), size=(0, 1)), "block 1 (sand): size=0.0: must be a positive number"),
    (lambda: Scene(box=(1.0, 1.0)).polygon("sand", [(0, 0), (1, 1), (1, 0), (0, 1)]), "polygon 1 (sand): corners: polygon edges"),
    (lambda: column().obstacle(mesh="part.stl"), "obstacle 1: mesh=part.stl: no such file"),
    (lambda: column().obstacle(), "obstacle 1: give either a shape, such as Circle"),
    (lambda: column().obstacle("circle"), "obstacle 1: must be a shape, such as Circle((0.5, 0.2), 0.1), got 'circle'"),
    (lambda: column().obstacle(Circle((0.5, 0.2), -0.1)), "obstacle 1: radius is -0.1 m, must be positive"),
    (lambda: column().obstacle(Circle((0.5, 0.2), float("nan"))), "obstacle 1: not finite: radius"),
    (lambda: column().obstacle(Circle((0.5, 0.2), 0.1, friction=-5)), "obstacle 1: friction is -5, must be at least 0"),
    (lambda: column().obstacle(Box((0.5, 0.0), (0.4, 0.2), 0.4)), "obstacle 1: low must be below high along every axis"),
    (lambda: column().obstacle(mesh="part.stl", friction=-1), "obstacle 1: friction=-1: must be a number of at least 0"),
    (lambda: Scene(box=(1.0, 1.0), friction=float("inf")), "friction: must be a number of at least 0"),
    (lambda: Scene(box=(1.0, 1.0), seed=-1), "seed: must be a whole number of at least 0, got -1"),
    (lambda: Scene(box=(1.0, 1.0), seed=1.5), "seed: must be a whole number of at least 0, got 1.5"),
    (lambda: Scene(box=(1.0, 1.0)).predict("sand"), "the scene has no body; add one"),
    (lambda: Scene(box=(1.0, 1.0)).predict(), "model: name one for the scene; shipped models"),
    (lambda: column().predict("fem"), "block 1 (sand): the model is for solid"),
    (lambda: column(cohesion=5.0).predict("sand"), "block 1 (sand): cohesion: the model was not trained with it, only with friction_angle"),
    (lambda: column().predict("fluid"), "box: has 2 axes, the model is for 3D"),
    (lambda: column().predict(seconds=-1.0), "seconds: must be more than 0 and at most 3600, got -1.0"),
    (lambda: column().block("sand", (0.9, 0.5), (0.3, 0.1)).predict(), "block 2 (sand): at, size: reaches from 0.9 to 1.2 m along x, the box from 0 to 1 m"),
    (lambda: column().block("sand", (0.5, 0.5), (0.01, 0.3)).predict(), "block 2 (sand): is 0.01 m thin, less than the distance of nodes, 0.015625 m"),
    (lambda: column().block("sand", (0.15, 0.1), (0.3, 0.3)).predict(), "block 2 (sand): overlaps block 1 (sand); move one of the two"),
    (lambda: bar("elastomer", 1.0).predict(), "polygon 1 (elastomer): 19 of its 19 nodes are in no cell"),
    (lambda: column().obstacle(Circle((0.2, 0.1), 0.05)).predict(), "block 1 (sand): 27 of its 128 nodes are inside obstacle 1; move one of the two"),
    (lambda: plate_through_a_solid().predict(), "block 1 (solid): obstacle 1 passes through it between its nodes"),
    (lambda: column().obstacle(Circle((3.0, 0.5), 0.1)).predict(), "obstacle 1: no part of its surface is in the box; move it, or leave it out"),
    (lambda: column().obstacle(Box((0.5, 0.0, 0.0), (0.6, 0.1, 0.1), 0.4)).predict(), "obstacle 1: low must have 2 components"),
]  # fmt: skip


@pytest.mark.parametrize("material", ["sand", "elastomer"])
def test_bodies_whose_lattices_interleave_overlap(material: str) -> None:
    """Their nodes are up to 0.71 spacings apart."""
    spacing = model(material).builder.metadata.spacing
    side, shift = 10 * spacing, np.random.default_rng(0).uniform(-8, 8, (20, 2)) * spacing
    for way in shift:
        scene = Scene(box=(1.0, 1.0)).block(material, (0.4, 0.4), (side, side)).block(material, tuple(0.4 + way), (side, side))
        with pytest.raises(SceneFault, match="overlaps block 1"):
            scene.state(model(material))
    touching = Scene(box=(1.0, 1.0)).block(material, (0.4, 0.4), (side, side)).block(material, (0.4 + side, 0.4), (side, side))
    assert touching.state(model(material))[0].num_nodes == 200


@pytest.mark.parametrize(("thickness", "ratio"), [(1.0, "0.7"), (0.5, "1.4"), (12.0, "")])
def test_a_body_whose_nodes_have_another_mass_is_named(thickness: float, ratio: str, caplog: pytest.LogCaptureFixture) -> None:
    state, _ = bar("sand", thickness).state(model("sand"))
    true = 1600 * 0.4 * thickness * SPACING
    if ratio:
        assert f"polygon 1 (sand): its nodes have {ratio}" in caplog.text
        assert abs(state.mass.sum() / true - float(ratio)) < 0.1
    else:
        assert "its nodes have" not in caplog.text
        assert state.mass.sum() == pytest.approx(true, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "message"), FAULTS, ids=[message for _, message in FAULTS])
def test_what_is_wrong_with_a_scene_is_named(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(SceneFault) as caught:
        make()
    assert str(caught.value).startswith(message)


FILE = """
box: [1.0, 1.0]
friction: 0.3
bodies:
  - {block: sand, at: [0.1, 0.0], size: [0.125, 0.25], friction_angle: 35}
obstacles:
  - {circle: [0.7, 0.2], radius: 0.1}
  - {box: [0.4, 0.0], high: [0.5, 0.1], friction: 0.2}
"""


def test_a_file_is_the_same_scene(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(FILE)
    read, _ = read_scene(tmp_path / "scene.yaml").state(model("sand"))
    scene = Scene(box=(1.0, 1.0), friction=0.3).block("sand", at=(0.1, 0.0), size=(0.125, 0.25), friction_angle=35)
    written, _ = scene.obstacle(Circle((0.7, 0.2), 0.1)).obstacle(Box((0.4, 0.0), (0.5, 0.1), 0.2)).state(model("sand"))
    assert (read.pos == written.pos).all() and (read.material_params == written.material_params).all()
    assert read.boundary.shapes == written.boundary.shapes


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("box: [1.0, 1.0]\n", "", "box: is missing; give the sides [m]"),
        ("bodies:", "bodeis:", "bodeis: unknown key; did you mean 'bodies'?"),
        ("size:", "sise:", "block 1 (sand): size: missing; sise: unknown key; did you mean 'size'?"),
        ("block:", "blcok:", "bodies, part 1: needs one of the keys block, ball, polygon, image; did you mean 'block'?"),
        ("radius: 0.1", "radios: 0.1", "obstacle 1: radios: unknown key; did you mean 'radius'?"),
        ("radius: 0.1", "radius: wide", "obstacle 1: has a value of a wrong kind"),
        ("box: [1.0, 1.0]", "box: [1.0, ", "is no YAML, at line"),
        ("[0.1, 0.0]", "[0.1]", "block 1 (sand): at=[0.1]: must be 2 numbers"),
        (
            "obstacles:",
            "obstacles:\n  - {circle: [0.2, 0.8], radius: 0.1}\nobstacles:",
            "obstacles: occurs in line 6 and again in line 8; put all into one",
        ),
        ("box: [1.0, 1.0]", "box: [1.0, 1.0]\n? [a, b]\n: 4", "line 3: a key must be a word"),
        ("box: [1.0, 1.0]", "box: [1.0, 1.0]\nseed: abc", "seed: must be a whole number of at least 0, got 'abc'"),
    ],
)
def test_faults_of_a_file_are_named(tmp_path: Path, before: str, after: str, message: str) -> None:
    (tmp_path / "scene.yaml").write_text(FILE.replace(before, after, 1))
    with pytest.raises(SceneFault) as caught:
        read_scene(tmp_path / "scene.yaml")
    assert message in str(caught.value)


@pytest.mark.parametrize("value", ["1e-1", "1E-1", "+1.0e-1", "100e-3", ".1", "0.1"])
def test_numbers_have_exponents_with_and_without_a_point(tmp_path: Path, value: str) -> None:
    (tmp_path / "scene.yaml").write_text(FILE.replace("friction: 0.3", f"friction: {value}"))
    assert read_scene(tmp_path / "scene.yaml").friction == 0.1


@pytest.mark.parametrize("title", ["2024", "2024-05-01", "yes"])
def test_a_title_is_text(tmp_path: Path, title: str) -> None:
    (tmp_path / "scene.yaml").write_text(f"title: {title}\n{FILE}")
    assert isinstance(read_scene(tmp_path / "scene.yaml").title, str)


@pytest.mark.slow
def test_a_speed_far_beyond_the_training_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    """Such as a velocity in mm/s. The scene that the model knows gets no warning."""
    scene = Scene(box=(1.0, 1.0))
    scene.block("sand", at=(0.1, 0.1), size=(0.2, 0.2)).predict("sand", seconds=0.02)
    assert not [r for r in caplog.records if "unlike" in r.message]
    scene.block("sand", at=(0.1, 0.1), size=(0.2, 0.2), velocity=(500.0, 0.0)).predict("sand", seconds=0.02)
    assert "unlike training in this rollout: speed of sand [m/s] is up to 500, in training at most" in caplog.text


@pytest.mark.slow
def test_predict_writes_a_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gpe_pl.viz.browser.has_desktop", lambda: False)
    Path("scene.yaml").write_text(FILE)
    predict.run("scene.yaml", {"checkpoint": "sand", "seconds": 0.02})
    lines = capsys.readouterr().out.splitlines()
    assert "prediction: 0.02 s in 4 frames, 128 nodes" in lines and "scene.html" in lines
    predict.run("scene.yaml", {"seconds": 0.02, "file": Path("film.svg")})
    assert Path("film.svg").read_text().startswith("<?xml")


def test_predict_draws_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(FILE.replace("[0.7, 0.2]", "[0.2, 0.1]"))
    with pytest.raises(SceneFault, match="inside obstacle 1; move one of the two; see scene_faults.png: faults are red"):
        predict.run("scene.yaml", {})
    red = np.asarray(Image.open("scene_faults.png").convert("RGB")).astype(int)
    assert ((red[..., 0] > 180) & (red[..., 1] < 90) & (red[..., 2] < 90)).sum() > 500


@pytest.mark.slow
@pytest.mark.parametrize("material", ["sand", "elastomer"])
@pytest.mark.parametrize("size", [(0.2, 0.5), (0.1, 0.1), (0.07, 0.3), (0.0297, 0.3)])
def test_bodies_have_their_size_and_mass(material: str, size: tuple[float, float]) -> None:
    simulator = LearnedSimulator.from_checkpoint(material)
    scene = Scene(box=(1.0, 1.0)).block(material, at=(0.3, 0.2), size=size)
    state, metadata = scene.state(simulator)
    assert state.mass.sum() == pytest.approx(scene._density(scene.bodies[0], simulator) * np.prod(size))
    reach = np.ptp(state.pos, axis=0) + np.sqrt(state.mass[0] / (state.mass.sum() / np.prod(size)))
    np.testing.assert_allclose(reach, size, atol=0.5 * metadata.spacing)
    np.testing.assert_allclose(state.pos.mean(axis=0), np.array([0.3, 0.2]) + np.array(size) / 2, atol=0.1 * metadata.spacing)


def test_the_solver_says_that_an_obstacle_is_thin(caplog: pytest.LogCaptureFixture) -> None:
    scene = column()
    scene.obstacle(Box((0.5, 0.3), (0.9, 0.32), 0.4)).solve(seconds=0.01)
    assert "an obstacle (box) is 1.3 cells of the grid thick; with fewer than 2, what touches it depends on its place" in caplog.text
    caplog.clear()
    scene.obstacle(Box((0.5, 0.3), (0.9, 0.35), 0.4)).solve(seconds=0.01)
    assert "cells of the grid" not in caplog.text


def test_the_solver_says_that_a_mesh_is_thin(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    trimesh = pytest.importorskip("trimesh")
    for name, extents in (("plate", (0.4, 0.2, 0.024)), ("block", (0.4, 0.2, 0.2))):
        trimesh.creation.box(extents=extents).export(tmp_path / f"{name}.stl")
    column().obstacle(mesh=tmp_path / "block.stl", at=(0.5, 0.3)).solve(seconds=0.01)
    assert "cells of the grid" not in caplog.text
    column().obstacle(mesh=tmp_path / "plate.stl", at=(0.5, 0.3)).solve(seconds=0.01)
    assert "an obstacle (distance_grid) is 1.5 cells of the grid thick" in caplog.text


def test_a_body_outside_the_box_is_drawn_in_red(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.viz.browser.open_page", lambda path: True)

    def count_red(scene: Scene) -> int:
        red = np.asarray(Image.open(scene.show()).convert("RGB")).astype(int)
        return int(((red[..., 0] > 180) & (red[..., 1] < 90) & (red[..., 2] < 90)).sum())

    assert count_red(column().block("snow", (0.9, 0.5), (0.3, 0.1))) > 100
    assert count_red(column().block("snow", (0.6, 0.5), (0.3, 0.1))) == 0


def test_examples_of_the_guide_are_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("trimesh")
    monkeypatch.chdir(tmp_path)
    cube(Path("part.stl"))
    guide, *others = ((ROOT / page).read_text() for page in ("docs/guide/scenes.md", "docs/guide/open_scenes.md", "README.md"))
    for text in (
        *re.findall(r"```yaml\n(.*?)```", guide, re.DOTALL),
        predict.ABOUT[predict.ABOUT.index("  box:") :].replace("\n  ", "\n").strip(),
    ):
        Path("scene.yaml").write_text(text)
        assert read_scene("scene.yaml").state(model("sand"))[0].num_nodes > 100
    shown: list[Scene] = []

    class Seen(Film):
        def __init__(self, scene: Scene, *_: Any, **__: Any) -> None:
            shown.append(scene)

        def summary(self) -> str:
            return ""

        def show(self) -> Path:
            return Path()

    monkeypatch.setattr(Scene, "_film", lambda scene, *_, **__: Seen(scene))
    for page in (guide, *others):
        names: dict[str, Any] = {}
        for code in (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Scene(" in block):
            exec(code, names)
    assert [scene.state(model("fluid" if scene.zones else "sand"))[0].num_nodes > 100 for scene in shown] == [True, True, True]


def test_a_prediction_has_the_approximate_levels_of_the_model() -> None:
    own = LearnedSimulator.from_checkpoint("sand")  # its settings change
    state, metadata = column(friction_angle=30).state(own)
    exact = predicted(own, state, metadata, 4, "exact")
    own.skips = Skips(repeat_frames=4)
    repeated = predicted(own, state, metadata, 4, "repeated")
    expected = rollout(Contained(approximate(own), metadata.frame_dt), own.standing(state, metadata), 4, metadata)
    np.testing.assert_allclose(repeated.pos, expected.pos, atol=1e-9)
    assert np.abs(repeated.pos - exact.pos).max() > 1e-9


def test_a_density_that_the_solver_cannot_have_is_refused() -> None:
    """Its nodes have the volume of their mass at the density of the data, so another mass would be another volume."""
    light = Scene(box=(1.0, 1.0)).block("elastomer", at=(0.3, 0.3), size=(0.2, 0.2), density=100.0)
    with pytest.raises(SceneFault, match=r"density: the solver of these data computes with 1000 kg/m³ only"):
        light.solver_of(model("elastomer"))
    usual = Scene(box=(1.0, 1.0)).block("elastomer", at=(0.3, 0.3), size=(0.2, 0.2), density=1000.0)
    assert usual.solver_of(model("elastomer")).name == "mpm"
    heavy = Scene(box=(1.0, 1.0)).block("solid", at=(0.3, 0.3), size=(0.2, 0.2), density=2000.0)
    assert heavy.solver_of(model("fem")).name == "fem"  # finite elements have a mass per node


@pytest.mark.slow
def test_a_model_stays_near_the_solver_in_a_scene_of_our_own() -> None:
    film = column(friction_angle=30).obstacle(Circle((0.5, 0.05), 0.05)).compare("sand", seconds=0.2)
    fall = 0.5 * 9.81 * 0.2**2
    assert film.distance("sand") < 0.1 * fall
    assert film.first.metadata.solver == "mpm" and film.first.num_frames == 41


def test_arrays_hold_every_rollout(tmp_path: Path) -> None:
    film = column().compare("sand", 0.02)
    assert film.write(tmp_path / "a.npz") == tmp_path / "a_ground_truth.npz"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_ground_truth.npz", "a_sand.npz"]
    for path, rollout_of in zip(film.files(tmp_path / "a.npz"), (film.first, film.others["sand"]), strict=True):
        with np.load(path) as arrays:
            np.testing.assert_allclose(arrays["pos"], rollout_of.pos, rtol=1e-6)
    with pytest.raises(FilmFault, match=r"a_sand.npz/b.png: .*a_sand.npz is a file and no folder; name another file"):
        film.write(tmp_path / "a_sand.npz" / "b.png")
