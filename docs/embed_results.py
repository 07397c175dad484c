"""Copy results of runs into ``docs/results`` and the tables there into the README, so that no number is typed by hand.

``python docs/embed_results.py RUN_FOLDER NAME [NOTE]`` takes from a finished run, sweep or suite its tables, its figures in fewer colours, the first film, and
where all of it comes from (``provenance.json``). It keeps the results of single rollouts in two small files (``gpe_pl.reports.run_archive``), from which
``python -m gpe_pl.reports docs/results/NAME`` makes the tables again. NOTE is what a reader should know besides, such as other work on the machine.
RUN_FOLDER may also hold several evaluations by ``evaluate``, and their table by ``python -m gpe_pl.reports RUN_FOLDER``.
``python docs/embed_results.py --renew SUITE_FOLDER NAME [NOTE]`` renews the models that a run of ``suite=acceptance`` or ``suite=stability`` measured, and
keeps what ``docs/results/NAME`` has of other models.
``python docs/embed_results.py --add RUN_FOLDER NAME [NOTE]`` does the same as without ``--add`` for a run that added models to a table which has others. The
sessions of these are kept.
``python docs/embed_results.py --draw NAME PICTURE`` draws a figure of reports, such as ``reads_material.png``, from the results of single rollouts that
``docs/results/NAME`` keeps. The tables there stay as they are, because these results have errors over whole rollouts only.
``python docs/embed_results.py`` only renews the README and the list in ``docs/results/README.md``; ``--check`` fails if one differs from the files.
"""

from __future__ import annotations

import importlib
import json
import lzma
import re
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image, ImageSequence

from gpe_pl.files import sealed
from gpe_pl.files.markdown import table_row
from gpe_pl.reports.finished_runs import archive, evaluations_below, finished_runs
from gpe_pl.reports.tables import write_tables
from gpe_pl.system.provenance import ADVICE, PROVENANCE, recorded, sessions

