"""Errors of configuration: one line that names the error and the allowed values, exit code 2, no traceback."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from gpe_pl.benchmark import benchmark, without_folder
from gpe_pl.config import entry_point as configuration
from gpe_pl.config.datasets import dataset, dataset_spec, ensure_data
from gpe_pl.config.entry_point import ConfigError, Report, bind, construct, entry_point, output_dir, quoted
from gpe_pl.config.explanations import explain
from gpe_pl.config.folder import CONF
from gpe_pl.errors import GpeError
from gpe_pl.fit import fit
from gpe_pl.models.lookup import UnknownModelError
from tests.runs import compose

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Inner:
    size: Annotated[int, Field(ge=1)]
    kind: Literal["a", "b"] = "a"
    rate: Annotated[float, Field(gt=0)] | None = 0.5
    names: list[str] = field(default_factory=lambda: ["x"])

    def __post_init__(self) -> None:
        if self.kind == "b" and self.size > 5:
            raise ValueError("size must be at most 5 for kind b")


class Network:
    def __init__(self, spec: Any, width: Annotated[int, Field(ge=1)] = 3, *, deep: bool = False) -> None:
        self.spec, self.width, self.deep = spec, width, deep


# --- construct -----------------------------------------------------------------------------------------------------------------------------


def test_construct_checks_and_converts() -> None:
    made = construct(Inner, OmegaConf.create({"size": "3", "kind": "b", "rate": None, "names": ["p", "q"]}), "inner")
    assert made == Inner(3, "b", None, ["p", "q"])
    assert construct(Inner, {"size": 2}, "inner") == Inner(2)
    network = construct(Network, {"width": 7}, "model", spec=SimpleNamespace())
    assert (network.width, network.deep) == (7, False)


def test_construct_resolves_interpolations() -> None:
    cfg = OmegaConf.create({"n": 4, "inner": {"size": "${n}"}})
    assert construct(Inner, cfg.inner, "inner").size == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": 0}, "inner.size=0: must be at least 1"),
        ({"size": "many"}, "inner.size='many': must be an integer"),
        ({"size": 1.5}, "inner.size=1.5: must be an integer"),
        ({"size": None}, "inner.size=None: must be an integer"),
        ({}, "inner.size: is missing; give it a value"),
        ({"size": 1, "kind": "c"}, "inner.kind='c': must be 'a' or 'b'"),
        ({"size": 1, "rate": -1.0}, "inner.rate=-1.0: must be greater than 0"),
        ({"size": 1, "rate": float("inf")}, "inner.rate=inf: must be a finite number"),
        ({"size": 10**30}, f"inner.size={10**30}: must be within ±9223372036854775807"),
        ({"size": 1, "names": ["x", -(10**30)]}, f"inner.names.1={-(10**30)}: must be within ±9223372036854775807"),
        ({"size": 1, "names": ["x", 3]}, "inner.names.1=3: must be text"),
        ({"size": 1, "sise": 2}, "inner.sise: unknown key; did you mean 'size'?; valid keys: size, kind, rate, names"),
        ({"size": 0, "kind": "c"}, "inner.size=0: must be at least 1; inner.kind='c': must be 'a' or 'b'"),
        ({"size": 9, "kind": "b"}, "inner: size must be at most 5 for kind b"),
    ],
)
def test_construct_names_key_value_and_what_is_allowed(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        construct(Inner, settings, "inner")
    assert str(caught.value) == message


def test_a_given_argument_is_no_key() -> None:
    with pytest.raises(ConfigError, match="model.spec: unknown key; valid keys: width, deep"):
        construct(Network, {"spec": 3}, "model", spec=SimpleNamespace())


def test_bind_checks_before_anything_is_built() -> None:
    with pytest.raises(ConfigError, match="model.width=0"):
        bind(Network, {"width": 0}, "model", "spec")
    network = bind(Network, {"width": 2}, "model", "spec")(spec="later")
    assert (network.spec, network.width) == ("later", 2)


def test_typed_errors_pass_through_construct() -> None:
    class Special(GpeError, ValueError):
        pass

    def target(x: int) -> None:
        raise Special("as it is")

    with pytest.raises(Special, match="^as it is$"):
        construct(target, {"x": 1}, "path")


# --- composition ---------------------------------------------------------------------------------------------------------------------------


def complaint(name: str, *overrides: str) -> str:
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"), pytest.raises(HydraException) as caught:
        hydra.compose(name, list(overrides), return_hydra_config=True)
    return explain(caught.value, name, list(overrides))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "override", "words"),
    [
        (
            "fit",
            "trianing.num_steps=5",
            ["trianing.num_steps: unknown key 'trianing'; did you mean 'training'?; valid keys: ", "training", "experiment"],
        ),
        (
            "fit",
            "comparison.budget_minutes=3",
            [
                "'comparison' is the name of a choice and has no keys, write comparison=CHOICE",
                "did you mean 'size.comparison.budget_minutes'?",
            ],
        ),
        ("fit", "training.noise_std=0.3", ["unknown key 'noise_std'; valid keys of training: ", "velocity_noise_of_change"]),
        (
            "fit",
            "training.num_stpes=5",
            ["training.num_stpes: unknown key 'num_stpes'; did you mean 'num_steps'?; valid keys of training: ", "num_steps"],
        ),
        ("fit", "model.interation=odd", ["unknown key 'interation'; did you mean 'interaction'?; valid keys of model: ", "interaction"]),
        (
            "fit",
            "data.scene.num_partcles=3",
            ["unknown key 'num_partcles'; did you mean 'num_particles'?; valid keys of data.scene: ", "num_particles"],
        ),
        (
            "fit",
            "data.sizes.tiny.num_trian=3",
            ["unknown key 'num_trian'; did you mean 'num_train'?; valid keys of data.sizes.tiny: ", "num_train"],
        ),
        ("fit", "data.sizes.tyni.num_train=3", ["unknown key 'tyni'; did you mean 'tiny'?; valid keys of data.sizes: ", "tiny"]),
        ("fit", "experimnt=sand", ["unknown key 'experimnt'; did you mean 'experiment'?; valid keys: ", " experiment,"]),
        ("fit", "modle=gpe", ["unknown key 'modle'; did you mean 'model'?; valid keys: ", " model,"]),
        ("fit", "model=gep", ["model=gep: no such choice; did you mean 'gpe'?; choices: cconv, "]),
        ("fit", "recipe=papr", ["recipe=papr: no such choice; did you mean 'paper'?"]),
        ("fit", "experiment=snad", ["experiment=snad: no such choice; did you mean 'sand'?", "ablation_momentum"]),
        ("fit", "size=tyni", ["size=tyni: no such choice; did you mean 'tiny'?; choices: paper, small, tiny"]),
        ("fit", "~training.num_stpes", ["training.num_stpes"]),
        ("fit", "a=b=c", ["a=b=c: "]),
        ("fit", "num_steps", ["num_steps: cannot be read"]),
        ("fit", "hydra.swep.dir=x", ["hydra.swep.dir"]),
        ("simulate", "data.sede=3", ["unknown key 'sede'; did you mean 'seed'?; valid keys of data: ", "seed"]),
        ("simulate", "num_wrokers=3", ["unknown key 'num_wrokers'; did you mean 'num_workers'?; valid keys: ", "num_workers"]),
        ("benchmark", "suite.num_nods=3", ["unknown key 'num_nods'; did you mean 'num_nodes'?; valid keys of suite: ", "num_nodes"]),
        ("benchmark", "suite=sped", ["suite=sped: no such choice; did you mean 'speed'?"]),
    ],
)
def test_a_misspelling_gets_the_valid_ones(name: str, override: str, words: list[str]) -> None:
    line = complaint(name, override)
    assert all(word in line for word in words), line
    assert "\n" not in line
    assert "See https" not in line


def test_the_keys_are_those_of_the_chosen_groups() -> None:
    line = complaint("fit", "logger=wandb", "logger.projct=x")
    assert "valid keys of logger: kind, mode, project" in line


def test_a_misspelling_beside_a_sweep_gets_the_valid_ones() -> None:
    """In a multi-run, Hydra composes one job but ``sys.argv`` still holds the sweep."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"), pytest.raises(HydraException) as caught:
        hydra.compose("fit", ["model.interation=odd", "seed=0"])
    line = explain(
        caught.value, "fit", ["-m", "model.interation=odd,negated", "seed=0,1", "evaluation.splits=[test,val]", "size=tiny,small"]
    )
    assert "valid keys of model: " in line


