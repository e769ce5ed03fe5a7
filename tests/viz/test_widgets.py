"""Widgets without a browser: a moved slider shows another picture, without delay."""

import io
import re
import signal
import time

import numpy as np
import pytest
from ipywidgets import HTML, FloatSlider
from matplotlib.figure import Figure
from PIL import Image

from stad_lab.viz.video import animate_pictures, film_agent
from stad_lab.viz.widgets import (
    explore,
    explore_latents,
    show,
    show_animation,
    slider,
    watch_training,
)


def find(widget, kind):
    """All widgets of a kind inside another."""
    return ([widget] if isinstance(widget, kind) else []) + [
        found for child in getattr(widget, "children", ()) for found in find(child, kind)
    ]


def test_the_latent_explorer_has_a_slider_for_each_latent_and_decodes_in_less_than_100_ms(agent):
    explorer = explore_latents(agent.vae, np.zeros(32, np.float32))
    sliders, pictures = find(explorer, FloatSlider), find(explorer, HTML)
    assert len(sliders) == 32 and len(pictures) == 2
    seconds = []
    for number in range(9):
        before = pictures[0].value
        begin = time.process_time()  # of this process alone, whatever else runs
        sliders[number].value = 3.0
        seconds.append(time.process_time() - begin)
        assert pictures[0].value != before
    assert np.median(seconds) < 0.1


def test_the_latent_explorer_begins_at_its_z_even_far_out(agent):
    z = np.linspace(-6.3, 5.2, 32, dtype=np.float32)
    assert [
        slider.value for slider in find(explore_latents(agent.vae, z), FloatSlider)
    ] == pytest.approx(z.tolist(), abs=0.006)


def test_films_of_different_lengths_are_not_shown_side_by_side():
    with pytest.raises(ValueError, match="expected one length"):
        animate_pictures({"a": np.zeros((2, 8, 8, 3), np.uint8), "b": np.zeros((1, 8, 8, 3))})


def test_every_figure_is_shown_with_its_own_alternative_text():
    figures = [Figure(figsize=(1, 1), label=words) for words in ("a slow lap", "a fast lap")]
    assert re.findall('alt="(.*?)"', show(*figures).data) == ["a slow lap", "a fast lap"]


def test_a_picture_without_alternative_text_is_refused():
    with pytest.raises(ValueError, match="alt=''"):
        show(Figure(figsize=(1, 1)))
    with pytest.raises(ValueError, match="alt=' '"):
        show_animation(b"GIF", " ")


def test_explore_draws_again_with_the_values_of_all_controls():
    def draw(a, b):
        return Figure(figsize=(1, 1), label=f"a is {a}, b is {b}")

    box = explore(draw, a=slider(0, 9, 4, "a"), b=slider(0.0, 1.0, 0.5, "b"))
    assert "a is 4, b is 0.5" in box.children[-1].value
    box.children[0].value = 7
    assert "a is 7, b is 0.5" in box.children[-1].value


def pages(content):
    """The number of pictures of an animation, and their size."""
    image = Image.open(io.BytesIO(content))
    return image.n_frames, image.size


def test_a_film_shows_one_frame_of_three(agent):
    count, (width, height) = pages(film_agent(agent, track=4, first=5, frames=10))
    assert count == 4 and width == 4 * 192 + 3 * 6 and height == 192 + 20
    with pytest.raises(ValueError, match="frames=0: expected"):
        film_agent(agent, 4, 1, 0)
    with pytest.raises(ValueError, match="first=0: expected at least 1"):
        film_agent(agent, 4, 0, 10)


def test_an_interrupt_within_a_figure_ends_the_training_once_the_figure_is_drawn(capsys):
    drawn = []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's "&" lets it be ignored

    def draw(entries):
        signal.raise_signal(signal.SIGINT)
        drawn.append(len(entries))
        figure = Figure()
        figure.set_label("a figure")
        return figure

    assert watch_training(lambda watch: [watch([{}] * count) for count in (1, 2)], draw) is False
    assert drawn == [1] and "stopped: " in capsys.readouterr().out
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
