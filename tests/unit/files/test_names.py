"""Names become folders within their parent folder, on every system."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpe_pl.config.datasets import imported_data
from gpe_pl.config.entry_point import ConfigError, compose
from gpe_pl.evaluate import evaluate_checkpoint
from gpe_pl.files.names import NameRefused, data_name, portable, run_name, sweep_name
from gpe_pl.fit import fit

LEAD_OUT = ["..", "../x", "a/../../x", "/etc/x", "a//b", "a/", "", " ", ".", "./a", ".hidden", "a/.lock"]
UNPORTABLE = ["C:\\x", "a:b", "a?b", 'a"b', "con", "NUL.txt", "a/LPT1", "end.", "end ", " start"]
UNSHOWN = ["a\x1b[31m", "a\nerror: forged", "a\u202eb", "a\x00b", "a\udcffb", "a\u200bb"]
LONG = ["x" * 201, "é" * 101, "x" * 60_000]


@pytest.mark.parametrize("name", [*LEAD_OUT, *UNPORTABLE, *UNSHOWN, *LONG, None, 3])
def test_names_that_are_no_folders_are_refused_in_one_short_line(name: Any) -> None:
    for check in (run_name, data_name):
        with pytest.raises(NameRefused, match="^some.key=") as refused:
            check(name, "some.key")
        assert len(str(refused.value)) < 400 and str(refused.value).isprintable()


@pytest.mark.parametrize("name", ["mine", "table1/gpe/seed=0", "größe 2", "a.b-c_d", "x" * 200, "model.interaction=negated", "console"])
def test_names_of_runs_may_be_nested_and_hold_spaces_and_letters_of_all_languages(name: str) -> None:
    assert run_name(name) == name


@given(st.text(max_size=20) | st.text("./\\ :a~", max_size=8))
def test_what_is_accepted_is_a_folder_below_the_results(name: str) -> None:
    try:
        run_name(name)
    except NameRefused:
        return
    root = Path("/results")
    assert (root / name).resolve().is_relative_to(root) and (root / name).resolve() != root


def test_names_of_data_sets_are_plain() -> None:
    assert data_name("a.b-c_9") == "a.b-c_9"
    for name in ("a b", "größe", "a/b", "-a", "_a"):
        with pytest.raises(NameRefused, match="must be a folder's name of letters, digits"):
            data_name(name)


def test_the_folder_of_a_run_in_a_sweep_stays_in_the_sweep() -> None:
    assert sweep_name("seed=0/model.interaction=odd") == "seed=0/model.interaction=odd"
    assert sweep_name("start_from=/runs/sand/seed=1") == "start_from=/runs/sand/seed=1"
    assert sweep_name("start_from=../sand") == "start_from=.~2E/sand"  # a folder of that name
    for overrides in ("start_from=a/../../../x", "..", "name=\x1b[31m", "x=" + 255 * "a"):
        with pytest.raises(NameRefused):
            sweep_name(overrides)


def test_the_folder_of_a_run_in_a_sweep_can_be_made_on_windows() -> None:
    assert sweep_name(r"start_from='C:\runs\a'/seed=0") == "start_from='C~3A~5Cruns~5Ca'/seed=0"
    assert sweep_name("a={b:1}/c=*/d='x?'/e=\"f\"/g=a~b") == "a={b~3A1}/c=~2A/d='x~3F'/e=~22f~22/g=a~7Eb"
    assert sweep_name("start_from=/aux/con.ckpt/end./x ") == "start_from=/~61ux/~63on.ckpt/end~2E/x~20"
    with pytest.raises(NameRefused, match="at most 255 bytes"):
        sweep_name("x=" + 100 * ":")


@given(st.text(".~ :*2Eaconx=", max_size=8), st.text(".~ :*2Eaconx=", max_size=8))
def test_parts_of_paths_become_portable_and_stay_different(one: str, other: str) -> None:
    one, other = one.lstrip(". "), other.lstrip(". ")
    for part in filter(None, (one, other)):
        assert run_name(portable(part)) == portable(part)
    assert (portable(one) == portable(other)) == (one == other)


@pytest.mark.slow
def test_commands_refuse_names_before_they_make_folders(tmp_path: Path) -> None:
    paths = [f"paths.data={tmp_path}/data", f"paths.runs={tmp_path}/runs"]
    with pytest.raises(NameRefused, match=r"^reuse='\.\./x': must not"):
        fit(compose("fit", [*paths, "reuse=../x"]))
    with pytest.raises(NameRefused, match=r"^name='a/\.\./\.\./x': must not"):
        evaluate_checkpoint(compose("evaluate", [*paths, "checkpoint=sand", "size=small", "name=a/../../x"]))
    with pytest.raises(NameRefused, match=r"^data\.name='\.\./\.\./x': must"):
        imported_data(compose("fit", [*paths, "data=imported", "data.name=../../x"]))
    with pytest.raises(NameRefused, match=r"^data\.name='\.\./\.\./x': must"):
        fit(compose("fit", [*paths, "data=imported", "data.name=../../x"]))
    assert not [*tmp_path.iterdir()]


def test_hydra_makes_no_folder_outside_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    import sys

    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig

    from gpe_pl.config import entry_point

    monkeypatch.setattr(entry_point, "clean_messages", lambda: None)  # for the whole process
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)  # restored
    monkeypatch.chdir(tmp_path)
    for command, override, said in (
        ("fit", "name=a/../../x", "error: name='a/../../x': must not begin with a dot, nor lead outside"),
        ("benchmark", "suite.name=../../x", "error: suite.name='../../x': must not begin with a dot"),
    ):
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # which a command changes
        monkeypatch.setattr(sys, "argv", [command, override, f"paths.runs={tmp_path}/runs"])
        GlobalHydra.instance().clear()
        with pytest.raises(SystemExit, match="2"):
            entry_point.entry_point(command)(lambda cfg: None)()
        line, *more = capsys.readouterr().err.splitlines()
        assert line.startswith(said) and "\n" not in line and not more
        assert not [warning for warning in recwarn if "Callback" in str(warning.message)]
    assert not [*tmp_path.iterdir()]


def test_a_name_on_the_command_line_is_a_config_error() -> None:
    from gpe_pl.config.entry_point import _check_name

    with pytest.raises(ConfigError, match=r"^name='a:b': holds :"):
        _check_name(compose("evaluate", ["checkpoint=sand", "name='a:b'"]), "evaluate")
