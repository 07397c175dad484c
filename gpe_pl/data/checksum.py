"""What data are known by: a checksum of what they hold, wherever they lie, whatever they are called, and however they are spread over shards."""

from __future__ import annotations

import hashlib
from pathlib import Path

from gpe_pl.store import open_group, open_shard, read_text, shards

LENGTH = 16
"""Hexadecimal digits that are kept: enough to tell apart all data that anyone will have."""


def split_checksum(root: Path | str, split: str) -> str:
    """The beginning of the SHA-256 over the digests that the trajectories of a split were stored with, in order.

    Reads no arrays: milliseconds per shard. That arrays agree with their digest is for ``read_trajectory(verify=True)`` to say.
    """
    sha = hashlib.sha256()
    for path in shards(root, split):
        with open_shard(path) as file:
            for name in sorted(file):
                sha.update(read_text(open_group(file, name), "sha256").encode() + b";")
    return sha.hexdigest()[:LENGTH]