DOCS = Path(__file__).resolve().parent
RESULTS = DOCS / "results"
README = DOCS.parent / "README.md"
BLOCK = re.compile(r"(<!-- begin (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
LIST = re.compile(r"(<!-- begin list -->\n).*?(<!-- end list -->)", re.DOTALL)
FILES = (
    *("table.md", "strides.md", "scales.md", "table.csv", "config.json", "results.json", "step_times.json", "forward_times.json"),
    *("table1.md", "table1_ratios.md", "table1.csv"),
    *("trials.md", "trials.csv", "showcase.json", "showcase.md"),
)
PICTURES = (
    *("table1.png", "error_by_parameter.png", "validation_loss.png", "scaling.png", "showcase.png", "parameter_effect.png"),
    "reads_material.png",
    *("rollout_test_00.png", "rollout_test_unseen_00.png", "stress_test_unseen_00.png", "error_curve_test.png"),
    *("long_horizon_*.png", "perturbation_*.png", "cost_error_*.png"),
    "engines.png",
    "bands.png",
    "active.png",
    "adaptation.png",
    "channel.png",
    *("acceptance_fem_beam.png", "acceptance_elastomer_square.png", "acceptance_sand_column.png"),
    "scenes/*_00000_misfit.png",
    *("acceptance_snow_cylinder.png", "acceptance_snow_released.png", "acceptance_fluid_dam_break.png", "acceptance_sand_slump.png"),
)
FILM = "rollout_test_00.gif"
MAX_WIDTH = 1400
MAX_BYTES = 65_536
NUM_COLORS = 128


def embedded(text: str) -> str:
    """The text with every marked block replaced by the file that it names."""
    return BLOCK.sub(lambda m: m[1] + (DOCS.parent / m[2]).read_text().rstrip() + "\n" + m[3], text)


def collect(run: Path, name: str, note: str = "", adds: bool = False) -> None:
    """Copy what is worth citing of a run into ``docs/results/{name}``, and keep the sessions of earlier runs there if it adds to them."""
    target = RESULTS / name
    target.mkdir(parents=True, exist_ok=True)
    before = sealed.read(target / PROVENANCE, ADVICE)["sessions"] if adds else []
    runs = finished_runs(run)
    is_table1 = (run / "table1.csv").exists()
    for pattern in FILES:
        for path in sorted(run.glob(pattern)):
            is_made_again = bool(runs) and path.name == "table.csv"  # from the results of single rollouts
            if not is_made_again and not (is_table1 and path.stem == "table"):  # of all its runs at once, which says nothing
                record(path, target)
    for pattern in PICTURES:
        for path in sorted(run.glob(pattern)):
            picture(path, target / path.name)
    for path in sorted(run.glob("data=*/model=gpe_tuned/seed=0/rollout_test_unseen_00.png")) if is_table1 else ():
        picture(path, target / f"rollout_{path.parts[-4].removeprefix('data=')}.png")
    evaluations = [] if runs else evaluations_below(run)
    if (run / FILM).exists():
        film(run / FILM, (target / FILM).with_suffix(".webp"))
    if runs:
        archive(runs, run, target)
    if evaluations:
        archive([replace(found, rows=found.rows[found.rows["horizon"] == "full"]) for found in evaluations], run, target)
    seeds = sorted({int(found.config["seed"]) for found in runs if "seed" in found.config})
    every = sessions(run) or [session for found in evaluations for session in sessions(found.folder)]
    sealed.write(target / PROVENANCE, {"sessions": [*before, *every], "seeds": seeds, "note": note})


def renew(run: Path, name: str, note: str = "") -> None:
    """Replace the records and figures of the models of a suite's run in ``docs/results/{name}``, and make its table again.

    Raises:
        ValueError: the run has not measured all that the folder has of its models.
    """
    target = RESULTS / name
    old, new = (json.loads((folder / "results.json").read_text()) for folder in (target, run))
    old["records"] = renewed(old["records"], new["records"])
    about = {key: value for key, value in old.items() if key != "records"}
    lines = ",\n".join(json.dumps(own) for own in old["records"])
    (target / "results.json").write_text(f'{json.dumps(about)[:-1]}, "records": [\n{lines}\n]}}\n')
    suite = importlib.import_module(f"gpe_pl.benchmarks.{run.name}.suite")
    (target / "table.md").write_text(suite.report(old["records"]) + "\n")
    for pattern in PICTURES:
        for path in sorted(run.glob(pattern)):
            picture(path, target / path.name)
    before = sealed.read(target / PROVENANCE, ADVICE)
    sealed.write(target / PROVENANCE, {**before, "sessions": [*before["sessions"], *sessions(run)], "note": note or before["note"]})


def draw(name: str, figure: str) -> None:
    """Draw a figure of ``gpe_pl.reports`` into ``docs/results/{name}`` from the archive there, and add the session to those of the folder.

    Raises:
        FileNotFoundError: reports draw no such figure of these runs.
    """
    target = RESULTS / name
    with TemporaryDirectory() as folder:
        with recorded(Path(folder), "docs/embed_results.py", ["--draw", name, figure], folder):
            write_tables(Path(folder), finished_runs(target))
        picture(Path(folder, figure), target / figure)
        add_session(target, Path(folder))


def add_session(target: Path, drawn: Path) -> None:
    """Add the session that drew a figure to those of a folder of results. An earlier one of the same command is replaced."""
    (session,) = sessions(drawn)
    before = sealed.read(target / PROVENANCE, ADVICE)
    earlier = [found for found in before["sessions"] if found["command"] != session["command"]]
    sealed.write(target / PROVENANCE, {**before, "sessions": [*earlier, session]})


def renewed(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The old records, in which those of the models of the new records are replaced, test by test or scene by scene."""
    parts: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for own in new:
        parts.setdefault(_part(own), []).append(own)
    models, found = {own["model"] for own in new}, list[dict[str, Any]]()
    for own in old:
        if own["model"] not in models:
            found.append(own)
        elif _part(own) in parts:
            found += parts.pop(_part(own))
        elif _part(own) not in map(_part, found):
            raise ValueError(f"{' '.join(_part(own))}: not measured again; run all that the results have of this model")
    return [*found, *(own for rest in parts.values() for own in rest)]


def _part(own: dict[str, Any]) -> tuple[str, str]:
    return own["model"], own.get("scene", own.get("test", ""))


def record(source: Path, folder: Path) -> None:
    """Copy a file to a folder. JSON and CSV files of more than ``MAX_BYTES`` bytes, which nobody reads as text, are compressed with xz."""
    content = source.read_bytes()
    is_long = source.suffix in (".json", ".csv") and len(content) > MAX_BYTES
    target = folder / source.name
    packed = target.with_name(f"{target.name}.xz")
    (target if is_long else packed).unlink(missing_ok=True)  # of an earlier run
    if is_long:
        packed.write_bytes(lzma.compress(content))
    else:
        target.write_bytes(content)


def picture(source: Path, target: Path) -> None:
    """Write a figure with at most ``MAX_WIDTH`` pixels in a row and ``NUM_COLORS`` colours, which takes a third of the bytes."""
    with Image.open(source) as image:
        opaque = Image.new("RGB", image.size, "white")
        opaque.paste(image, mask=image.convert("RGBA").getchannel("A"))
    if opaque.width > MAX_WIDTH:
        opaque = opaque.resize((MAX_WIDTH, round(opaque.height * MAX_WIDTH / opaque.width)), Image.Resampling.LANCZOS)
    opaque.quantize(NUM_COLORS, dither=Image.Dither.NONE).save(target, optimize=True)


def film(source: Path, target: Path) -> None:
    """Write an animation as WebP, of every second frame."""
    with Image.open(source) as image:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(image)][::2]
        duration = 2 * image.info.get("duration", 50)
    frames[0].save(target, save_all=True, append_images=frames[1:], duration=duration, loop=0, quality=50, method=6)


def listed() -> str:
    """A line per folder of results: what made it, where and when."""
    lines = [table_row(["folder", "command", "commit", "date", "processor", "minutes", "seeds", "note"]), "|" + "---|" * 8]
    for path in sorted(RESULTS.glob(f"*/{PROVENANCE}")):
        about = sealed.read(path, ADVICE)
        every = about["sessions"]
        seconds = [session.get("seconds") for session in every]
        cells = [
            f"`{path.parent.name}`",
            "; ".join(dict.fromkeys(f"`{session['command']}`" for session in every)),
            ", ".join(dict.fromkeys(str(session.get("commit") or "not noted") for session in every)),
            ", ".join(dict.fromkeys(str(session.get("began") or "not noted")[:10] for session in every)),
            ", ".join(dict.fromkeys(str(session.get("processor") or "not noted") for session in every)),
            "not noted" if None in seconds else f"{sum(seconds) / 60:.0f}",
            ", ".join(map(str, about.get("seeds", []))) or "–",
            about.get("note", ""),
        ]
        lines.append(table_row(cells))
    return "\n".join([*lines, ""])


def pages() -> dict[Path, str]:
    """What pages that hold results should say."""
    of_results = RESULTS / "README.md"
    return {README: embedded(README.read_text()), of_results: LIST.sub(lambda m: m[1] + listed() + m[2], of_results.read_text())}


def main(arguments: list[str]) -> int:
    """Collect, renew, embed or check; the exit status."""
    if arguments == ["--check"]:
        return int(any(path.read_text() != text for path, text in pages().items()))
    if arguments[:1] == ["--renew"]:
        renew(Path(arguments[1]), *arguments[2:])
    elif arguments[:1] == ["--draw"]:
        draw(*arguments[1:])
    elif arguments[:1] == ["--add"]:
        collect(Path(arguments[1]), *arguments[2:], adds=True)
    elif arguments:
        collect(Path(arguments[0]), *arguments[1:])
    for path, text in pages().items():
        path.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
