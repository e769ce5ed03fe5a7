"""What a lesson asks its reader: a prediction before a result, and three questions at its end.

    guess = predict("What will the car do?", ["spin", "go straight"])  # shows the question
    guess.reveal("spin", "The rear wheels lose their grip.")           # in a later cell

Without an answer, or without a kernel, a lesson reads on all the same.
"""

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import cast

import ipywidgets
import numpy as np
from IPython.display import HTML, DisplayHandle
from PIL import Image

from stad_lab.viz.plots import BLUE, GREEN, RED

Option = tuple[str, str]  # a possible answer, and one sentence on why it is wrong or right
WIDE = {"width": "max-content", "max_width": "100%"}


def panel(color: str, *lines: str) -> HTML:
    """Lines of HTML beside a bar of a colour, in the page's own colours of text and background."""
    style = f"border-left: 4px solid {color}; padding: 2px 12px; margin: 4px 0; line-height: 1.5"
    return HTML(f'<div style="{style}">{"<br>".join(lines)}</div>')


class Prediction(ipywidgets.VBox):
    """A question whose answer is kept until `reveal`; as the last line of a cell it is shown.

    Attributes:
        answer: the chosen option or number, None until there is one.
    """

    def __init__(self, question: str, control: ipywidgets.Widget, choices: str, unit: str = ""):
        self.question, self.control, self.choices, self.unit = question, control, choices, unit
        self.answer: str | float | None = None
        self.revealed: tuple[str | float, str] = "", ""  # the result, and why
        self.place: DisplayHandle | None = None
        control.observe(self._keep, "value")
        heading = ipywidgets.HTML(f"<b>Predict.</b> {escape(question)}")
        super().__init__([heading, control])

    def reveal(self, result: str | float, because: str = "") -> None:
        """Show the result beside the prediction; one that is made later is added at once.

        Args:
            result: one of the options (ValueError for others), or the number.
            because: why, in a sentence.
        """
        options = getattr(self.control, "options", None)
        if options is not None and result not in options:
            raise ValueError(f"result {result!r}: expected one of {', '.join(options)}")
        self.revealed, self.place = (result, because), DisplayHandle()
        self.place.display(self._result())

    def text(self, value: str | float) -> str:
        """An answer as HTML, a number with its unit."""
        return escape(value if isinstance(value, str) else f"{value:.4g} {self.unit}".rstrip())

    def _repr_mimebundle_(self, **kwargs) -> dict:
        """The widget, and for pages without a kernel the question with its choices."""
        bundle = super()._repr_mimebundle_(**kwargs)
        text = panel(BLUE, f"<b>Predict.</b> {escape(self.question)}", escape(self.choices)).data
        return bundle | {"text/html": text}

    def _keep(self, change) -> None:
        self.answer = change["new"]
        if self.place:
            self.place.update(self._result())

    def _result(self) -> HTML:
        result, because = self.revealed
        found = f"<b>Result: {self.text(result)}.</b> {escape(because)}"
        if self.answer is None:
            asked = "<summary>Show the result, without a prediction</summary>"
            return panel(BLUE, f"<details>{asked}{found}</details>")
        right = self.text(self.answer) == self.text(result)  # their last bits may differ
        mark = " &#10003;" if right else ""  # a tick
        color = GREEN if right else BLUE
        return panel(color, f"Your prediction: {self.text(self.answer)}.{mark}", found)


def predict(
    question: str, options: Sequence[str] | tuple[float, float], unit: str = ""
) -> Prediction:
    """Ask for a prediction: one of several texts, or a number between two limits.

    A number's slider begins at the lower limit, which counts as no answer until it is moved.
    """
    if isinstance(options[0], str):
        control = ipywidgets.RadioButtons(options=options, value=None, layout=WIDE)
        return Prediction(question, control, " / ".join(map(str, options)))
    low, high = (cast(float, limit) for limit in options)
    whole = isinstance(low, int) and isinstance(high, int)
    kind = ipywidgets.IntSlider if whole else ipywidgets.FloatSlider
    step = 1 if whole else 0.01 if high <= 1 else 0.1  # results are rounded to these
    control = kind(low, min=low, max=high, step=step, description=unit)
    return Prediction(question, control, f"{low} to {high} {unit}".rstrip(), unit)


def quiz(*questions: tuple[str, list[Option], int]) -> HTML:
    """Questions whose answers open at a click or a key, also on a page without a kernel.

    Args:
        questions: (question, [(answer, why), ...], number of the right answer from 0). Every `why`
            is a sentence on that answer. ValueError if the number fits no answer.
    """
    parts = []
    for number, (question, options, right) in enumerate(questions, 1):
        if not 0 <= right < len(options):
            raise ValueError(f"question {number}: no answer has the number {right}")
        parts.append(f"<p><b>{number}. {escape(question)}</b></p>")
        for position, (answer, why) in enumerate(options):
            word, color = ("Right.", GREEN) if position == right else ("No.", RED)
            verdict = panel(color, f"<b>{word}</b> {escape(why)}").data
            style = "margin: 2px 0 2px 16px; cursor: pointer"
            summary = f"<summary>{escape(answer)}</summary>"
            parts.append(f'<details style="{style}">{summary}{verdict}</details>')
    return HTML(f"<div>{''.join(parts)}</div>")


def recorded_networks(folder: Path) -> tuple[list[dict], np.ndarray, np.ndarray]:
    """The V networks of the page on the KL weight, and what they make of the same frames.

    Returns each network's metadata, frames uint8 (frames, 64, 64, 3), and the reconstructions uint8
    (networks, frames, 64, 64, 3). `docs/live/record_nat.py` trains and records them.
    """
    facts = json.loads((folder / "nat.json").read_text(encoding="utf-8"))
    networks, count = facts["networks"], facts["frames"]
    sheet = np.asarray(Image.open(folder / "nat.webp").convert("RGB"))
    # A row of the sheet is a frame (above) or its difference image; the first column is the truth.
    cells = sheet.reshape(count, 2, 64, len(networks) + 1, 64, 3)[:, 0].transpose(2, 0, 1, 3, 4)
    return networks, cells[0], cells[1:]
