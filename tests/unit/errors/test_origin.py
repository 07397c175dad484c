"""An error knows which modules were running when it was raised."""

from __future__ import annotations

from typing import Any

import pytest

from gpe_pl.errors.origin import came_through


@pytest.mark.parametrize(
    ("module", "expected"), [("torch.distributed.pairs", True), ("torch.distributed", True), ("torch.distributed_other", False)]
)
def test_modules_of_a_package_count_as_the_package(module: str, expected: bool) -> None:
    code: dict[str, Any] = {"__name__": module}
    exec("def fail():\n    raise RuntimeError", code)
    with pytest.raises(RuntimeError) as caught:
        code["fail"]()
    assert came_through(caught.value, "torch.distributed") == expected
    assert came_through(caught.value, __name__)
