"""Checksums of the content of a split. They depend neither on its folder nor on how trajectories are divided among shards."""

from __future__ import annotations

import hashlib
from pathlib import Path

from gpe_pl.trajectory.store import ATTRIBUTES, open_group, open_shard, read_text, shards

LENGTH = 16
"""Number of hexadecimal digits of a checksum. Two different data sets agree in all of them with a probability of 5e-20."""


def split_checksum(root: Path | str, split: str) -> str:
    """Return the first ``LENGTH`` digits of the SHA-256 digest of a split.

    It is computed from the stored digests and attributes of the trajectories, in order. Arrays are not read, which saves time; ``read_trajectory(verify=True)``
    checks arrays against their digest.

    Raises:
        StoreError: the split has no shards, or one is damaged.
    """
    sha = hashlib.sha256()
    for path in shards(root, split):
        with open_shard(path) as file:
            for name in sorted(file):
                group = open_group(file, name)
                for key in ("sha256", *ATTRIBUTES):
                    sha.update(read_text(group, key).encode() + b";")
    return sha.hexdigest()[:LENGTH]
