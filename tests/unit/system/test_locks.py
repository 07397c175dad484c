"""Only one command at a time writes to a folder."""

from __future__ import annotations

import errno
import fcntl
import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from filelock import UnixFileLock
from omegaconf import OmegaConf

from gpe_pl import save_dataset
from gpe_pl.config.entry_point import Report
from gpe_pl.simulate import simulate
from gpe_pl.system import locks
from gpe_pl.system.locks import FolderError, alone, locked
from gpe_pl.trajectory.trajectory import Trajectory
from tests.runs import DATA, compose, generate_tiny

ROOT = Path(__file__).parents[3]
OTHER = """
import sys
from pathlib import Path
from gpe_pl.system.locks import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held_elsewhere(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Let another process lock a folder until its standard input closes."""
    command = [sys.executable, "-c", OTHER, str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        try:
            yield process
        finally:
            process.kill()


def test_a_folder_is_made_held_by_one_process_and_nothing_stays(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "sand"
    with locked(folder):
        with locked(folder):  # the same process again
            pass
        holder = json.loads((tmp_path / "runs" / ".sand.holder").read_text(encoding="utf-8"))
        assert holder["pid"] == os.getpid() and set(holder) == {"pid", "host", "command", "since"}
        (folder / "result").touch()
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["result", "runs", "sand"]
    with locked(tmp_path / "new" / "empty"):
        pass
    assert not (tmp_path / "new").exists()


def test_a_second_command_is_told_who_holds_the_folder(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path / "a") as process:
        with pytest.raises(FolderError, match=rf"a: another command writes to it \(process {process.pid} on .*, since 20.*\); wait"):
            locked(tmp_path / "a").__enter__()
        with locked(tmp_path / "b"):
            pass
        (tmp_path / "link").symlink_to(tmp_path / "a")
        with pytest.raises(FolderError, match="another command writes to it"):
            locked(tmp_path / "link").__enter__()


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path / "a") as process:
        process.kill()
        process.wait()
        assert (tmp_path / ".a.lock").exists()
        with locked(tmp_path / "a"):
            pass
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.slow
def test_who_waits_says_so_and_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with held_elsewhere(tmp_path / "a") as process:
        assert process.stdin is not None
        threading.Timer(0.5, process.stdin.close).start()
        with locked(tmp_path / "a", waits=True):
            assert process.wait() == 0
    assert f"waiting until another command has written it (process {process.pid} on " in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("key", locks.RANKS)
def test_processes_of_one_run_share_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    for other in locks.RANKS:
        monkeypatch.delenv(other, raising=False)
    with held_elsewhere(tmp_path / "a"):
        monkeypatch.setenv(key, "1")
        with locked(tmp_path / "a", num_processes=2):
            pass
        monkeypatch.setenv(key, "0")
        with pytest.raises(FolderError, match="another command writes to it"):
            locked(tmp_path / "a", num_processes=2).__enter__()


def test_hydra_lets_later_processes_of_a_training_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This holds for a training with several processes only. Copies of a command that ``srun -n 2`` starts twice, and sweeps, exclude each other."""
    monkeypatch.setenv("SLURM_PROCID", "1")
    folders = {"run": {"dir": str(tmp_path / "a")}, "sweep": {"dir": str(tmp_path / "a")}}
    settings = {"devices": 2, "num_nodes": 1}
    with held_elsewhere(tmp_path / "a"):
        callback = Report()
        callback.on_run_start(OmegaConf.create({"hydra": folders, "trainer": settings}))
        callback._release()
        for start, devices in ((Report().on_run_start, 1), (Report().on_run_start, "two"), (Report().on_multirun_start, 2)):
            with pytest.raises(SystemExit, match="2"):
                start(OmegaConf.create({"hydra": folders, "trainer": settings | {"devices": devices}}))


def test_disks_without_locks_have_lock_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lock file of a process that has ended on this machine is ignored. On another machine nobody can tell whether the process has ended."""

    def has_none(_: UnixFileLock) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(UnixFileLock, "_acquire", has_none)
    lock = tmp_path / ".a.lock"
    with locked(tmp_path / "a"):
        assert str(os.getpid()) in lock.read_text(encoding="utf-8")
    assert not lock.exists()
    lock.write_text(f"{2**22 + 1}\n{locks.platform.node()}\n", encoding="utf-8")  # no such process
    with locked(tmp_path / "a"):
        pass
    lock.write_text("1\nanother-host\n", encoding="utf-8")
    with pytest.raises(FolderError, match=r"; if that process is gone, delete .*\.a\.lock$"):
        locked(tmp_path / "a").__enter__()


@pytest.mark.parametrize("ends_with", [None, FileNotFoundError])
def test_a_folder_that_was_deleted_meanwhile_is_an_error(tmp_path: Path, ends_with: type[OSError] | None) -> None:
    with (
        pytest.raises(FolderError, match="a: was deleted or replaced while this command wrote to it; run the command again"),
        locked(tmp_path / "a"),
    ):
        shutil.rmtree(tmp_path / "a")
        if ends_with:
            raise ends_with
        (tmp_path / "a").mkdir()  # as whoever writes a file does
        (tmp_path / "a" / "file").touch()


@pytest.mark.parametrize("ends_with", [None, FileNotFoundError])
def test_a_deleted_folder_is_an_error_also_where_the_process_holds_it_already(tmp_path: Path, ends_with: type[OSError] | None) -> None:
    """In a training, Hydra's callback holds the folder, too. The inner block raises the error, and the end of the callback raises no other."""
    lost = "a: was deleted or replaced while this command wrote to it"
    with pytest.raises(FolderError, match=lost), locked(tmp_path / "a"), pytest.raises(FolderError, match=lost), locked(tmp_path / "a"):
        shutil.rmtree(tmp_path / "a")
        if ends_with:
            raise ends_with


def test_a_command_that_removes_its_empty_folder_keeps_its_own_error(tmp_path: Path) -> None:
    """For example, ``evaluate`` does so if the disk of the compile cache is full."""
    with pytest.raises(OSError, match="No space left on device"), locked(tmp_path / "a"):
        (tmp_path / "a").rmdir()
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("kind", ["run", "multirun"])
def test_a_command_whose_folder_was_deleted_does_not_succeed(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    folder = tmp_path / "a"
    config = OmegaConf.create({"hydra": {"run": {"dir": str(folder)}, "sweep": {"dir": str(folder)}}})
    callback = Report()
    getattr(callback, f"on_{kind}_start")(config)
    shutil.rmtree(folder)
    folder.mkdir()
    with pytest.raises(SystemExit, match="2"):
        getattr(callback, f"on_{kind}_end")(config)
    assert "a: was deleted or replaced while this command wrote to it" in capsys.readouterr().err
    callback._release()
    assert not capsys.readouterr().err and not list(tmp_path.glob(".a.*"))


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mine"), locked(tmp_path / "a"):
        raise ValueError("mine")
    with pytest.raises(PermissionError), locked(tmp_path / "a"):
        raise PermissionError


def test_a_folder_that_cannot_be_made_names_the_key(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file", encoding="utf-8")
    with pytest.raises(FolderError, match=r"runs/a: cannot be made \(Not a directory\); choose another folder with paths\.data=…"):
        locked(tmp_path / "runs" / "a", "paths.data").__enter__()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "overrides", "folder"),
    [
        ("fit", DATA, "runs/fit"),
        ("fit", ["name=sweep/a", *DATA], "runs/sweep/a"),
        ("evaluate", ["checkpoint=sand", "size=small", "name=e"], "runs/e"),
        ("benchmark", ["suite=speed"], "runs/benchmark/speed"),
        ("simulate", DATA, "data/sand/tiny"),
        ("simulate", [*DATA, "part=1", "num_parts=2"], "data/sand/tiny-part-1-of-2"),
    ],
)
@pytest.mark.parametrize("number", ["0", "1"])
def test_commands_refuse_a_folder_that_another_writes_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, overrides: list[str], folder: str, number: str
) -> None:
    """Fast: nothing is computed before. Slurm numbers the processes of a command that is started twice like those of one run."""
    monkeypatch.setenv("SLURM_PROCID", number)
    module = importlib.import_module(f"gpe_pl.{command}")
    tasks = {"evaluate": "evaluate_checkpoint"}
    paths = [f"paths.runs={tmp_path}/runs", *([] if command == "benchmark" else [f"paths.data={tmp_path}/data"])]
    cfg = compose(command, *overrides, *paths)
    with held_elsewhere(tmp_path / folder):
        with pytest.raises(FolderError, match=f"{folder}: another command writes to it"):
            getattr(module, tasks.get(command, command))(cfg)
        assert not list((tmp_path / folder).rglob("*"))


