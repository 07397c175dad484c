"""Sliders of material parameters in a notebook, with the viewer of the motion that a model predicts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gpe_pl.errors import GpeError
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.training_ranges import stored_ranges
from gpe_pl.scenes.rollouts import middle_values
from gpe_pl.viz.captions import parameter_name

if TYPE_CHECKING:
    from gpe_pl.scenes.bodies import Body
    from gpe_pl.scenes.scene import Scene


class NotebookError(GpeError, ImportError):
    """Raised if widgets of notebooks are not installed."""


def sliders(scene: Scene, model: str, seconds: float | int) -> Any:
    """Return a widget with a slider for each trained parameter of the scene's materials, over its trained range, and the viewer of the prediction.

    A parameter of all bodies and inlets of a material has one slider. It begins at the value of the first of them, or in the middle of the trained range.

    Args:
        scene: the scene.
        model: shipped model, folder of a run, or checkpoint.
        seconds: length of the prediction [s].

    Raises:
        NotebookError: ipywidgets is not installed.
        SceneFault: the scene is impossible, or does not fit the model.
    """
    try:
        import ipywidgets as widgets
    except ImportError:
        raise NotebookError("sliders need ipywidgets: `pip install 'gpe_pl[notebooks]'`") from None

    simulator = LearnedSimulator.from_checkpoint(model)
    middle, own = middle_values(simulator), simulator.builder.metadata
    chosen: dict[tuple[str, str], Any] = {}
    for material, trained in simulator.trained_ranges():
        given = next((body.parameters for body in scene.filled if body.material == material), None)
        for spec, _, (low, high) in stored_ranges(own, material, trained):
            if given is None or not low < high:
                continue
            value = min(max(float(given.get(spec.name, middle[material][spec.name])), float(low)), float(high))
            label = {
                "description": f"{parameter_name(spec)} [{spec.unit}]",
                "continuous_update": False,
                "style": {"description_width": "initial"},
            }
            if spec.scale == "log":
                ends = {"min": float(low.log10()), "max": float(high.log10())}
                chosen[material, spec.name] = widgets.FloatLogSlider(value, **ends, step=0.01, **label)
            else:
                chosen[material, spec.name] = widgets.FloatSlider(
                    value, min=float(low), max=float(high), step=float(high - low) / 100, **label
                )
    viewer, messages = widgets.HTML(), widgets.Output()

    def predict(_: Any = None) -> None:
        values = {key: slider.value for key, slider in chosen.items()}

        def changed(body: Body) -> Body:
            own = {name: value for (material, name), value in values.items() if material == body.material}
            return replace(body, parameters={**body.parameters, **own})

        bodies = tuple(map(changed, scene.bodies))
        zones = tuple(zone if zone.body is None else replace(zone, body=changed(zone.body)) for zone in scene.zones)
        messages.clear_output(wait=True)
        with messages:  # the progress bar
            viewer.value = replace(scene, bodies=bodies, zones=zones).predict(model, seconds)._repr_html_()

    for slider in chosen.values():
        slider.observe(predict, "value")
    predict()
    return widgets.VBox([*chosen.values(), messages, viewer])