# --- values, by the entry points' own checks -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("training.num_steps=-1", "training.num_steps=-1: must be at least 0"),
        ("training.num_steps=", "training.num_steps='': must be an integer"),
        ("training.sampling=unform", "training.sampling='unform': must be 'uniform' or 'activity'"),
        ("training.learning_rate=inf", "training.learning_rate=inf: must be a finite number"),
        ("model.interaction=ood", "model.interaction='ood': must be 'directed', 'negated', 'odd' or 'odd_even'"),
        ("model.hidden_channels=-1", "model.hidden_channels=-1: must be "),
        ("+model.foo=1", "model.foo: unknown key; valid keys: interaction"),
        ("training.velocity_noise_of_change=-1", "training.velocity_noise_of_change=-1: must be "),
        ("training.gradient_clip=0", "training.gradient_clip=0: must be "),
        ("+training.foo=1", "training.foo: unknown key; valid keys: num_steps"),
        ("graph.history=0", "graph.history=0: must be "),
        ("training.val_interval=7", "training: val_interval=7 must divide num_steps="),
        (
            "training.final_learning_rate=1",
            "training: final_learning_rate=1 must be at most learning_rate=0.001, from which the schedule falls",
        ),
        ("evaluation.splits=[tset]", "evaluation.splits.0='tset': must be 'train', 'val', 'test' or 'test_unseen'"),
        ("evaluation.splits=[]", r"evaluation.splits=\[\]: must have at least 1 values"),
        ("evaluation.splits=[val,test,val]", "evaluation.splits=.*must have each split once, val occurs 2 times"),
        ("seed=-1", "seed=-1: must be an integer of at least 0"),
        ("seed=first", "seed='first': must be an integer of at least 0"),
        ("logger.kind=tb", "logger.kind='tb': must be 'csv', 'wandb' or 'tensorboard'"),
        ("trainer.num_workers=-1", "trainer.num_workers=-1: must be "),
    ],
)
def test_fit_names_the_value_before_it_does_anything(override: str, message: str, tmp_path: Path) -> None:
    cfg = compose("fit", override, f"paths.data={tmp_path / 'data'}", f"paths.runs={tmp_path / 'runs'}")
    with pytest.raises(ConfigError, match=f"^{message}"):
        fit(cfg)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("data", ["sand", "fluid", "fem"])
