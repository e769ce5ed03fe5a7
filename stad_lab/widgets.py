"""Thin ipywidgets around plots: show a figure, show a moving picture, and redraw a figure when a slider moves."""

import base64
import html
import inspect
from collections.abc import Callable

import ipywidgets
from IPython.display import HTML
from matplotlib.figure import Figure
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer

from stad_lab.plots import to_png


def show(figure: Figure) -> HTML:
    """A figure as a picture with its alternative text (the figure's label)."""
    return show_picture(to_png(figure), "png", figure.get_label())


def show_film(gif: bytes, alt: str) -> HTML:
    """A moving picture (from `plots.moving_picture`) with its alternative text."""
    return show_picture(gif, "gif", alt)


def show_picture(content: bytes, kind: str, alt: str) -> HTML:
    """A picture as HTML: the notebook formats for bare pictures lose the alternative text on the way to a page."""
    data = base64.b64encode(content).decode()
    return HTML(f'<img src="data:image/{kind};base64,{data}" alt="{html.escape(alt)}" style="background: white">')


def show_source(*things: Callable) -> HTML:
    """The source code of functions or classes, as it runs, in colour."""
    source = "\n\n".join(inspect.getsource(thing).rstrip() for thing in things)
    page = HtmlFormatter(
        noclasses=True,
        cssstyles="padding: 4px 10px; border-left: 3px solid #0072B2",
        prestyles="font-family: monospace; color: black",
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