@pytest.mark.parametrize("number", ["0", "1"])
def test_imports_refuse_a_data_set_that_another_writes(
    tmp_path: Path, trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch, number: str
) -> None:
    monkeypatch.setenv("SLURM_PROCID", number)
    (tmp_path / "mine").mkdir()
    other = f"from pathlib import Path\nfrom gpe_pl.system.locks import locked\nwith locked(Path({str(tmp_path / 'mine' / 'imported')!r}), makes=False):"
    code = f"{other}\n    print('held', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)}
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        with pytest.raises(FolderError, match="imported: another command writes to it"):
            save_dataset(tmp_path, "mine", train=[trajectory, trajectory, trajectory])
        process.kill()


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_hydra_starts_nothing_in_a_folder_that_another_writes_to(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    config = OmegaConf.create({"hydra": {kind: {"dir": str(tmp_path / "a")}}})
    start = Report().on_run_start if kind == "run" else Report().on_multirun_start
    with held_elsewhere(tmp_path / "a"), pytest.raises(SystemExit, match="2"):
        start(config)
    assert capsys.readouterr().err.startswith(f"error: {tmp_path}/a: another command writes to it (process ")


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_hydra_starts_nothing_in_a_folder_that_cannot_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """The error is one line. Hydra would turn an exception of a callback into a warning and continue the command."""
    config = OmegaConf.create({"hydra": {kind: {"dir": str(tmp_path / "a")}}})
    start = Report().on_run_start if kind == "run" else Report().on_multirun_start
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "multirun.yaml").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SystemExit, match="2"):
        start(config)
    assert "multirun.yaml: a link that leads out of its folder" in capsys.readouterr().err

    def refused(_: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "a")

    monkeypatch.setattr("gpe_pl.config.entry_point.refuse_links", refused)
    with pytest.raises(SystemExit, match="2"):
        start(config)
    assert (
        capsys.readouterr().err
        == f"error: {tmp_path}/a: cannot be read or written (Permission denied); choose another folder with paths.runs=…\n"
    )