def test_absurd_frame_intervals_are_named(data: str) -> None:
    """Their squares are beyond what computers represent."""
    with pytest.raises(ConfigError, match=r"data.solver.frame_dt=1e\+300: must be at most 1e\+06"):
        dataset_spec(compose("simulate", f"data={data}", "data.solver.frame_dt=1e300"))


@pytest.mark.slow
@pytest.mark.parametrize("target", ["gpe_pl.models.gpe.GEP", "os.system", "3"])
def test_fit_takes_only_models(target: str, tmp_path: Path) -> None:
    with pytest.raises(UnknownModelError, match=f"model '{target}'"):
        fit(compose("fit", f"model._target_='{target}'", f"paths.data={tmp_path}", f"paths.runs={tmp_path}"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.num_train=0", "data.num_train=0: must be at least 1"),
        (
            "data.parameters.sand.extrapolated=[100]",
            r"data: parameters.sand.extrapolated: friction_angle = 100.0 deg is outside 0 … 60, the solvers' limits$",
        ),
        ("data.parameters.sand.interpolated=[20.0]", r"data.parameters.sand: unseen values \[20.0\] are among the seen ones$"),
        ("data.solver.materials=[snad]", "data.scene: materials must be different ones of sand, snow, fluid, elastomer, solid, got "),
        ("data.scene._target_=os.system", "data.scene._target_='os.system': must be a class of gpe_pl.solvers$"),
        ("data.name=a/b", "data.name='a/b': must be a folder's name of letters"),
        ("data.solver.cfl=0", "data.solver.cfl=0: must be greater than 0"),
        ("data.scene.gravity=[0,down]", "data.scene.gravity.1='down': must be a number"),
        ("+data.solver.foo=1", "data.solver.foo: unknown key; valid keys: "),
    ],
)
def test_a_data_set_names_the_value(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}") as caught:
        dataset_spec(compose("simulate", override))
    assert len(str(caught.value)) < 400


# --- entry points --------------------------------------------------------------------------------------------------------------------------


