"""Thin ipywidgets around plots: show a figure, show a moving picture, and redraw a figure when a slider moves."""

import base64
import functools
import html
import inspect
import io
from collections.abc import Callable

import ipywidgets
import numpy as np
import torch
from IPython.display import HTML, DisplayHandle
from matplotlib.figure import Figure
from PIL import Image
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer

from stad_lab.evaluation.trajectories import Drive, Inside
from stad_lab.models.vae import AutoEncoder, to_array, to_uint8
from stad_lab.viz.plots import difference_colors, plot_moment, to_png

Watch = Callable[[list[dict]], None]  # what a training calls with its entries so far


def show(*figures: Figure) -> HTML:
    """Figures as pictures, one below the other, each with its alternative text (the figure's label)."""
    return HTML(
        "".join(show_picture(to_png(figure), "png", figure.get_label()).data for figure in figures)
    )


def show_film(gif: bytes, alt: str) -> HTML:
    """A moving picture (from `plots.moving_picture`) with its alternative text."""
    return show_picture(gif, "gif", alt)


def show_picture(content: bytes, kind: str, alt: str) -> HTML:
    """A picture as HTML: the notebook formats for bare pictures lose the alternative text on the way to a page.

    Raises:
        ValueError: no alternative text.
    """
    if not alt.strip():
        raise ValueError(
            f"alt={alt!r}: expected words that stand for the picture; a figure has them from set_label"
        )
    data = base64.b64encode(content).decode()
    return HTML(
        f'<img src="data:image/{kind};base64,{data}" alt="{html.escape(alt)}" style="background: white">'
    )


def show_source(*things: Callable) -> HTML:
    """The source code of functions or classes, as it runs, in colour."""
    source = "\n\n".join(inspect.getsource(thing).rstrip() for thing in things)
    # Paper and ink of its own: in a dark theme, JupyterLab would put dark paper under the dark ink.
    paper = "background: #f8f8f8; color: black"
    page = HtmlFormatter(
        noclasses=True,
        cssstyles=f"{paper}; padding: 4px 10px; border-left: 3px solid #0072B2",
        prestyles=f"{paper}; font-family: monospace",
    )
    return HTML(highlight(source, PythonLexer(), page))


def explore(draw: Callable[..., Figure], **controls: ipywidgets.Widget) -> ipywidgets.VBox:
    """Controls above a figure that is drawn anew whenever one of them changes.

    Args:
        draw: takes the controls' values by name, returns a Figure.
        **controls: widgets with a `value`.
    """
    picture = ipywidgets.HTML()

    def redraw(_change=None) -> None:
        figure = draw(**{name: control.value for name, control in controls.items()})
        picture.value = show(figure).data

    for control in controls.values():
        control.observe(redraw, "value")
    redraw()
    return ipywidgets.VBox([*controls.values(), picture])


def watch_training(train: Callable[[Watch], object], draw: Callable[[list[dict]], Figure]) -> bool:
    """Train in a notebook cell under a figure that is drawn anew with every entry of the log.

    The stop button ends the cell in one line instead of an error: what was logged lies on the disk, and the same cell
    run again goes on from there. The figure is an ordinary output, which stays in the page when the kernel is gone.

    Args:
        train: is given the function to call with the entries so far, as `watch` of `evolution.evolve` and of
            `autoencoder.train_autoencoder`.
        draw: entries -> Figure.

    Returns:
        False if it was interrupted, True if the training is complete.
    """
    place = DisplayHandle()
    place.display(HTML(""))
    try:
        train(lambda entries: place.update(show(draw(entries))))
    except KeyboardInterrupt:
        print("stopped: nothing that was logged is lost, run this cell again to go on")
        return False
    return True


def slider(low: float, high: float, value: float, label: str) -> ipywidgets.Widget:
    """A slider that acts when it is let go: of whole numbers if all three are whole."""
    whole = all(isinstance(number, int) for number in (low, high, value))
    kind = ipywidgets.IntSlider if whole else ipywidgets.FloatSlider
    step = 1 if whole else 0.05
    return kind(
        value,
        min=low,
        max=high,
        step=step,
        description=label,
        continuous_update=False,
        style={"description_width": "initial"},
    )


def view_drive(drive: Drive, inside: Inside) -> ipywidgets.VBox:
    """The rollout viewer: everything about one moment of a drive, on a time slider."""
    return explore(
        functools.partial(plot_moment, drive, inside), moment=slider(0, len(drive) - 1, 0, "frame")
    )


def explore_latents(autoencoder: AutoEncoder, z: np.ndarray) -> ipywidgets.VBox:
    """One slider for each latent, and what V draws from them: the frame, and the difference if V redraws it.

    A picture is drawn while a slider moves, in well under 100 ms: no figure is made, only the picture.

    Args:
        z: where the sliders begin, float32 (latent_size,).
    """
    names = ["frame", "difference image"][: 1 + autoencoder.redraws_difference]
    pictures = [ipywidgets.HTML() for _ in names]
    reach = max(4, int(np.ceil(np.abs(z).max())))  # of a normal latent hardly any is beyond 4
    sliders = [
        ipywidgets.FloatSlider(
            round(float(value), 2),
            min=-reach,
            max=reach,
            step=0.05,
            description=f"z[{number}]",
            readout_format=".1f",
        )
        for number, value in enumerate(z)
    ]

    def redraw(_change=None) -> None:
        drawn = draw_latents(autoencoder, [control.value for control in sliders])
        for picture, name, content in zip(pictures, names, drawn, strict=True):
            picture.value = show_picture(
                content, "png", f"the {name} that V draws from these latents"
            ).data

    for control in sliders:
        control.layout.width = "230px"
        control.observe(redraw, "value")
    redraw()
    grid = ipywidgets.GridBox(sliders, layout={"grid_template_columns": "repeat(4, 240px)"})
    return ipywidgets.VBox([ipywidgets.HBox(pictures), grid])


@torch.no_grad()
def draw_latents(autoencoder: AutoEncoder, z: list[float]) -> list[bytes]:
    """What V draws from z, as PNGs of 224 x 224 pixels: the frame, and the difference if V redraws it."""
    frame, difference = autoencoder.decode(torch.tensor([z], dtype=torch.float32))
    pictures = [to_uint8(frame)[0]]
    if difference is not None:
        pictures.append(difference_colors(to_array(difference)[0]))
    return [picture_png(picture, 224) for picture in pictures]


def picture_png(picture: np.ndarray, size: int) -> bytes:
    """A square uint8 picture (H, W, 3), enlarged to `size` pixels, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).resize((size, size), Image.Resampling.NEAREST).save(buffer, "png")
    return buffer.getvalue()
