"""Names from files become models of this package, or registered ones, and nothing else is imported."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gpe_pl.models.gpe import GPE
from gpe_pl.models.lookup import UnknownModelError, model_class
from tests import outside


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[Path]:
    with outside.installed(outside.write(tmp_path)):
        yield tmp_path


@pytest.mark.parametrize("name", ["torch.nn.Linear", "gpe_pl.nn.blocks.MLP", "GPE", "", "os.system", "\0", 7, None])
def test_only_models_of_the_package_are_looked_up(name: object) -> None:
    assert model_class("gpe_pl.models.gpe.GPE") is GPE
    with pytest.raises(UnknownModelError, match="is not one of gpe_pl.models"):
        model_class(name)


@pytest.mark.parametrize("name", ["gpe_pl.models.base.Model", "gpe_pl.models.gpe.Model", "gpe_pl.models.gpe.PairForce"])
def test_a_part_of_a_model_is_none(name: str) -> None:
    with pytest.raises(UnknownModelError, match="is not a model"):
        model_class(name)


def test_a_registered_class_is_a_model(packages: Path) -> None:
    cls = model_class("outside_gpe.net.Net")
    assert (cls.__module__, cls.__name__) == ("outside_gpe.net", "Net")


@pytest.mark.parametrize("name", ["hostile_gpe.net.Net", "hostile_gpe.Net", "hostile_gpe.net.os.system", "outside_gpe.net.NotRegistered"])
def test_what_nobody_registers_is_not_imported(packages: Path, name: str) -> None:
    with pytest.raises(
        UnknownModelError, match=r"not one of gpe_pl.models, nor .* \(.*outside_gpe.net.Net.*\); install the package"
    ) as caught:
        model_class(name)
    assert "\n" not in str(caught.value)
    assert not list(packages.glob("hostile_gpe/was_imported"))
    assert not {"hostile_gpe", "outside_gpe"} & sys.modules.keys()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("outside_gpe.net.NotAModel", "is not a model"),
        ("outside_gpe.net.Missing", "does not exist in outside_gpe"),
        ("outside_gpe.broken.Net", "cannot be imported: ZeroDivisionError"),
        ("outside_gpe.Net", "name it outside_gpe.net.Net"),
    ],
)
def test_a_wrong_registration_is_named(packages: Path, name: str, message: str) -> None:
    with pytest.raises(UnknownModelError, match=message):
        model_class(name)