def call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, task: Callable[[DictConfig], Any], *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["command", f"paths.runs={tmp_path}", *arguments])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)  # forgotten again after the test
    GlobalHydra.instance().clear()
    entry_point("benchmark")(task)()


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["speed", "scaling", "skip", "runtime_vs_error"])
def test_a_suite_for_a_gpu_says_that_there_is_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, suite: str
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(SystemExit):
        call(monkeypatch, tmp_path, benchmark, f"suite={suite}", "trainer=gpu")
    assert capsys.readouterr().err.startswith("error: trainer=gpu: PyTorch finds no GPU here")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "arguments", "line"),
    [
        (
            lambda cfg: None,
            ["suit=speed"],
            "error: suit: unknown key 'suit'; did you mean 'suite'?; valid keys: paths, size, suite, trainer",
        ),
        (
            lambda cfg: None,
            ["suite=sped"],
            "error: suite=sped: no such choice; did you mean 'speed'?; choices: acceptance, ",
        ),
        (lambda cfg: None, ["suite=3"], "error: suite=3: must be the name of a choice; `--help` lists them"),
        (lambda cfg: None, ["paths.data=null"], "error: paths.data=None: must be text"),
        (lambda cfg: None, ["+foo=1"], "error: foo: unknown or missing key; valid keys: paths, size, suite, trainer"),
        (benchmark, ["suite.name=nope"], "error: suite.name='nope': must be one of "),
        (benchmark, ["suite.name=trained"], "error: suite.name='trained': must be one of acceptance, "),
        (benchmark, ["suite=solvers", "+trainer.typo=1"], "error: trainer.typo: unknown key; valid keys: "),
        (benchmark, ["suite=solvers", "trainer.accelerator=[1]"], "error: trainer.accelerator=[1]: "),
        (benchmark, ["suite=skip", "suite.edge_states=[]"], "error: suite.edge_states=[]: "),
        (benchmark, ["suite=scaling", "suite.num_nodes=[]"], "error: suite.num_nodes=[]: "),
        (lambda cfg: None, ["suite.name=${nothing}"], "error: Interpolation key 'nothing' not found"),
        (lambda cfg: construct(Inner, {"size": cfg.suite.num_nodes}, "suite"), ["suite.num_nodes=0"], "error: suite.size=0: must be"),
    ],
)
def test_an_entry_point_fails_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, task: Any, arguments: list[str], line: str
) -> None:
    with pytest.raises(SystemExit) as caught:
        call(monkeypatch, tmp_path, task, *arguments)
    assert caught.value.code == 2
    output = capsys.readouterr()
    assert output.err.startswith(line)
    assert output.err.count("\n") == 1 and "search path" not in output.err
    assert output.out == ""


@pytest.mark.parametrize(("error", "code"), [(ConfigError("no table"), 2), (RuntimeError("a bug"), 1)])
def test_a_report_that_fails_fails_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, error: Exception, code: int
) -> None:
    """Hydra alone would turn the exception into a warning and exit with 0."""

    def broken(_: Path) -> None:
        raise error

    monkeypatch.setattr("gpe_pl.reports.sweep_table.report", broken)
    with pytest.raises(SystemExit) as caught:
        Report().on_run_end(OmegaConf.create({"hydra": {"run": {"dir": str(tmp_path)}}}))
    assert caught.value.code == code
    assert str(error) in capsys.readouterr().err


def test_an_unknown_format_of_figures_is_refused_before_anything_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("GPE_FIGURES", "svg,eps")
    with pytest.raises(SystemExit) as caught:
        call(monkeypatch, tmp_path / "runs", lambda cfg: pytest.fail("the command began"))
    assert caught.value.code == 2
    assert "GPE_FIGURES=svg,eps: 'eps' must be svg or pdf" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_an_interruption_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    def task(_: DictConfig) -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as caught:
        call(monkeypatch, tmp_path, task)
    assert caught.value.code == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def task(_: DictConfig) -> None:
        raise ValueError("a bug, not a setting")

    with pytest.raises(ValueError, match="a bug"):
        call(monkeypatch, tmp_path, task)


@pytest.mark.parametrize("command", ["fit", "simulate", "evaluate", "identify", "benchmark", "convert"])
def test_the_log_of_a_command_has_its_name(command: str) -> None:
    assert OmegaConf.load(Path(CONF) / f"{command}.yaml").hydra.job.name == command


@pytest.mark.parametrize("command", ["fit", "simulate", "evaluate", "identify", "benchmark", "convert"])
def test_the_settings_of_a_command_are_known_to_it(command: str) -> None:
    configuration._check_top_level(compose(command), command)


def test_results_do_not_say_where_they_lay(tmp_path: Path) -> None:
    runs = str(tmp_path / "runs")
    settings = {
        "runs": [f"{runs}/table1", runs, f"{runs}_old"],
        "cases": {"sand": {"overrides": [f"name={runs}"]}},
        "budget": 5.0,
        "size": None,
    }
    assert without_folder(settings, runs) == {**settings, "runs": ["paths.runs/table1", "paths.runs", f"{runs}_old"]}
    assert without_folder({"runs": ["runs/table1"]}, "runs") == {"runs": ["paths.runs/table1"]}
    assert without_folder({"runs": [f"{runs}/table1"]}, f"{runs}/") == {"runs": ["paths.runs/table1"]}


