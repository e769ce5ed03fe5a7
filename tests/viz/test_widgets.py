"""Widgets without a browser: a moved slider draws another picture, and soon."""

import re
import time

import numpy as np
import pytest
from ipywidgets import HTML, FloatSlider
from matplotlib.figure import Figure

from stad_lab.evaluation.trajectories import look_inside, record_drive
from stad_lab.viz.plots import moving_figure, plot_moment
from stad_lab.viz.widgets import explore_latents, show, show_film, view_drive


def find(widget, kind):
    """All widgets of a kind inside another."""
    return ([widget] if isinstance(widget, kind) else []) + [
        found for child in getattr(widget, "children", ()) for found in find(child, kind)
    ]


@pytest.fixture
def inside(agent):
    """A short drive and what V and M make of it."""
    drive = record_drive(agent, track=4, frames=9)
    return drive, look_inside(agent.autoencoder, agent.mdn_rnn, drive, agent.stride, agent.crop_bar)


def test_the_latent_explorer_has_a_slider_for_each_latent_and_redraws_in_less_than_100_ms(agent):
    explorer = explore_latents(agent.autoencoder, np.zeros(32, np.float32))
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
        slider.value for slider in find(explore_latents(agent.autoencoder, z), FloatSlider)
    ] == pytest.approx(z.tolist(), abs=0.006)


def test_the_viewer_shows_another_picture_for_another_moment(inside):
    viewer = view_drive(*inside)
    control, picture = viewer.children
    before = picture.value
    control.value = 8
    assert picture.value != before and "Frame 8 of 9" in picture.value


def test_what_cannot_be_shown_is_refused(inside):
    with pytest.raises(ValueError, match="moment=9: expected 0 to 8"):
        plot_moment(*inside, 9)
    with pytest.raises(ValueError, match="kind='mp4': expected 'gif' or 'webp'"):
        moving_figure([], 10, "mp4")
    with pytest.raises(ValueError, match="no figures"):
        moving_figure([], 10)


def test_figures_are_shown_one_below_the_other_each_with_its_own_words():
    figures = [Figure(figsize=(1, 1), label=words) for words in ("a slow lap", "a fast lap")]
    assert re.findall('alt="(.*?)"', show(*figures).data) == ["a slow lap", "a fast lap"]


def test_a_picture_without_alternative_text_is_refused():
    with pytest.raises(ValueError, match="alt=''"):
        show(Figure(figsize=(1, 1)))
    with pytest.raises(ValueError, match="alt=' '"):
        show_film(b"GIF", " ")
