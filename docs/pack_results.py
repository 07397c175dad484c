"""Pack a folder of results for a release: ``python docs/pack_results.py FOLDER FILE.tar.xz``, and ``--check FILE.tar.xz`` later.

The archive holds all regular files below the folder and ``SHA256SUMS``, a checksum of each, as ``sha256sum --check`` reads them. The same files give the same
bytes. Checkpoints are left out unless ``--checkpoints`` is given.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import lzma
import sys
import tarfile
from pathlib import Path

from gpe_pl.files.atomic import replacing

SUMS = "SHA256SUMS"


def pack(folder: Path, target: Path, checkpoints: bool = False) -> int:
    """Write the archive; returns how many files it holds besides the checksums."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
    files = [path for path in files if checkpoints or path.suffix != ".ckpt"]
    if not files:
        raise FileNotFoundError(f"{folder}: has no file to pack")
    names = {path.relative_to(folder).as_posix(): path for path in files}
    sums = "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {name}\n" for name, path in names.items())
    with replacing(target) as part, tarfile.open(part, "w:xz") as archive:
        for name, path in names.items():
            _add(archive, f"{folder.name}/{name}", path.read_bytes())
        _add(archive, f"{folder.name}/{SUMS}", sums.encode())
    return len(files)


def _add(archive: tarfile.TarFile, name: str, content: bytes) -> None:
    entry = tarfile.TarInfo(name)  # without times and owners
    entry.size = len(content)
    archive.addfile(entry, io.BytesIO(content))


def damaged(source: Path) -> list[str]:
    """Files of an archive that are missing, too many or not as they were packed."""
    with tarfile.open(source, "r:xz") as archive:
        contents = {entry.name.partition("/")[2]: file.read() for entry in archive if (file := archive.extractfile(entry)) is not None}
    if SUMS not in contents:
        raise tarfile.ReadError(f"{source}: has no {SUMS}")
    lines = contents.pop(SUMS).decode().splitlines()
    expected = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    found = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    return sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))


def main(arguments: list[str]) -> int:
    """Pack or check; the exit status."""
    parser = argparse.ArgumentParser(description="Pack a folder of results with checksums, or check such an archive.")
    parser.add_argument("folder", type=Path, nargs="?", help="such as runs/table1")
    parser.add_argument("file", type=Path, help="the archive, FILE.tar.xz")
    parser.add_argument("--checkpoints", action="store_true", help="pack checkpoints, too")
    parser.add_argument("--check", action="store_true", help="compare the files of an archive with their checksums")
    chosen = parser.parse_args(arguments)
    try:
        if chosen.check:
            wrong = damaged(chosen.file)
            print(f"{chosen.file}: {', '.join(wrong)} differ from {SUMS}" if wrong else f"{chosen.file}: all files are as they were packed")
            return int(bool(wrong))
        if chosen.folder is None:
            parser.error("the folder is missing")
        print(f"{chosen.file}: {pack(chosen.folder, chosen.file, chosen.checkpoints)} files")
    except (OSError, EOFError, lzma.LZMAError, UnicodeDecodeError, tarfile.TarError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
