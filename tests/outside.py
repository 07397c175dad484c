"""A small package with a model, as others write and install it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NET = '''
"""Every node accelerates by a linear map of its features."""

from typing import Annotated

import torch
from pydantic import Field

from gpe_pl.models.base import Model, Prediction


class Net(Model):
    def __init__(self, spec, hidden_channels: Annotated[int, Field(ge=1)] = 8):
        super().__init__(spec, hidden_channels=hidden_channels)
        self.layers = torch.nn.ModuleDict({
            m: torch.nn.Sequential(
                torch.nn.Linear(spec.node_channels[m], hidden_channels), torch.nn.Tanh(), torch.nn.Linear(hidden_channels, spec.dim)
            )
            for m in spec.materials
        })

    @property
    def num_hops(self):
        return 0

    def forward(self, data):
        x = {m: data[m].x for m in self.spec.materials if data[m].x.shape[0]}
        return Prediction(self.compute(x) if x else {})

    def compute(self, x):
        return {m: self.layers[m](value) for m, value in x.items()}


class NotRegistered(Net):
    pass


class NotAModel:
    pass
'''

MARKED = """
from pathlib import Path

Path(__file__).with_name("was_imported").touch()
"""


def write(folder: Path) -> Path:
    """Write the package ``outside_gpe``, which registers ``net.Net``, and ``hostile_gpe``, which registers nothing; returns ``folder``."""
    info = folder / "outside_gpe-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside_gpe\nVersion: 1.0\n")
    names = {"net": "net:Net", "other": "net:NotAModel", "missing": "net:Missing", "broken": "broken:Net", "alias": ":Net"}
    lines = [f"{name} = outside_gpe.{value}".replace(".:", ":") for name, value in names.items()]
    (info / "entry_points.txt").write_text("\n".join(["[gpe_pl.models]", *lines, ""]))
    for name, text in {
        "outside_gpe/__init__": "from outside_gpe.net import Net",
        "outside_gpe/net": NET,
        "outside_gpe/broken": "1 / 0",
        "hostile_gpe/__init__": MARKED,
        "hostile_gpe/net": MARKED + NET,
    }.items():
        path = folder / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return folder


@contextmanager
def installed(folder: Path) -> Iterator[None]:
    """Inside, the packages in a folder can be imported; afterwards they are forgotten."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in [n for n in sys.modules if n.partition(".")[0] in ("outside_gpe", "hostile_gpe")]:
            del sys.modules[name]
