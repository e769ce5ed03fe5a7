"""Render the figures of the front page again, from the notebooks: `python docs/gallery.py`.

A committed notebook has no outputs, so a reader on a code host sees no figures. Each picture is
named by the cell that shows it, and holds its alternative text.
"""

import base64
import os
import re
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
PICTURES = NOTEBOOKS / "pictures"
CELLS = {  # and what the front page says below
    "00-11": "How long may you disturb the agent before it is lost?",
    "01-16": "What has changed in four frames shows the speed",
    "02-33": "With a large penalty on information, V drops the road",
    "02b-22": "How fast the car turns, read off 32 numbers",
    "03-31": "A real episode, and four dreams of it",
    "04-19": "A driver evolves: cars of four generations (orange: the best)",
    "06-15": "A good agent misses a hairpin",
}


def figure_of(cell: str) -> bytes:
    """The PNG that a cell of a notebook shows, after the notebook has run up to this cell."""
    (notebook,) = NOTEBOOKS.glob(f"{cell.partition('-')[0]}_*.ipynb")
    ran = nbformat.read(notebook, as_version=4)
    last = [one["id"] for one in ran.cells].index(cell)
    ran.cells = ran.cells[: last + 1]
    NotebookClient(ran, timeout=600, resources={"metadata": {"path": str(NOTEBOOKS)}}).execute()
    shown = "".join(
        output["data"].get("text/html", "") for output in ran.cells[-1].outputs if "data" in output
    )
    return base64.b64decode(re.search(r"data:image/png;base64,([^\"]+)", shown).group(1))


if __name__ == "__main__":
    os.environ["STAD_LAB_PRESET"] = "laptop"  # the kernels inherit it
    for cell in CELLS:
        picture = PICTURES / f"{cell}.png"
        picture.write_bytes(figure_of(cell))
        print(picture)
