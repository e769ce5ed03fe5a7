"""Thin ipywidgets around figures: show them, and draw them again when a slider moves."""

import io
from collections.abc import Callable

import ipywidgets
import numpy as np
import torch
from IPython.display import HTML, DisplayHandle
from matplotlib.figure import Figure

from stad_lab.io.workers import interrupted_at_the_end
from stad_lab.models.vae import VAE, to_array, to_uint8
from stad_lab.training.trainer import Watch
from stad_lab.viz import page
from stad_lab.viz.plots import difference_colors, to_png
from stad_lab.viz.video import enlarged


def show(*figures: Figure) -> HTML:
    """Figures below each other, each with its label as alternative text; ValueError without one."""
    pictures = [show_picture(to_png(one), "png", str(one.get_label())) for one in figures]
    return HTML("".join(one.data for one in pictures))


def show_animation(gif: bytes, alt: str) -> HTML:
    """An animated GIF with its alternative text."""
    return show_picture(gif, "gif", alt)


def show_picture(content: bytes, kind: str, alt: str) -> HTML:
    """A picture as HTML, which keeps its alternative text; ValueError if there is none."""
    if not alt.strip():
        raise ValueError(f"alt={alt!r}: expected a text; a figure has one after set_label")
    return HTML(page.picture(content, kind, alt, "background: white"))


def explore(draw: Callable[..., Figure], **controls: ipywidgets.Widget) -> ipywidgets.VBox:
    """Controls above the figure that `draw` returns for their values, whenever one changes."""
    picture = ipywidgets.HTML()

    def update(_change=None) -> None:
        figure = draw(**{name: control.value for name, control in controls.items()})
        picture.value = show(figure).data

    for control in controls.values():
        control.observe(update, "value")
    update()
    return ipywidgets.VBox([*controls.values(), picture])


def watch_training(train: Callable[[Watch], object], draw: Callable[[list[dict]], Figure]) -> bool:
    """Train in a notebook cell below a figure that follows the log.

    The stop button ends the cell in one line instead of an error. If `train` keeps its log, as
    `evolve` does on the disk, the same cell run again continues.

    Args:
        train: is given the `watch` of `evolution.evolve` or `train_vae`.
        draw: entries of the log so far -> Figure.

    Returns:
        False if it was interrupted, True if the training is complete.
    """
    place = DisplayHandle()
    place.display(HTML(""))  # an ordinary output stays in the page when the kernel is gone

    def update(entries: list[dict]) -> None:
        # Matplotlib's compiled parts can make another error of an interrupt, or lose it.
        with interrupted_at_the_end():
            place.update(show(draw(entries)))

    try:
        train(update)
    except KeyboardInterrupt:
        print("stopped: run this cell again")
        return False
    return True


def slider(low: float, high: float, value: float, label: str) -> ipywidgets.Widget:
    """A slider that acts when it is released: of whole numbers if all three are whole."""
    whole = all(isinstance(number, int) for number in (low, high, value))
    kind, step = (ipywidgets.IntSlider, 1) if whole else (ipywidgets.FloatSlider, 0.05)
    style = {"description_width": "initial"}
    range_of = {"min": low, "max": high, "step": step, "continuous_update": False}
    return kind(value, description=label, style=style, **range_of)


def explore_latents(vae: VAE, z: np.ndarray) -> ipywidgets.VBox:
    """A slider for each latent, which begins at z (latent_size,), and what V decodes from them."""
    pictures = [ipywidgets.HTML() for _ in range(1 + vae.reconstructs_difference)]
    reach = max(4, int(np.ceil(np.abs(z).max())))  # hardly any normal latent is beyond 4
    range_of = {"min": -reach, "max": reach, "step": 0.05, "readout_format": ".1f"}
    sliders = [
        ipywidgets.FloatSlider(round(float(value), 2), description=f"z[{number}]", **range_of)
        for number, value in enumerate(z)
    ]

    def update(_change=None) -> None:
        decoded = decode_latents(vae, [control.value for control in sliders])
        names = ("frame", "difference image")
        for picture, name, content in zip(pictures, names, decoded, strict=False):
            alt = f"the {name} that V decodes from these latents"
            picture.value = show_picture(picture_png(content, 224), "png", alt).data

    for control in sliders:
        control.layout.width = "230px"
        control.observe(update, "value")
    update()
    grid = ipywidgets.GridBox(sliders, layout={"grid_template_columns": "repeat(4, 240px)"})
    return ipywidgets.VBox([ipywidgets.HBox(pictures), grid])


@torch.no_grad()
def decode_latents(vae: VAE, z: list[float]) -> list[np.ndarray]:
    """The frame, and the difference image if V has one, uint8 (64, 64, 3) each."""
    frame, difference = vae.decode(torch.tensor([z], dtype=torch.float32))
    colors = [] if difference is None else [difference_colors(to_array(difference)[0])]
    return [to_uint8(frame)[0], *colors]


def picture_png(picture: np.ndarray, size: int) -> bytes:
    """A square uint8 picture (H, W, 3), enlarged to `size` pixels, as PNG."""
    buffer = io.BytesIO()
    enlarged(picture, size).save(buffer, "png")
    return buffer.getvalue()
