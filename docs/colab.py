"""Write the notebooks for Google Colab: `python docs/colab.py OWNER/NAME FOLDER`.

Colab opens a notebook without its repository. So a first cell fetches the repository and installs
it into Colab's own Python, whose NumPy and PyTorch stay as they are. Pictures and links become
addresses of the repository on GitHub; links to other notebooks open them in Colab, from the branch
on which FOLDER is published.
"""

import re
import sys
from pathlib import Path

import nbformat

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
BRANCH = "colab"  # on which the workflow publishes FOLDER
SETUP = """# Google Colab: fetch the repository, and install it into Colab's own Python
%cd -q /content
!git clone -q --depth 1 https://github.com/{repository} stad_lab
%pip install -q "./stad_lab[train]"
%cd -q stad_lab/notebooks"""


def address(repository: str, name: str) -> str:
    """Where Colab opens a notebook, for example "00_first_drive.ipynb"."""
    return f"https://colab.research.google.com/github/{repository}/blob/{BRANCH}/{name}"


def link_absolutely(text: str, repository: str) -> str:
    """The Markdown of a cell with addresses in place of relative links and pictures."""
    pages = f"https://github.com/{repository}/blob/main/"
    files = f"https://raw.githubusercontent.com/{repository}/main/notebooks/"
    text = re.sub(r"\]\((pictures/[^)]+)\)", rf"]({files}\1)", text)
    text = re.sub(r"\]\((\d\d\w?_\w+\.ipynb)", lambda m: f"]({address(repository, m[1])}", text)
    text = re.sub(r"\]\(\.\./([^)]+)\)", rf"]({pages}\1)", text)
    return re.sub(r"\]\((exercises/[^)]+)\)", rf"]({pages}notebooks/\1)", text)


def convert(notebook: Path, repository: str) -> nbformat.NotebookNode:
    """A notebook whose first code cell makes the others run on Colab."""
    found = nbformat.read(notebook, as_version=4)
    for cell in found.cells:
        if cell.cell_type == "markdown":
            cell.source = link_absolutely(cell.source, repository)
    setup = nbformat.v4.new_code_cell(SETUP.format(repository=repository), id="colab-setup")
    first = next(n for n, cell in enumerate(found.cells) if cell.cell_type == "code")
    found.cells.insert(first, setup)
    return found


def main(repository: str, folder: str) -> None:
    """Write every notebook of the lessons into a folder."""
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", repository):
        raise SystemExit(f"{repository!r} is not a repository: expected OWNER/NAME, as on GitHub")
    Path(folder).mkdir(parents=True, exist_ok=True)
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        nbformat.write(convert(notebook, repository), Path(folder) / notebook.name)
        print(Path(folder) / notebook.name)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: python docs/colab.py OWNER/NAME FOLDER")
    main(*sys.argv[1:])
