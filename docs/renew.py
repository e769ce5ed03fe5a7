"""Write the measured numbers into the pages: `python docs/renew.py`.

With `--check` it changes nothing and names the stale pages. A page has markers, `<!-- claims: NAME -->...<!-- /claims -->`, and what stands between them comes
from the data. NAME is a key of TABLES, or the path of one number in claims.json and its format:
`agents/frame/mean:.1f`. A marker of a number must not begin a line: Markdown would take the line
for HTML.
"""

import argparse
import ast
import inspect
import itertools
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

from figures import CONDITIONS, plot_forest, to_png
from PIL import Image

from stad_lab import config

ROOT = Path(__file__).parent.parent
CLAIMS = ROOT / "stad_lab" / "replication" / "data" / "claims.json"
PICTURES = ROOT / "notebooks" / "pictures"
FOREST = PICTURES / "claims.png"
GALLERY = ("00-11", "01-16", "02-17", "03-31", "04-08", "06-15")  # drawn by docs/gallery.py
MARKED = re.compile(r"(<!-- claims: ([^>]+?) -->)(.*?)(<!-- /claims -->)", re.S)
QUANTITIES = (
    "forward speed", "slip speed", "yaw rate", "wheel angle", "road offset", "heading error",
)  # fmt: skip
VERDICTS = {
    "paper": "open: baseline too low",
    "no_bar": "open: two runs each",
    "two_iterations": "open: ceiling",
    "fine_tuned": "open: ceiling",
}


