"""Write the tables of the replication's rows into the README and docs/results.md again, and draw the picture of the
claims: python docs/tables.py

Do so when a row has been kept. The words around the tables stay as they are; the tests name those that no longer hold.
"""

import re
from pathlib import Path

import numpy as np

from stad_lab.evaluation.evaluate import bootstrap
from stad_lab.io.files import load_json
from stad_lab.models.vae import VARIANTS
from stad_lab.replication.experiments import ABLATIONS, ROWS
from stad_lab.replication.tables import (
    bootstrap_gain,
    claims_and_outcomes,
    describe_table,
    kept_rows,
    learning_curve,
    official_returns,
    summarise_row,
)
from stad_lab.training.evolution import LOG
from stad_lab.viz.plots import plot_claims, to_png

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "notebooks" / "pictures" / "claims.png"


def line(*cells: str) -> str:
    """A line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def answer_table(rows: dict[str, list[Path]]) -> str:
    """What the paper reports of each variant, and what came out here, as the README begins its answer with."""
    scores = claims_and_outcomes(rows)
    columns = list(scores["frame"])
    lines = [line("variant", *columns), "|---" * (1 + len(columns)) + "|"]
    for variant, found in scores.items():
        cells = []
        for column in columns:
            mean, (low, high), searches = found[column]
            cells.append(
                f"{mean:.0f}" + f" ({low:.0f} to {high:.0f}; {len(searches)})" * bool(searches)
            )
        lines.append(line(f"`{variant}`", *cells))
    return "\n".join(lines)


def spread_table(rows: dict[str, list[Path]]) -> str:
    """How the drives of every row spread."""
    lines = [
        line("row", "standard deviation", "median", "below 800", "best 90"),
        "|---|---|---|---|---|",
    ]
    for name, folders in rows.items():
        returns, found = official_returns(folders), summarise_row(folders)
        failed = f"{(returns < 800).sum()} of {returns.size}"
        numbers = (
            f"{found['standard_deviation']:.0f}",
            f"{np.median(returns):.1f}",
            failed,
            f"{found['top_90']:.1f}",
        )
        lines.append(line(f"`{name}`", *numbers))
    return "\n".join(lines)


def searches_table(rows: dict[str, list[Path]]) -> str:
    """The searches of the paper's recipe one by one; a V is named by the first four digits of its identity."""
    head = (
        "search",
        "V",
        "mean of 100 tracks",
        "complete laps",
        "below 800",
        "last five looks",
        "less `frame`",
    )
    lines, frames = (
        [line(*head), "|---" * len(head) + "|"],
        {one.name: one for one in rows["paper_frame"]},
    )
    for variant in VARIANTS:
        for folder in rows.get(f"paper_{variant}", []):
            returns, frame = official_returns([folder]), frames.get(folder.name)
            lead = (
                f"{returns.mean() - official_returns([frame]).mean():+.1f}"
                if variant != "frame" and frame
                else ""
            )
            counts = f"{(returns >= 900).sum()}", f"{(returns < 800).sum()}"
            last = f"{learning_curve(folder)[1][-5:].mean():.0f}"
            name = f"`paper_{variant}`, seed {folder.name.removeprefix('seed')}"
            trained = f"`{load_json(folder / LOG)['autoencoder'][:4]}`"
            lines.append(line(name, trained, f"{returns.mean():.1f}", *counts, last, lead))
    return "\n".join(lines)


