"""Full disks: a write ends in one typed error, nothing partial stays, and no library crashes."""

from __future__ import annotations

import errno
import io
import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.errors.printable import clean_messages
from gpe_pl.export.trajectories import write_vtk
from gpe_pl.files.atomic import FullDiskError, replace_bytes, replace_text, replacing, unnamed
from gpe_pl.files.late_failure import LateFailure
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory


def limited(monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """Simulate a disk with this number of free bytes; the last write fills it."""
    write, left = os.write, [room]

    def limited_write(file: int, data: memoryview) -> int:
        if not left[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = write(file, data[: left[0]])
        left[0] -= count
        return count

    monkeypatch.setattr("gpe_pl.files.late_failure.os.write", limited_write)


@pytest.mark.parametrize("room", [0, 100, 5000, 12_000])
def test_a_shard_for_which_there_is_no_room(tmp_path: Path, trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path, [trajectory])
    before = path.read_bytes()
    with monkeypatch.context() as patched:
        limited(patched, room)
        with pytest.raises(FullDiskError, match=r"shard-00000.h5: cannot be written, there is no room \(No space left on device\)"):
            write_shard(path, [trajectory] * 8)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == before
    np.testing.assert_array_equal(read_trajectory(path, "00000", verify=True).pos, trajectory.pos)


def test_no_more_is_asked_for_when_the_disk_is_full(tmp_path: Path, trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, 0)
    asked = []
    with pytest.raises(FullDiskError):
        write_shard(tmp_path / "a.h5", (asked.append(k) or trajectory for k in range(9)))  # type: ignore[func-returns-value]
    assert len(asked) <= 2


@pytest.mark.parametrize("room", [0, 3, 10**6])
def test_what_fails_to_be_written_can_be_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    limited(monkeypatch, room)
    content = bytearray()
    rng = np.random.default_rng(room)
    with LateFailure(tmp_path / "file") as file:
        for _ in range(50):
            start, data = int(rng.integers(0, len(content) + 9)), rng.bytes(int(rng.integers(1, 30)))
            content.extend(bytes(max(0, start + len(data) - len(content))))
            content[start : start + len(data)] = data
            file.seek(start)
            assert file.write(data) == len(data)
            first = int(rng.integers(0, len(content)))
            file.seek(first)
            assert file.read(40) == content[first : first + 40]
        assert file.seek(0, os.SEEK_END) == len(content)
        if room < 10**6:
            with pytest.raises(OSError, match="No space left"):
                file.check()
        else:
            file.check()
    if room == 10**6:
        assert (tmp_path / "file").read_bytes() == content


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_no_room_is_named(tmp_path: Path, code: int) -> None:
    with (
        pytest.raises(FullDiskError, match=r"a.txt: cannot be written, there is no room .*; make some, and run the command again"),
        replacing(tmp_path / "a.txt") as part,
    ):
        part.write_text("half")
        raise OSError(code, os.strerror(code))
    assert list(tmp_path.iterdir()) == []


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), replacing(tmp_path / "a.txt"):
        raise PermissionError(errno.EACCES, "no")


def test_texts_and_bytes(tmp_path: Path) -> None:
    replace_text(tmp_path / "a", "ü")
    replace_bytes(tmp_path / "b", b"x")
    assert (tmp_path / "a").read_bytes() == "ü".encode() and (tmp_path / "b").read_bytes() == b"x"


@pytest.mark.parametrize("full", ["frame_00002.vtu", "boundary.vtu", "a.pvd"])
def test_a_series_for_which_there_is_no_room(tmp_path: Path, trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch, full: str) -> None:
    def write(path: Path, text: str) -> None:
        if path.name == full:
            raise FullDiskError(path, "No space left on device")
        replace_text(path, text)

    monkeypatch.setattr("gpe_pl.export.trajectories.replace_text", write)
    with pytest.raises(FullDiskError, match=f"{full}: cannot be written"):
        write_vtk(tmp_path / "a.pvd", trajectory)
    assert list(tmp_path.iterdir()) == []


def test_an_error_that_names_no_file_names_full_disks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full, other = tmp_path / "full" / "not there yet", tmp_path / "other"
    monkeypatch.setattr("gpe_pl.files.atomic.free_bytes", lambda folder: 0 if folder == full else 2**30)
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(unnamed(error, [other, full, full])).startswith(f"{full}: cannot be written, there is no room")
    assert str(unnamed(error, [other, tmp_path])).startswith(f"{other} or {tmp_path}: cannot be written")
    for known in (OSError(errno.ENOSPC, "no", "a.txt"), OSError(errno.EIO, "no"), OSError("no")):
        assert unnamed(known, [full]) is known


def test_a_log_file_that_cannot_be_written_prints_no_traceback(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    for owner, name in ((logging, "raiseExceptions"), (sys, "excepthook"), (warnings, "formatwarning")):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # put back afterwards
    factory = logging.getLogRecordFactory()
    try:
        clean_messages()
        logging.StreamHandler(Full()).handle(logging.makeLogRecord({"msg": "text"}))
    finally:
        logging.setLogRecordFactory(factory)
    assert capsys.readouterr().err == ""


LIMITED = """
import resource, signal, sys
from pathlib import Path
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
limit = lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
folder = Path(sys.argv[1])
from gpe_pl.errors import GpeError

def refused(action):
    limit(2**13)
    try:
        action()
    except GpeError as error:
        print(error)
    else:
        print("no error")
    limit(resource.RLIM_INFINITY)

from tests.conftest import make_trajectory
from gpe_pl.trajectory.store import write_shard
refused(lambda: write_shard(folder / "a.h5", [make_trajectory(k, 60, 50) for k in range(3)]))

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gns import GNS
from gpe_pl.export.program import export_model
build = GraphBuilder(GraphConfig(history=2), make_trajectory().metadata)
simulator = LearnedSimulator(GNS(build.spec, num_message_passing_steps=1, hidden_channels=16), build).eval()
refused(lambda: simulator.save(folder / "model.ckpt"))
refused(lambda: export_model(simulator, folder / "model.pt2"))
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits the size of files")
def test_libraries_on_a_full_disk(tmp_path: Path) -> None:
    """HDF5 and PyTorch end the process where their own writers fail."""
    root = Path(__file__).parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    ended = subprocess.run([sys.executable, "-c", LIMITED, str(tmp_path)], capture_output=True, text=True, env=environment, timeout=300)
    lines = ended.stdout.splitlines()
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert [line.partition(":")[0] for line in lines] == [str(tmp_path / name) for name in ("a.h5", "model.ckpt", "model.pt2")]
    assert all("there is no room (File too large)" in line for line in lines)
    assert list(tmp_path.iterdir()) == []