def test_without_hydra_the_output_lies_under_runs(tmp_path: Path) -> None:
    assert output_dir(OmegaConf.create({"paths": {"runs": str(tmp_path)}, "name": "x"})) == tmp_path / "x"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "arguments", "line"),
    [
        (
            "fit",
            ["-m", "model.interation=odd,negated", "seed=0,1"],
            "error: model.interation: unknown key 'interation'; did you mean 'interaction'?; valid keys of model: ",
        ),
        pytest.param(
            *("fit", ["training.num_steps=-1"], "error: training.num_steps=-1: must be "),
            marks=pytest.mark.long,
        ),
        ("simulate", ["num_workers=0"], "error: num_workers=0: must be null (one per core) or an integer of at least 1"),
        pytest.param(
            *("benchmark", ["suite.num_rounds=none"], "error: suite.num_rounds='none': must be an integer"),
            marks=pytest.mark.long,
        ),
    ],
)
def test_commands_fail_in_one_line(tmp_path: Path, command: str, arguments: list[str], line: str) -> None:
    child = subprocess.run(
        [sys.executable, "-m", f"gpe_pl.{command}", *arguments, f"paths.runs={tmp_path}", f"paths.data={tmp_path}"],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert child.returncode == 2
    errors = child.stderr.splitlines()
    assert len(errors) == 1
    assert errors[0].startswith(line)
    assert "Traceback" not in child.stdout + child.stderr


def test_a_path_is_taken_as_typed(tmp_path: Path) -> None:
    run = tmp_path / "data=sand" / "seed=0"
    run.mkdir(parents=True)
    assert compose("evaluate", quoted(f"checkpoint={run}")).checkpoint == str(run)
    for name in ("müller", "a (1)", "a,b", 'inches"', "a#b", "näch'ste", "ü\\", 'ü\\"'):
        (tmp_path / name).mkdir()
        assert compose("evaluate", quoted(f"checkpoint={tmp_path / name}")).checkpoint == str(tmp_path / name)
        if "," not in name:  # a folder that is still to be made
            new = str(tmp_path / name / "new=1")
            assert compose("evaluate", quoted(f"checkpoint={new}")).checkpoint == new
    for argument in (
        f"checkpoint={tmp_path}",
        "checkpoint=",
        "model.decoder=node",
        f'checkpoint="{run}"',
        "--help",
        "a=b=c",
        "a=" + 200 * "b=c",
        "a=range(1,3)",
        "model.hidden_channels=8,16",
        f"paths.runs={tmp_path}/x=1,{tmp_path}/x=2",
        "a=${paths.runs}/x",
    ):
        assert quoted(argument) == argument
    assert "a value that holds = needs quotes: 'KEY=\"VALUE\"'" in complaint("evaluate", f"checkpoint={run}0")


def test_a_full_disk_is_named_where_there_is_no_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> str:
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", none)
    assert Path("results") in configuration._written({"runs": "results"})


def test_large_data_of_a_split_are_named_and_asked_for(tmp_path: Path) -> None:
    """The name of such data is no choice of ``data=``."""
    cfg = compose("fit", "data=fem", "parameters=paper", "size=paper", f"paths.data={tmp_path}")
    with pytest.raises(ConfigError, match=r"fem_paper/paper: no data; .*gpe_pl\.simulate` and the data, parameters, ") as info:
        ensure_data(cfg)
    assert "data=fem_paper" not in str(info.value)


def test_a_suite_that_computes_on_the_cpu_refuses_a_gpu(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    with pytest.raises(SystemExit):
        call(monkeypatch, tmp_path, benchmark, "suite=stability", "trainer=gpu")
    assert capsys.readouterr().err.startswith("error: trainer.accelerator=gpu: suite=stability computes on the CPU; leave trainer=gpu out")


def test_a_command_in_one_process_refuses_several(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit):
        call(monkeypatch, tmp_path, benchmark, "suite=stability", "trainer.devices=2")
    assert capsys.readouterr().err.startswith(
        "error: trainer.devices=2: sets 2 processes, and only gpe_pl.fit computes in several; leave it out"
    )


@pytest.mark.slow
@pytest.mark.parametrize("suite", sorted(path.stem for path in (CONF / "suite").glob("*.yaml")))
def test_the_size_of_a_benchmark_is_that_of_its_data_sets(suite: str) -> None:
    by_size = [compose("benchmark", f"suite={suite}", f"size={size}").suite.get("cases", {}) for size in ("tiny", "small")]
    for name in by_size[0]:
        own, other = (dataset(*cases[name].overrides).size for cases in by_size)
        assert (own, other) == ("tiny", "small"), name