def variants_table(rows: dict[str, list[Path]]) -> str:
    """The four variants of our recipe, seed by seed, before and after the finish."""
    ahead, lines = "`frame` is ahead by", []
    head = "official tracks", "seeds, after two rounds", "below 800", "median", ahead
    lines += [
        line(*head, "seeds, after the finish", "below 800", "gain of the finish", ahead),
        "|---" * 9 + "|",
    ]
    frames = [official_returns(rows[f"{recipe}_frame"]) for recipe in ("two_rounds", "finished")]
    for variant in VARIANTS:
        cells = [f"`{variant}`, official"]
        before, after = (
            official_returns(rows[f"{recipe}_{variant}"]) for recipe in ("two_rounds", "finished")
        )
        finished = {folder.name for folder in rows[f"finished_{variant}"]}
        gain = after - official_returns(
            [one for one in rows[f"two_rounds_{variant}"] if one.name in finished]
        )
        told = (
            f"{np.median(before):.1f}",
            "{:.1f} ({:.1f} to {:.1f})".format(gain.mean(), *bootstrap(gain)),
        )
        for frame, returns, extra in zip(frames, (before, after), told, strict=True):
            low, high = bootstrap_gain(frame, returns)
            lead = (
                f"{frame.mean() - returns.mean():.1f} ({-high:.1f} to {-low:.1f})"
                if variant != "frame"
                else ""
            )
            seeds = ", ".join(f"{mean:.1f}" for mean in returns.mean(axis=1))
            cells += [seeds, f"{(returns < 800).sum()} of {returns.size}", extra, lead]
        lines.append(line(*cells))
    return "\n".join(lines)


def changes_table(rows: dict[str, list[Path]], base_name: str) -> str:
    """What every single change of a row of one round is worth: of "one_round", or of "another_V"."""
    base = official_returns(rows[base_name])
    laps = (base >= 900).mean(axis=1)
    there = f"{laps.mean():.0%} there" + f", {laps.min():.0%} to {laps.max():.0%} by search" * (
        len(laps) > 1
    )
    head = f"difference to `{base_name}`", "what differs", "of the mean"
    interval = "95% interval (of a single search: without its luck)"
    lines = [line(*head, interval, "of the median", f"complete laps ({there})"), "|---" * 6 + "|"]
    for name in [*ABLATIONS, "two_rounds_input"]:
        if name in rows and (ROWS[name].world or "one_round") == base_name:
            found = official_returns(rows[name])
            mean, median = found.mean() - base.mean(), np.median(found) - np.median(base)
            about = ROWS[name].about.removeprefix("one round, ")
            interval = "{:+.1f} to {:+.1f}".format(*bootstrap_gain(base, found))
            numbers = f"{mean:+.1f}", interval, f"{median:+.1f}", f"{(found >= 900).mean():.0%}"
            lines.append(line(f"`{name}` less `{base_name}`", about, *numbers))
    return "\n".join(lines)


def put_table(page: str, table: str) -> str:
    """A page with a table in the place of the one whose first two columns have the same names."""
    name = " | ".join(table.split(" | ")[:2])
    found = re.findall(rf"^{re.escape(name)} \|.*\n(?:\|.*\n)+", page, re.M)
    if len(found) != 1:
        raise ValueError(f"the page has {len(found)} tables that begin with {name!r}, expected one")
    return page.replace(found[0], table + "\n")


def up_to_date(rows: dict[str, list[Path]], label: str) -> dict[Path, str]:
    """The pages as the records, and the alternative text of the picture, want them: file -> text."""
    readme, results = ROOT / "README.md", ROOT / "docs" / "results.md"
    page = put_table(readme.read_text(encoding="utf-8"), describe_table(rows))
    page = put_table(page, answer_table(rows))
    page = re.sub(r"!\[[^]]*\]\((notebooks/pictures/claims.png)\)", rf"![{label}](\1)", page)
    missing = ", ".join(f"`{name}`" for name in ROWS if name not in rows)
    page = re.sub(r"Not made yet: [^.]*\.", f"Not made yet: {missing or 'none'}.", page)
    pages = {readme: page, results: results.read_text(encoding="utf-8")}
    tables = [searches_table(rows), spread_table(rows), variants_table(rows)]
    tables += [changes_table(rows, base) for base in ("one_round", "another_V")]
    for table in tables:
        pages[results] = put_table(pages[results], table)
    return pages


if __name__ == "__main__":
    kept = kept_rows()
    figure = plot_claims(claims_and_outcomes(kept))
    for file, text in up_to_date(kept, figure.get_label()).items():
        file.write_text(text, encoding="utf-8")
        print(file)
    PICTURE.write_bytes(to_png(figure))
    print(PICTURE)