@pytest.mark.slow
def test_complete_data_are_read_where_nothing_can_be_written(tiny_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "_acquired", lambda *_: pytest.fail("reading needs no lock"))
    generate_tiny(tiny_data)
    simulate(compose("simulate", *DATA, f"paths.data={tiny_data}", "num_workers=1"))


def test_what_is_damaged_is_deleted_by_one_process_only(tiny_data: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_data, tmp_path / "data")
    shard = next((tmp_path / "data").rglob("shard-*.h5"))
    shard.write_bytes(shard.read_bytes()[:-1000])
    cfg = compose("simulate", *DATA, f"paths.data={tmp_path / 'data'}", "num_workers=1")
    with held_elsewhere(tmp_path / "data" / "sand" / "tiny"), pytest.raises(FolderError, match="another command writes to it"):
        simulate(cfg)
    assert shard.exists()


def test_long_names_have_locks_too(tmp_path: Path) -> None:
    with locked(tmp_path / ("x" * 255)):
        assert len(list(tmp_path.glob(".*.lock"))) == 1


def test_a_damaged_note_about_the_holder_is_no_obstacle(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path / "a"):
        for text in ("[" * 10**5, '{"pid": 1e999}', "3", "\x00"):
            (tmp_path / ".a.holder").write_text(text, encoding="utf-8")
            with pytest.raises(FolderError, match=r"another command writes to it \(which has just begun\)"):
                locked(tmp_path / "a").__enter__()


@pytest.mark.parametrize("number", sorted(locks.WITHOUT_LOCKS))
def test_a_disk_that_makes_the_file_and_then_says_that_it_has_no_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def fails(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", fails)
    with locked(tmp_path / "a"):
        assert (tmp_path / ".a.lock").exists()
        monkeypatch.setattr(locks, "_locked", set())
        with pytest.raises(FolderError, match=r"another command writes to it .*; if that process is gone, delete .*\.a\.lock"):
            locked(tmp_path / "a").__enter__()
    with alone(tmp_path / "times.lock"):
        assert (tmp_path / "times.lock").read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == []
