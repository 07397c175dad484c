"""Typical mistakes on the command line. Each is answered in one line, before any work is done, with what was typed and the next step."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from gpe_pl import __main__ as script

JARGON = (
    "EQUAL",
    "Lexer",
    "usage:",
    "Traceback",
    "unrecognized",
    "mismatched",
    "extraneous",
    "Input should",
    "Hydra",
    "ConfigAttributeError",
)

MISTAKES = [
    # a setting in another form
    ("fit data sand", "data: write data=sand"),
    ("fit --data sand", "--data sand: settings have no dashes; write data=sand"),
    ("fit --data=sand", "--data=sand: settings have no dashes; write data=sand"),
    ("fit --batch-size 4", "--batch-size 4: settings have no dashes; write batch_size=4"),
    ("fit data = sand", "data =: write data=sand without spaces"),
    ("fit data= sand", "data= sand: write data=sand without spaces"),
    ("fit data:sand", "data:sand: write data=sand"),
    ("fit sand", "sand: write data=sand or experiment=sand"),
    ("fit epochs", "epochs: settings are KEY=VALUE; `--help` lists the keys"),
    ("fit name=my run", "run: settings are KEY=VALUE"),
    ("fit a=b=c", "a=b=c: a value that holds = needs quotes"),
    ("fit seed=[0", "seed=[0: cannot be read; write lists as 'seed=[A,B]'"),
    # misspelt keys and choices
    ("fit dta=sand", "dta: unknown key 'dta'; did you mean 'data'?; valid keys: "),
    ("fit data=sadn", "data=sadn: no such choice; did you mean 'sand'?; choices: "),
    ("fit model=GPE", "model=GPE: no such choice; did you mean 'gpe'?"),
    ("fit size=medium", "size=medium: no such choice; choices: paper, small, tiny"),
    ("fit num_steps=100", "num_steps: unknown key 'num_steps'; did you mean 'training.num_steps'?"),
    ("fit learning_rate=1e-3", "learning_rate: unknown key 'learning_rate'; did you mean 'training.learning_rate'?"),
    ("fit training.lerning_rate=1e-3", "training.lerning_rate: unknown key 'lerning_rate'; did you mean 'learning_rate'?; valid keys of training: "),
    ("benchmark suite=sped", "suite=sped: no such choice; did you mean 'speed'?"),
    ("convert format=lagrangbench source=x name=y", "format='lagrangbench': must be 'gns', "),
    # impossible values
    ("fit training.num_steps=many", "training.num_steps='many': must be an integer"),
    ("fit training.learning_rate=0", "training.learning_rate=0: must be greater than 0"),
    ("fit trainer=gpu", "trainer=gpu: PyTorch finds no GPU here; choose trainer=cpu"),
    ("fit trainer.accelerator=gpu", "trainer.accelerator=gpu: PyTorch finds no GPU here"),
    ("fit dimension=4", "dimension=4: must be 2 or 3"),
    ("fit evaluation.splits=[tset]", "evaluation.splits.0='tset': must be 'train', 'val', 'test' or 'test_unseen'; did you mean 'test'?"),
    ("fit data.num_test=0 evaluation.splits=[test]", "evaluation.splits=test: data=sand with size=tiny has no such trajectories, only train, val, test_unseen"),
    ("simulate num_workers=0", "num_workers=0: must be null (one per core) or an integer of at least 1"),
    ("simulate data.parameters.sand.extrapolated=[80]", "data: parameters.sand.extrapolated: friction_angle = 80.0 deg is outside 0 … 60"),
    # models
    ("evaluate", "checkpoint=None: name the folder of a run, such as runs/sand, or a checkpoint, or a shipped model: elastomer, "),
    ("evaluate checkpoint=sand split=tset", "split=tset: must be one of train, val, test, test_unseen; did you mean 'test'?"),
    ("evaluate checkpoint=sand data.num_test_unseen=0 split=test_unseen", "split=test_unseen: data=sand with size=tiny has no such trajectories"),
    ("evaluate checkpoint=snad", "snad: no such checkpoint; did you mean 'sand'?"),
    ("demo snad", "gpe demo snad: name a shipped model (elastomer, fem, fluid, sand, snow), or the folder of a run; did you mean 'sand'?"),
    ("demo sand seconds=long", "seconds=long: must be a number from 0.001 to 3600"),
    ("info --checkpoint sand", "--checkpoint: settings have no dashes"),
    ("fti data=sand", "gpe 'fti': unknown verb; did you mean 'fit'?"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "answer"), MISTAKES, ids=[typed for typed, _ in MISTAKES])
def test_a_mistake_is_answered(
    typed: str, answer: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    verb, *arguments = typed.split(" ")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)  # forgotten again after the test
    GlobalHydra.instance().clear()
    main: Any = script.main
    if verb in script.VERBS:
        main = importlib.import_module(f"gpe_pl.{script.VERBS[verb][0]}").main
        monkeypatch.setattr(sys, "argv", [verb, *arguments])
    else:
        monkeypatch.setattr(sys, "argv", ["gpe", *typed.split(" ")])
        monkeypatch.setattr("gpe_pl.system.early_interrupts.catch", lambda: None)
    with pytest.raises(SystemExit) as caught:
        main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.err.startswith(f"error: {answer}"), printed.err
    assert printed.err.count("\n") == 1
    assert not [word for word in JARGON if word in printed.err]
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix in (".h5", ".ckpt")]
