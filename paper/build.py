"""Build the article about study 1: `python paper/build.py [--template FOLDER]`.

It writes paper/build: the article in the form of ReScience C, with every number, table and figure
computed from the recorded episodes. With a copy of ReScience's template, whose licence is another,
it also makes article.pdf, for which TeX Live, latexmk and biber must be installed:

    git clone https://github.com/ReScience/template
    python paper/build.py --template template

In content.tex and abstract.tex, \\val{PATH:FORMAT} is a number and \\interval{PATH} has two, with
paths as in docs/renew.py. \\tabular{NAME} is one of TABLES.
"""

import argparse
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "docs"))
import blocks  # noqa: E402
import renew  # noqa: E402

from stad_lab.config import Config  # noqa: E402
from stad_study.claims import PAPER, PAPER_GAINS, read_claims  # noqa: E402

SOURCES = ("metadata.yaml", "bibliography.bib")
TEMPLATE = ("article.tex", "header.tex", "rescience.cls", "article.py", "yaml-to-latex.py")
FONTS = ("roboto", "source-code-pro", "source-sans-pro", "source-serif-pro")
FIGURES = ("study1", "study1_scores")
LEFT_OUT = ("test", "SD of pairs", "p")  # columns, so that the others can be read
TABLES: dict[str, Callable[[dict], str]] = {
    "paper": blocks.paper_table,
    "tests": lambda claims: blocks.comparisons_table(claims["study1"]),
    "probe": blocks.turning_table,
}


def facts(claims: dict) -> dict:
    """The claims, with what the paper reports and the recipe of study 1."""
    gains = {f"gain of {name}": gain for name, gain in PAPER_GAINS.items()}
    own = {"paper": dict(PAPER), "gain": min(gains.values()), **gains}
    runs = claims["study1"]["arms"]["z, h: frame"]["by_seed"]
    own |= {"lowest frame": min(runs), "highest frame": max(runs)}
    own["networks"] = blocks.NUMBERS["trained networks"](claims)
    return claims | own | {"recipe": Config.preset("laptop").as_dict()}


def escape(text: str) -> str:
    """Markdown of a table's cell as LaTeX."""
    text = re.sub(r"([%_&#])", r"\\\1", text)
    text = re.sub(r"`([^`]*)`", r"\\texttt{\1}", text)
    return re.sub(r"(?<![\w-])-(?=\d)", "$-$", text)


def tabular(markdown: str) -> str:
    """A table in Markdown, without LEFT_OUT, as LaTeX, as wide as the text at most."""
    cells = [line.strip("| ").split(" | ") for line in markdown.splitlines()]
    kept = [place for place, name in enumerate(cells[0]) if name not in LEFT_OUT]
    cells = [[line[place] for place in kept] for line in (cells[0], *cells[2:])]
    head, *lines = (" & ".join(map(escape, line)) + r" \\" for line in cells)
    columns = "l" * len(kept)
    body = [rf"\begin{{tabular}}{{{columns}}}", r"\hline", head, r"\hline", *lines, r"\hline"]
    fit = r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%"
    return "\n".join([fit, *body, r"\end{tabular}}"])


def fill(text: str, found: dict) -> str:
    """Numbers and tables in place of their marks. KeyError if there is none of a name."""

    def interval(match: re.Match) -> str:
        low, high = (renew.number(found, f"{match[1]}/{end}:.1f") for end in (0, 1))
        return escape(f"{low} to {high}")

    text = re.sub(r"\\val\{([^}]+)\}", lambda match: escape(renew.number(found, match[1])), text)
    text = re.sub(r"\\interval\{([^}]+)\}", interval, text)
    return re.sub(r"\\tabular\{(\w+)\}", lambda match: tabular(TABLES[match[1]](found)), text)


def write(folder: Path) -> None:
    """Write the article's own files."""
    folder.mkdir(parents=True, exist_ok=True)
    found = facts(read_claims())
    for name in FIGURES:
        blocks.FIGURES[name](found).savefig(folder / f"{name}.pdf")
    content = fill((HERE / "content.tex").read_text(encoding="utf-8"), found)
    (folder / "content.tex").write_text(content, encoding="utf-8")
    abstract = fill((HERE / "abstract.tex").read_text(encoding="utf-8"), found)
    metadata = (HERE / "metadata.yaml").read_text(encoding="utf-8")
    quoted = " ".join(abstract.split()).replace("\\", "\\\\")
    (folder / "metadata.yaml").write_text(metadata.replace("ABSTRACT", quoted), encoding="utf-8")
    shutil.copy(HERE / "bibliography.bib", folder)


def compile_pdf(folder: Path, template: Path) -> None:
    """Add ReScience's class, fonts and header, and make article.pdf."""
    for name in TEMPLATE:
        shutil.copy(template / name, folder)
    for name in FONTS:
        shutil.copytree(template / name, folder / name, dirs_exist_ok=True)
    convert = [sys.executable, "yaml-to-latex.py", "-i", "metadata.yaml", "-o", "metadata.tex"]
    subprocess.run(convert, cwd=folder, check=True)
    subprocess.run(["latexmk", "-xelatex", "-interaction=nonstopmode", "article.tex"],
                   cwd=folder, check=True)  # fmt: skip


def main() -> None:
    """Build the article."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--template", type=Path, help="a clone of ReScience/template")
    template = parser.parse_args().template
    folder = HERE / "build"
    write(folder)
    if template:
        compile_pdf(folder, template.resolve())
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
