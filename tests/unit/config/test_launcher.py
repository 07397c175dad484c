"""Launchers run the commands of their jobs: values come back, and failures are named with their logs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import OmegaConf

from gpe_pl.config.launcher import CommandLauncher, Job, ProcessLauncher, RayLauncher, SlurmLauncher, SweepError, UsageError

COMMAND = """
import json, os, sys
from pathlib import Path
x = next(a for a in sys.argv if a.startswith("x=")).removeprefix("x=")
print("here is", Path.cwd().name, *sys.argv[1:])
if x == "bad":
    sys.exit("error: x is bad")
if x == "wrong":
    sys.exit(64)
if x == "noisy":
    print("error: it broke", "6/6 0:00:00", sep="\\n")
    sys.exit(1)
if x == "killed":
    sys.stdout.flush()
    os.kill(os.getpid(), 9)
Path(os.environ["GPE_PL_RESULT"]).write_text(json.dumps(float(x) ** 2))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Make a folder with a command ``python -m square x=…``."""
    (tmp_path / "square.py").write_text(COMMAND)
    return tmp_path


def outcomes(launcher: CommandLauncher, folder: Path, *values: str) -> dict[str, Any]:
    """Return status and value of each job."""
    launcher.config = OmegaConf.create({})
    jobs = [Job([f"x={v}"], Path("sweep"), f"x={v}", folder) for v in values]
    found = {}
    for k, outcome in launcher.run(jobs, "square"):
        assert outcome.overrides == [f"x={values[k]}"]
        found[values[k]] = outcome._return_value if outcome.status is JobStatus.COMPLETED else str(outcome._return_value)
        if isinstance(outcome._return_value, UsageError):
            found[values[k]] = UsageError
    return found


LAUNCHERS = {
    "processes": lambda: ProcessLauncher(2),
    "slurm": lambda: SlurmLauncher("local", {"timeout_min": 5}),
    "ray": lambda: RayLauncher(num_cpus=0.5),
}


@pytest.mark.parametrize("name", ["processes", pytest.param("slurm", marks=pytest.mark.slow), pytest.param("ray", marks=pytest.mark.long)])
def test_a_job_is_its_command_wherever_it_runs(folder: Path, name: str) -> None:
    if name != "processes":
        pytest.importorskip({"slurm": "submitit"}.get(name, name))
    found = outcomes(LAUNCHERS[name](), folder, "2", "bad", "wrong", "3")
    assert {k: found[k] for k in ("2", "3")} == {"2": 4.0, "3": 9.0}
    log = folder / "sweep" / "x=bad" / "output.log"
    assert found["bad"] == f"x is bad (see {log})"
    assert found["wrong"] is UsageError
    assert f"here is {folder.name} x=bad hydra.run.dir=" in log.read_text()
    assert not [*folder.rglob(".result")]


class Fixed(CommandLauncher):
    """Launcher that ends jobs with given results."""

    def __init__(self, **ends: Any) -> None:
        self.ends = ends
        self.ended = 0

    def place(self, jobs: Any) -> str:
        return "nowhere"

    def _job(self, number: int, overrides: Any) -> Job:
        return Job(list(overrides), Path("sweep"), overrides[0])

    def run(self, jobs: Any, module: str) -> Iterator[Any]:
        for k, job in enumerate(jobs):
            end = self.ends[job.name]
            self.ended += 1
            yield k, job.failed(end) if isinstance(end, Exception) else job.outcome(end)


def launched(launcher: Fixed, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    launcher.config = OmegaConf.create({"hydra": {"sweep": {"dir": "sweep"}}})
    monkeypatch.setattr("gpe_pl.config.launcher.setup_globals", lambda: None)
    monkeypatch.setattr("sys.modules", {**sys.modules, "__main__": pytest})
    return launcher.launch([[name] for name in launcher.ends], 0)


@pytest.mark.parametrize(
    ("value", "reason"), [("noisy", "it broke"), ("killed", "killed (by SIGKILL, as the system does when memory is short)")]
)
def test_a_failed_job_says_why(folder: Path, value: str, reason: str) -> None:
    log = folder / "sweep" / f"x={value}" / "output.log"
    log.parent.mkdir(parents=True)
    log.write_text("error: of an earlier start\n")
    assert outcomes(ProcessLauncher(1), folder, value) == {value: f"{reason} (see {log})"}


def test_values_of_good_jobs_are_there_though_others_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost() -> Any:
        raise OSError("the node\nis gone")

    good = Job(["a"], Path(), "a").failed(ValueError())
    good.status, good._return_value = JobStatus.COMPLETED, 5.0
    returns = launched(Fixed(a=lambda: good, b=ValueError("no"), c=lost), monkeypatch)
    assert returns[0].return_value == 5.0
    for failed in returns[1:]:
        with pytest.raises(
            RuntimeError, match=r"2 of 3 runs failed; the same command runs only those again. b: no; c: OSError: is gone \(see"
        ):
            _ = failed.return_value


def test_two_runs_with_the_same_folder_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second would find the results of the first, and count as done."""
    launcher = Fixed(a=ValueError("no"))
    monkeypatch.setattr(launcher, "_job", lambda number, overrides: Job([*overrides, f"trainer={number}"], Path("sweep"), "same"))
    launcher.ends |= {"b": ValueError("no")}
    with pytest.raises(UsageError, match="two runs would have the same folder same: a trainer=0, and b trainer=1; leave one of them out"):
        launched(launcher, monkeypatch)
    assert launcher.ended == 0


