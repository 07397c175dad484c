"""What data are known by: a checksum of what they hold, wherever they lie and however they are spread over shards."""

from __future__ import annotations

import hashlib
from pathlib import Path

from gpe_pl.trajectory.store import ATTRIBUTES, open_group, open_shard, read_text, shards

LENGTH = 16
"""Hexadecimal digits that are kept: enough to tell apart all data that anyone will have."""


def split_checksum(root: Path | str, split: str) -> str:
    """The beginning of the SHA-256 over the digests and attributes that the trajectories of a split were stored with, in order.

    Reads no arrays: milliseconds per shard. That they agree with their digest is for ``read_trajectory(verify=True)`` to say.
    """
    sha = hashlib.sha256()
    for path in shards(root, split):
        with open_shard(path) as file:
            for name in sorted(file):
                group = open_group(file, name)
                for key in ("sha256", *ATTRIBUTES):
                    sha.update(read_text(group, key).encode() + b";")
    return sha.hexdigest()[:LENGTH]
