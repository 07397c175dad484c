"""Settings of trainings on several spacings and frame intervals."""

from __future__ import annotations

import pytest

from gpe_pl.config.datasets import dataset_spec, evaluated_config, stride_of, training_parts
from gpe_pl.config.entry_point import ConfigError
from tests.runs import compose

SCALES = ("graph.scales=dimensionless", "data.scales={spacing_factors: [0.5, 2], strides: [1, 4]}")


def test_a_training_has_all_pairs_of_spacing_and_stride() -> None:
    cfg = compose("fit", *SCALES, "+evaluation.data.spacing_factor=1.5", "data.fine=2")
    parts = [*training_parts(cfg), evaluated_config(cfg)]
    specs = [dataset_spec(part) for part in parts]
    base = dataset_spec(compose("fit", "data.fine=2"))
    assert [stride_of(part) for part in parts] == [1, 4, 1, 4, 1]
    assert [spec.name.removeprefix(base.name) for spec in specs] == ["_spacing_0.5"] * 2 + ["_spacing_2"] * 2 + ["_spacing_1.5"]
    assert [spec.scene.spacing / base.scene.spacing for spec in specs] == pytest.approx([0.5, 0.5, 2, 2, 1.5])


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 3])
def test_a_part_is_the_data_set_of_the_same_factor(factor: float) -> None:
    cfg = compose("fit", "graph.scales=dimensional", f"data.scales={{spacing_factors: [{factor}], strides: [1]}}")
    alone = compose("fit", f"data.spacing_factor={factor}")
    assert dataset_spec(training_parts(cfg)[0]).as_dict() == dataset_spec(alone).as_dict()


def test_without_scales_a_training_has_its_own_data() -> None:
    cfg = compose("fit")
    assert training_parts(cfg) == [cfg] and dataset_spec(cfg).name == "sand"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (SCALES[1:], "data.scales: the model has to take several scales; set graph.scales=dimensionless"),
        ((SCALES[0], "data.scales={spacing_factors: [], strides: [1]}"), r"data.scales.spacing_factors"),
        ((SCALES[0], "data.scales={spacing_factors: [1], strides: [0]}"), r"data.scales.strides"),
        ((*SCALES, "training.targets=solver"), "data.scales: works with training.targets=trajectory"),
        (("data=fem", "+evaluation.data.spacing_factor=2"), "the spacing of scenes of SolidScene has no factor"),
    ],
)
def test_what_cannot_be_is_refused(overrides: tuple[str, ...], message: str) -> None:
    cfg = compose("fit", *overrides)
    with pytest.raises(ConfigError, match=message):
        training_parts(cfg)
        evaluated_config(cfg)


@pytest.mark.slow
@pytest.mark.parametrize("scaling", [(), ("scaling=specialist",), ("scaling=general",)])
@pytest.mark.parametrize("data", ["fem", "fluid", "channel"])
def test_the_experiment_is_refused_at_once_for_data_of_one_spacing(data: str, scaling: tuple[str, ...]) -> None:
    with pytest.raises(
        ConfigError, match="the spacing of scenes of .*Scene has no factor; choose data of bodies of particles, such as data=sand"
    ):
        evaluated_config(compose("fit", "experiment=scales", f"data={data}", *scaling))


@pytest.mark.parametrize("key", ["spacing_factor=2", "scales={spacing_factors: [1], strides: [1]}"])
def test_a_spacing_without_effect_is_refused_before_data_are_made(key: str) -> None:
    with pytest.raises(ConfigError, match="the spacing of scenes of SolidScene has no factor"):
        dataset_spec(compose("fit", "data=fem", f"+data.{key}"))