def table(head: tuple[str, ...], lines: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    cells = [head, ("---",) * len(head), *lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


def agents_table(claims: dict) -> str:
    """The shipped agents: one line each."""
    head = ("agent", "mean", "minimum", "10th percentile", "below 800", "Gymnasium")
    return table(
        head,
        [
            (
                f"`{name}`",
                f"{one['mean']:.1f}",
                f"{one['minimum']:.1f}",
                f"{one['tenth_percentile']:.1f}",
                f"{one['below_800']:.0%}",
                one["gymnasium"],
            )
            for name, one in claims["agents"].items()
        ],
    )


def card(claims: dict, name: str) -> str:
    """The scores of one shipped agent."""
    one = claims["agents"][name]
    low, high = one["interval"]
    lines = [
        ("tracks", f"0 to 99, one episode each, Gymnasium {one['gymnasium']}"),
        ("mean", f"{one['mean']:.1f} (95% interval over tracks: {low:.1f} to {high:.1f})"),
        ("standard deviation", f"{one['standard_deviation']:.1f}"),
        ("minimum", f"{one['minimum']:.1f}"),
        ("10th percentile", f"{one['tenth_percentile']:.1f}"),
        ("below 800", f"{one['below_800']:.0%}"),
        ("complete laps", f"{one['above_900']:.0%}"),
    ]
    return table(("measure", "value"), lines)


def results_table(claims: dict) -> str:
    """Each variant against `frame`, in each condition."""
    lines = []
    for condition, title in CONDITIONS.items():
        found = claims["differences"][condition]
        base = found["frame"]
        for variant in config.VARIANTS[1:]:
            one = found[variant]
            low, high = one["interval"]
            lines.append(
                (
                    title,
                    f"`{variant}`",
                    f"{len(one['runs'])}, {len(base['runs'])}",
                    f"{base['mean']:.0f}",
                    f"{one['mean']:.0f}",
                    f"{one['difference']:+.0f} ({low:.0f} to {high:.0f})",
                    f"{one['p']:.2f}",
                    VERDICTS[condition],
                )
            )
    head = ("condition", "variant", "runs", "`frame`", "variant's mean", "difference", "p")
    return table((*head, "verdict"), lines)


def representation_table(claims: dict) -> str:
    """R2 of the probe from z, over the trainings of each variant without the indicator bar."""
    lines = []
    for variant, found in claims["representation"].items():
        ranges = [f"{min(found[one]):.2f} to {max(found[one]):.2f}" for one in QUANTITIES]
        lines.append((f"`{variant}`", str(len(found["yaw rate"])), *ranges))
    return table(("variant", "trainings", *QUANTITIES), lines)


def latents_table(claims: dict, driver: str) -> str:
    """R2 from z, and in brackets from z and h, of the study's trainings under one driver."""
    lines = []
    for kind, title in (("cropped", ""), ("bar", ", with the indicator bar")):
        for name, found in claims["latents"][kind][driver].items():
            if kind == "bar" and "untrained" in name:
                continue
            cells = []
            for one in QUANTITIES:
                both = found.get("z, h")
                memory = f" ({both[one]['r2']:.2f})" if both else ""
                cells.append(f"{found['z'][one]['r2']:.2f}{memory}")
            variant, _, rest = name.partition(",")
            lines.append((f"`{variant}`{',' * bool(rest)}{rest}{title}", *cells))
    return table(("V", *QUANTITIES), lines)


def experiments_table(claims: dict) -> str:
    """All earlier runs, without inference."""
    head = ("experiment", "means of the runs", "mean", "median", "below 800", "complete laps")
    head += ("V, M", "agents", "episodes")
    lines = []
    for name, one in claims["experiments"].items():
        runs = ", ".join(f"{mean:.1f}" for mean in one["runs"])
        numbers = (f"{one['mean']:.1f}", f"{one['median']:.1f}")
        shares = (f"{one['below_800']:.0%}", f"{one['above_900']:.0%}")
        budget = (str(one["world_models"]), f"{one['agents']:,}", f"{one['episodes']:,}")
        lines.append((f"`{name}`", runs, *numbers, *shares, *budget))
    return table(head, lines)


def speed_table(claims: dict, part: str, kind: str, unit: str) -> str:
    """One comparison of the benchmark."""
    found = claims["benchmark"][part][kind]
    lines = [(name, f"{one['median']:,.0f}", f"{one['ratio']:.2f}") for name, one in found.items()]
    return table((unit, "median", "ratio"), lines)


def costs_table(claims: dict) -> str:
    """What one frame of 16 cars costs, part by part."""
    found = claims["benchmark"]["loop"]["microseconds of a frame, 16 cars in one process"]
    return table(
        ("part", "microseconds a frame"), [(part, f"{cost:.0f}") for part, cost in found.items()]
    )


def training_table(claims: dict) -> str:
    """Speed of training, with and without our layers."""
    lines = []
    for name, found in claims["benchmark"]["training"].items():
        if " a second" in name:
            plain, ours = found["plain"]["median"], found["stad_lab"]["median"]
            lines.append((name, f"{plain:,.0f}", f"{ours:,.0f}", f"{ours / plain:.2f}"))
    return table(("unit", "plain PyTorch", "stad_lab", "ratio"), lines)


def cluster_table(claims: dict) -> str:
    """Processes and Dask workers, side by side."""
    found = claims["cluster"]["cluster"]["frames a second, a generation"]
    lines = [(name, f"{one['median']:,.0f}", f"{one['ratio']:.2f}") for name, one in found.items()]
    return table(("workers", "frames a second", "ratio"), lines)


def settings_table(claims: dict) -> str:
    """All options of `train`, with the values of the three presets."""
    values = [
        {name: str(value) for name, _, value in config.fields_of(preset)}
        for preset in config.PRESETS.values()
    ]
    lines = []
    for name in values[0]:
        stage, _, field = name.rpartition(".")
        kind = type(getattr(config.Config(), stage)) if stage else config.Config
        lines.append((f"`{name}`", *(one[name] for one in values), help_of(kind)[field]))
    return table(("option", *config.PRESETS, "meaning"), lines)


def help_of(kind: type) -> dict[str, str]:
    """The docstring below each field of a dataclass: field -> text."""
    body = ast.parse(inspect.getsource(kind)).body[0].body
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def gallery(claims: dict) -> str:
    """Some figures of the notebooks, with the alternative texts that the files hold."""
    lines = []
    for cell in GALLERY:
        text = Image.open(PICTURES / f"{cell}.png").text["Description"]
        lines.append(f"![{text}](../notebooks/pictures/{cell}.png)")
    return "\n\n".join(lines)


def forest(claims: dict):
    """The figure of the claim."""
    best = max(one["maximum"] for one in claims["experiments"].values())
    return plot_forest(claims["differences"], best)


TABLES: dict[str, Callable[[dict], str]] = {
    "agents": agents_table,
    "results": results_table,
    "representation": representation_table,
    "latents agent": lambda claims: latents_table(claims, "trained agent"),
    "latents random": lambda claims: latents_table(claims, "random driver"),
    "experiments": experiments_table,
    "renderer": lambda claims: speed_table(
        claims, "renderer", "frames a second on one core", "one core, random driver"
    ),
    "loop": lambda claims: speed_table(
        claims, "loop", "frames a second, a generation", "a generation of CMA-ES"
    ),
    "costs": costs_table,
    "training": training_table,
    "cluster": cluster_table,
    "settings": settings_table,
    "gallery": gallery,
    "figure": lambda claims: f"![{forest(claims).get_label()}](notebooks/pictures/claims.png)",
    "figure in docs": lambda claims: (
        f"![{forest(claims).get_label()}](../notebooks/pictures/claims.png)"
    ),
}


def value(claims: dict, name: str) -> str:
    """One number of the claims: `agents/frame/mean:.1f`. Raises KeyError if there is none."""
    path, _, form = name.partition(":")
    found = claims
    for key in path.split("/"):
        found = found[int(key)] if isinstance(found, list) else found[key]
    return format(found, form)


def fill(page: str, claims: dict) -> str:
    """A page with the present numbers between its markers."""

    def replace(match: re.Match) -> str:
        start, name, _, end = match.groups()
        if name in TABLES:
            return f"{start}\n\n{TABLES[name](claims)}\n\n{end}"
        if name.startswith("card "):
            return f"{start}\n\n{card(claims, name.removeprefix('card '))}\n\n{end}"
        return f"{start}{value(claims, name)}{end}"

    return MARKED.sub(replace, page)


def pages() -> list[Path]:
    """All pages that may have markers."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return found + sorted((ROOT / "stad_lab" / "pretrained").glob("*/README.md"))


def stale(claims: dict) -> dict[Path, str]:
    """The pages that differ from the data: file -> text as it should be."""
    texts = {file: file.read_text(encoding="utf-8") for file in pages()}
    filled = {file: fill(text, claims) for file, text in texts.items()}
    return {file: text for file, text in filled.items() if text != texts[file]}


def main() -> int:
    """Renew the pages and the figure, or check the pages; the exit status is 1 if one is stale."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing, list stale pages")
    parser.add_argument("--claims", type=Path, default=CLAIMS, help="the file of the numbers")
    options = parser.parse_args()
    claims = json.loads(options.claims.read_text(encoding="utf-8"))
    found = stale(claims)
    for file, text in found.items():
        print(f"{'stale' if options.check else 'renewed'}: {file.relative_to(ROOT)}")
        if not options.check:
            file.write_text(text, encoding="utf-8")
    if not options.check:
        FOREST.write_bytes(to_png(forest(claims)))
    return 1 if found and options.check else 0


if __name__ == "__main__":
    sys.exit(main())
