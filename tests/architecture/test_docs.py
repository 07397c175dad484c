"""The guide names only things that exist, everything that exists is named, and every command in the guide composes."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf

from gpe_pl.__main__ import VERBS
from gpe_pl.config.entry_point import compose
from gpe_pl.config.explanations import groups
from gpe_pl.data.importers import Format
from gpe_pl.system.command_line import parsed

ROOT = Path(__file__).resolve().parents[2]
GUIDE = ROOT / "docs" / "guide"
PAGES = (ROOT / "README.md", ROOT / "docs" / "index.md", ROOT / "docs" / "faq.md", *sorted(GUIDE.glob("*.md")))
MOST_WORDS = 2500  # ten minutes of reading
CODE_WIDTH = 88  # characters that a built page shows
NO_COMPOSITION = {"--help", "--cfg", "job", "--resolve", "-m"}


def commands() -> dict[str, tuple[str, list[str]]]:
    """Return name and overrides of every command of the package on a page, with the first value of each sweep."""
    found: dict[str, tuple[str, list[str]]] = {}
    for page in PAGES:
        blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
        lines = [
            *"\n".join(blocks).replace("\\\n", " ").splitlines(),
            *re.findall(r"`((?:python -m gpe_pl\.|gpe )[^`]+)`", page.read_text()),
        ]
        for command in (part.strip() for line in lines for part in line.split("&&")):
            if match := re.match(r"(?:python -m gpe_pl\.|gpe )(fit|simulate|evaluate|identify|benchmark|convert)\b(.*)", command):
                words = [word for word in shlex.split(match[2], comments=True) if word not in NO_COMPOSITION]
                if not any("…" in word or word.isupper() for word in words):
                    found[f"{match[1]} {' '.join(words)}"] = match[1], [re.sub(r"^([^=\[{]+=[^,\[{]+),.*", r"\1", word) for word in words]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("name", "overrides"), commands().values(), ids=commands())
def test_commands_compose(name: str, overrides: list[str]) -> None:
    GlobalHydra.instance().clear()
    compose(name, [word for word in overrides if not word.startswith(("hydra/", "hydra."))])


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_verbs_of_the_console_script_exist(page: Path) -> None:
    """Verbs without a configuration of Hydra have keys of their own."""
    for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if match := re.match(r"gpe (\w+)(.*)", line):
                verb, words = match[1], shlex.split(match[2], comments=True)
                assert verb in VERBS or verb == "completion", line
                if "." in VERBS[verb][0]:
                    keys = importlib.import_module(f"gpe_pl.{VERBS[verb][0]}").KEYS
                    parsed([word for word in words if "…" not in word], "word", keys)


def named(page: str, key: str) -> set[str]:
    """Return the first columns of the table whose head is ``key=``."""
    rows = re.search(rf"\| `(?:benchmark )?{key}=` \|.*?\n\n", (GUIDE / page).read_text() + "\n\n", re.DOTALL)
    assert rows, f"{page} has no table of {key}="
    cells = [row.split("|")[1] for row in rows[0].strip().splitlines()[2:]]
    return {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}


@pytest.mark.parametrize(("page", "key"), [("training.md", "experiment"), ("speed.md", "suite"), ("data.md", "data")])
def test_tables_name_every_choice(page: str, key: str) -> None:
    choices = {path.stem for path in (ROOT / "conf" / key).glob("*.yaml")} - {"imported"}
    assert named(page, key) == choices


@pytest.mark.parametrize("command", ["fit", "evaluate", "simulate", "identify", "benchmark"])
def test_help_names_every_choice(command: str) -> None:
    file = OmegaConf.load(ROOT / "conf" / f"{command}.yaml")
    listed = listed_help(file)
    for group in groups(command) - {"paths"}:
        text = re.search(rf"^{group} .*\n(?: +\S.*\n)*", listed, re.MULTILINE)
        assert text, f"{command} --help does not have {group}"
        choices = {path.stem for path in (ROOT / "conf" / group).glob("*.yaml")} - ({"imported"} if command == "simulate" else set())
        assert choices <= set(re.findall(r"\w+", text[0])), f"{command} --help, {group}"
    for key in {*map(str, file)} - {"defaults", "hydra", "evaluation"}:
        assert re.search(rf"^(?:\w+, )?{key}\b", listed, re.MULTILINE), f"{command} --help does not have {key}"


@pytest.mark.slow
@pytest.mark.parametrize("command", ["fit", "evaluate", "simulate", "identify", "benchmark", "convert"])
def test_help_says_the_defaults(command: str) -> None:
    GlobalHydra.instance().clear()
    file, cfg = OmegaConf.load(ROOT / "conf" / f"{command}.yaml"), compose(command, [])
    defaults: Any = OmegaConf.to_container(file.defaults)  # interpolations as they are
    chosen = {group: choice for default in defaults if isinstance(default, dict) for group, choice in default.items()}
    compared = 0
    for keys, said in re.findall(r"^(\w\S*(?:, \w\S*)*) .*\(([^()]+)\)$", listed_help(file), re.MULTILINE):
        for key, value in zip(keys.split(", "), said.split(", "), strict=False):
            default = chosen.get(key, OmegaConf.select(cfg, key))
            if default is not None and not OmegaConf.is_interpolation(file, key):  # otherwise the help says how it is computed
                assert str(yaml.safe_load(value)) == str(default), f"{command} --help, {key}"
                compared += 1
    assert compared


def listed_help(file: DictConfig | ListConfig) -> str:
    return str(file.hydra.help.template).replace("${hydra.help.app_name}", "")


def test_every_format_is_in_the_table() -> None:
    assert named("own_data.md", "format") == {*get_args(Format)}


def test_every_notebook_is_in_the_table() -> None:
    listed = set(re.findall(r"\| `(\w+)\.ipynb`", (GUIDE / "notebooks.md").read_text()))
    assert listed == {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}


def test_no_page_takes_more_than_ten_minutes() -> None:
    lengths = {page.name: len(page.read_text().split()) for page in PAGES}
    assert not {name: length for name, length in lengths.items() if length > MOST_WORDS}


def test_code_fits_a_built_page() -> None:
    blocks = ((page.name, block) for page in PAGES for block in re.findall(r"```(?:sh|python)\n(.*?)```", page.read_text(), re.DOTALL))
    assert not [(name, line) for name, block in blocks for line in block.splitlines() if len(line) > CODE_WIDTH]


def test_the_embedded_viewer_is_small() -> None:
    assert (ROOT / "docs" / "_static" / "viewer.html").stat().st_size < 600_000
