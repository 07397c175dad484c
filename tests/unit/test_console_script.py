"""The console script ``gpe``: verbs, completion, and a wheel that works outside the clone."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from gpe_pl import __main__ as script
from gpe_pl.system.command_line import ArgumentFault, integer, number, parsed, truth

ROOT = Path(__file__).parents[2]


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["gpe", *arguments])
    monkeypatch.setattr("gpe_pl.system.early_interrupts.catch", lambda: None)
    script.main()


def test_every_verb_is_a_module() -> None:
    assert all((ROOT / "gpe_pl" / f"{module.replace('.', '/')}.py").exists() for module, _ in script.VERBS.values())


def test_without_a_verb_all_are_listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    call(monkeypatch)
    printed = capsys.readouterr().out
    assert all(f"\n  {verb} " in printed for verb in script.VERBS)


def test_a_misspelt_verb_gets_the_one_that_was_meant(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        call(monkeypatch, "dmeo", "sand")
    assert caught.value.code == 2
    assert capsys.readouterr().err.startswith("error: gpe 'dmeo': unknown verb; did you mean 'demo'?; verbs: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("gpe ", {"fit", "demo"}),
        ("gpe fit data=sn", {"data=snow", "data=snow_on_liquid"}),
        ("gpe demo s", {"sand", "snow", "seconds=", "seed="}),
        ("gpe predict scene.yaml checkpoint=f", {"checkpoint=fem", "checkpoint=fluid"}),
    ],
)
def test_words_complete(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], line: str, words: set[str]) -> None:
    monkeypatch.setenv("COMP_LINE", line)
    if not line.startswith("gpe fit"):
        call(monkeypatch, "completion", "words")
        printed = set(capsys.readouterr().out.split())
        assert words <= printed if line == "gpe " else words == printed
    else:  # Hydra ends the process
        found = subprocess.run([sys.executable, "-m", "gpe_pl", "completion", "words"], capture_output=True, text=True, cwd=ROOT)
        assert set(found.stdout.split()) == words


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "3"], "--seed: settings have no dashes; write seed=… (keys: seed, open)"),
        (["--seed=3"], "--seed=3: settings have no dashes; write seed=3 (keys: seed, open)"),
        (["seed", "3"], "seed 3: write seed=3"),
        (["sede=3"], "sede: unknown key; did you mean 'seed'?; keys: seed, open"),
        (["seed=x"], "seed=x: must be an integer from 0 to 9"),
        (["open=perhaps"], "open=perhaps: must be true or false"),
        (["sand", "snow"], "sand snow: give one model, and settings as KEY=VALUE (keys: seed, open)"),
    ],
)
def test_arguments_are_answered_in_a_line(arguments: list[str], message: str) -> None:
    with pytest.raises(ArgumentFault) as caught:
        parsed(arguments, "model", {"seed": integer(0, 9), "open": truth})
    assert str(caught.value) == message


def test_a_folder_of_a_sweep_is_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "depth=3").mkdir()
    for word in ("depth=3", "runs/mine/depth=3", str(tmp_path / "depth=3")):
        assert parsed([word, "seed=3"], "model", {"seed": integer(0, 9)}) == (word, {"seed": 3})
    with pytest.raises(ArgumentFault, match="depth: unknown key"):
        parsed(["depth=4"], "model", {"seed": integer(0, 9)})


def test_arguments_have_types() -> None:
    assert parsed(["sand", "seed=3", "open=False"], "model", {"seed": integer(0, 9), "open": truth}) == ("sand", {"seed": 3, "open": False})
    assert number(0.0, 1.0)("0.5") == 0.5
    with pytest.raises(ValueError, match="must be a number from 0 to 1"):
        number(0.0, 1.0)("nan")


@pytest.mark.long
def test_a_wheel_works_outside_the_clone(tmp_path: Path) -> None:
    """The new environment sees the dependencies of this one, but not the package."""
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    others = [path for path in sys.path if path.endswith("site-packages")]
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    (site / "dependencies.pth").write_text("\n".join(others))  # below the package of this environment, which a .pth file in it would name
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "DISPLAY", "WAYLAND_DISPLAY")}
    (tmp_path / "scene.yaml").write_text("box: [1.0, 1.0]\nbodies:\n  - {block: sand, at: [0.1, 0.0], size: [0.2, 0.1]}\n")
    for arguments in (
        ["demo", "sand", "seconds=0.1"],
        ["info", "sand", "speed=false"],
        ["predict", "scene.yaml", "seconds=0.1"],
        ["play", "sand", "folder=page"],
        ["fit", "--help"],
    ):
        done = subprocess.run([python.with_name("gpe"), *arguments], capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
    assert all((tmp_path / name).stat().st_size > 50_000 for name in ("demo_sand.html", "scene.html", "page/play.js"))
