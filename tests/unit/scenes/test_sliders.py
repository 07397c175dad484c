"""Sliders predict the scene again with their values, and films show their viewer in notebooks."""

from __future__ import annotations

import builtins
import html
import re
from typing import Any

import pytest

from gpe_pl.scenes.film import Film
from gpe_pl.scenes.scene import Scene
from gpe_pl.scenes.sliders import NotebookError


def block(**properties: Any) -> Scene:
    return Scene(box=(1.0, 1.0)).block("sand", at=(0.1, 0.0), size=(0.08, 0.16), **properties)


def shown(value: str) -> str:
    """Return the page in the frame of a notebook."""
    match = re.fullmatch(r'<iframe srcdoc="([^"]*)"[^>]*></iframe>', value)
    assert match
    return html.unescape(match[1])


@pytest.mark.slow
def test_a_slider_predicts_again_with_its_value(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipywidgets", reason="ipywidgets is not installed")
    predicted: list[float] = []

    def predict(self: Scene, model: str, seconds: float) -> Film:
        predicted.append(self.bodies[0].parameters["friction_angle"])
        return film(self, model, seconds)

    film = Scene.predict
    monkeypatch.setattr(Scene, "predict", predict)
    slider, _, viewer = block(friction_angle=25).sliders("sand", 0.02).children
    first = shown(viewer.value)
    assert (slider.description, slider.value, slider.min, slider.max) == ("friction angle [deg]", 25.0, 20.0, 42.5)
    slider.value = 40.0
    assert predicted == [25.0, 40.0]
    assert "friction angle 25°" in first and "friction angle 40°" in shown(viewer.value)


def test_a_slider_also_changes_what_enters(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipywidgets", reason="ipywidgets is not installed")
    predicted: list[list[float]] = []

    def predict(self: Scene, model: str, seconds: float) -> Film:
        predicted.append([body.parameters["friction_angle"] for body in self.filled])
        return film

    film = block(friction_angle=25).predict("sand", 0.02)
    monkeypatch.setattr(Scene, "predict", predict)
    entering = block(friction_angle=25).inlet("sand", "x_low", at=(0.0, 0.5), size=(0.05, 0.2), speed=1.0, friction_angle=25)
    slider, _, _ = entering.sliders("sand", 0.02).children
    slider.value = 40.0
    assert predicted == [[25.0, 25.0], [40.0, 40.0]]


def test_without_widgets_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    load = builtins.__import__

    def without(name: str, *arguments: Any) -> Any:
        if name == "ipywidgets":
            raise ImportError(name)
        return load(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(NotebookError, match=r"pip install 'gpe_pl\[notebooks\]'"):
        block().sliders("sand", 0.02)