def test_a_wrong_configuration_ends_a_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    launcher = Fixed(a=UsageError("key=3: must be 4"), b=ValueError("no"))
    with pytest.raises(UsageError, match="key=3: must be 4"):
        launched(launcher, monkeypatch)
    assert launcher.ended == 1


@pytest.mark.parametrize(("make", "module", "extra"), [(RayLauncher, "ray", "ray"), (SlurmLauncher, "submitit", "slurm")])
def test_what_a_launcher_needs_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch, make: Any, module: str, extra: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"hydra/launcher={extra} needs {module}: `pip install {module}`"):
        outcomes(make(), folder, "1")


def test_a_cluster_that_cannot_be_reached_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: Any) -> None:
        raise ConnectionError("nobody answers\nat host:6379")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    with pytest.raises(UsageError, match=r"hydra/launcher=ray: .* cannot be reached \(nobody answers at host:6379\)"):
        outcomes(RayLauncher("host:6379"), folder, "1")


def test_wrong_settings_are_named(folder: Path) -> None:
    with pytest.raises(ValueError, match="hydra.launcher.cluster='pbs': must be slurm, local or debug"):
        SlurmLauncher("pbs")
    pytest.importorskip("submitit")
    with pytest.raises(UsageError, match="hydra.launcher.parameters: .*hours"):
        outcomes(SlurmLauncher("debug", {"hours": 3}), folder, "1")


def test_an_interrupted_sweep_says_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupted(ProcessLauncher):
        def run(self, jobs: Any, module: str) -> Iterator[tuple[int, JobReturn]]:
            yield 1, JobReturn(jobs[1].overrides, status=JobStatus.COMPLETED, _return_value=0.5)
            raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["__main__"], "__spec__", SimpleNamespace(name="gpe_pl.fit"))
    launcher = Interrupted(1)
    launcher.config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})
    monkeypatch.setattr(launcher, "_job", lambda number, overrides: Job([*overrides], Path("sweep"), f"x={number}", tmp_path))
    with pytest.raises(
        SweepError, match=r"^interrupted with 1 of 3 runs done; run the same command again to continue, each output.log says"
    ):
        launcher.launch([["x=0"], ["x=1"], ["x=2"]], 0)
