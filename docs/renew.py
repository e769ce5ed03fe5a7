"""Write the measured numbers into the pages: `python docs/renew.py`.

With `--check` it changes nothing and names the stale pages. A page has markers,
`<!-- claims: NAME -->...<!-- /claims -->`, and the text between them comes from claims.json. NAME
is a key of BLOCKS, or the path of a number and its format: `agents/frame/mean:.1f`. The marker of
a number must not begin a line, which Markdown would take for HTML. A card of a network begins with
metadata for model hubs, which are computed, too.
"""

import argparse
import re
import sys
from pathlib import Path

from blocks import BLOCKS, FIGURES, NUMBERS, front_matter
from gallery import PICTURES

from stad_lab.viz.plots import to_png
from stad_study.claims import read_claims

ROOT = Path(__file__).parent.parent
CARDS = ROOT / "stad_lab" / "pretrained"
MARKED = re.compile(r"(<!-- claims: ([^>]+?) -->)(.*?)(<!-- /claims -->)", re.S)


def number(claims: dict, name: str) -> str:
    """One number: a name of NUMBERS or a path, and its format. Raises KeyError if there is none."""
    path, _, form = name.rpartition(":")
    if path in NUMBERS:
        return format(NUMBERS[path](claims), form)
    found = claims
    for key in path.split("/"):
        found = found[int(key)] if isinstance(found, list) else found[key]
    return format(found, form)


def fill(page: str, claims: dict) -> str:
    """A page with the present text between its markers."""

    def replace(match: re.Match) -> str:
        start, name, _, end = match.groups()
        if name in BLOCKS:
            return f"{start}\n\n{BLOCKS[name](claims)}\n\n{end}"
        return f"{start}{number(claims, name)}{end}"

    return MARKED.sub(replace, page)


def pages() -> list[Path]:
    """All pages that may have markers."""
    docs = ROOT / "docs"
    found = [ROOT / "README.md", *sorted(docs.glob("*.md")), *sorted(docs.glob("live/*.md"))]
    return found + sorted(CARDS.glob("*/README.md"))


def stale(claims: dict) -> dict[Path, str]:
    """The pages that differ from the data: file -> text as it should be."""
    texts = {file: file.read_text(encoding="utf-8") for file in pages()}
    filled = {file: fill(text, claims) for file, text in texts.items()}
    for file in CARDS.glob("*/README.md"):
        body = re.sub(r"\A---\n.*?\n---\n+", "", filled[file], flags=re.S)
        filled[file] = front_matter(claims, file.parent.name) + body
    return {file: text for file, text in filled.items() if text != texts[file]}


def main() -> int:
    """Renew the pages and the figures, or check the pages: the exit status is 1 if one is stale."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing, name stale pages")
    check = parser.parse_args().check
    claims = read_claims()
    found = stale(claims)
    for file, text in found.items():
        print(f"{'stale' if check else 'renewed'}: {file.relative_to(ROOT)}")
        if not check:
            file.write_text(text, encoding="utf-8")
    if not check:
        for name in FIGURES:
            (PICTURES / f"{name}.png").write_bytes(to_png(FIGURES[name](claims)))
    return int(check and bool(found))


if __name__ == "__main__":
    sys.exit(main())
