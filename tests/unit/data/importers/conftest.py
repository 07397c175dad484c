"""Four valid records, which tests damage."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import sources
from tests.refusals import WATER
from tests.sources import motion


@pytest.fixture
def records(tmp_path: Path) -> list[bytes]:
    """Write four training records of water and the description beside them."""
    sources.gns_metadata(tmp_path / "raw", motion())
    return [sources.record(sources.gns_record(motion(seed=k), WATER, k)) for k in range(4)]
