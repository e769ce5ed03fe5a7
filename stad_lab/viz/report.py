"""The report of a run: one HTML file with its scores, a film, its curves and what made it."""

import html
import shlex
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from stad_lab.agent import load_agent
from stad_lab.config import Config, fields_of
from stad_lab.evaluation.evaluate import evaluations_of, is_of_agent
from stad_lab.evaluation.statistics import SOLVED, describe_tail
from stad_lab.io.files import load_json
from stad_lab.io.weights import CONTROLLER_FILE, MDN_RNN_FILE, VAE_FILE, load_mdn_rnn, load_vae
from stad_lab.training.evolution import LOG, fitness_curves
from stad_lab.training.record import MACHINE, PACKAGES, read_record, starts
from stad_lab.viz import plots
from stad_lab.viz.page import document, picture
from stad_lab.viz.video import FILM, film_agent

STYLE = """
main>figure>img{width:100%;border-radius:.4rem;background:#fff}td,th{text-align:left}
td,th{white-space:normal}.number{font-size:1.6rem;font-weight:600;margin:.2rem 0}
"""


def report(folder: Path) -> str:
    """The page of the run in `folder`, finished or not.

    ValueError if the folder holds no run, or a file is damaged; FileNotFoundError without a record.
    """
    record = read_record(folder)
    figures = curves_of(folder)
    parts = [scores(folder), film(folder)]
    parts += [picture_of(figure) for figure in figures]
    parts += ["<h2>What made it</h2>", about(record)]
    return document(f"Run {folder.resolve().name}", "".join(parts), STYLE)


def scores(folder: Path) -> str:
    """The evaluations of this C, or what to do if there is none."""
    found = [one for one in evaluations_of(folder).values() if is_of_agent(one, folder)]
    if not found:
        own = shlex.quote(str(folder.resolve()))  # a name alone may be a shipped agent's
        command = html.escape(f"python -m stad_lab evaluate --agent {own}")
        return f"<p>Not evaluated yet: <code>{command}</code></p>"
    rows = {}
    for one in found:
        tracks = [episode["track"] for episode in one["episodes"]]
        returns = np.array([episode["return"] for episode in one["episodes"]])
        tail, (low, high) = describe_tail(returns), one["interval"]
        rows[f"tracks {min(tracks)} to {max(tracks)}, {one['renderer']} pictures"] = (
            f"mean {one['mean']:.1f} (95% interval {low:.1f} to {high:.1f}), minimum"
            f" {tail['minimum']:.1f}, above {SOLVED}: {100 * one['above_900']:.0f}%"
        )
    main = max(found, key=lambda one: (one["renderer"] == "gymnasium", len(one["episodes"])))
    return f"<p class=number>Mean return {main['mean']:.1f}</p>{table(rows)}"


def film(folder: Path) -> str:
    """The agent at the wheel; nothing as long as there is no C."""
    if not (folder / CONTROLLER_FILE).exists():
        return ""
    gif = film_agent(load_agent(folder), **FILM)
    text = f"The agent on track {FILM['track']}: observation, difference image, reconstruction"
    text += " and dream"
    return f"<figure>{picture(gif, 'gif', text)}<figcaption>{text}.</figcaption></figure>"


def curves_of(folder: Path) -> list[Figure]:
    """The losses of V and of M, and the returns and step sizes of CMA-ES, as far as they are."""
    figures = []
    parts = {
        VAE_FILE: (load_vae, "V", "squared error + weighted KL"),
        MDN_RNN_FILE: (load_mdn_rnn, "M", "nats per latent"),
    }
    for name, (load, letter, unit) in parts.items():
        if (folder / name).exists() and (history := load(folder / name)[1].get("history")):
            figures.append(plots.plot_history(history, f"The loss of {letter}", unit))
    if (folder / LOG).exists():
        generations = load_json(folder / LOG, kind="evolution")["generations"]
        if generations:
            figures += curves_of_evolution(generations)
    return figures


def curves_of_evolution(generations: list[dict]) -> list[Figure]:
    """Returns of the candidates, and CMA-ES's step size, against the generation."""
    validated = {
        entry["generation"]: entry["validation"]["mean"]
        for entry in generations
        if entry.get("validation")
    }
    sigma = {"sigma": np.array([entry["sigma"] for entry in generations])}
    numbers = np.array([entry["generation"] for entry in generations])
    return [
        plots.plot_evolution(fitness_curves(generations), validated, "The evolution of C"),
        plots.plot_curves(
            sigma, "Step size after the update of CMA-ES", "generation", "sigma", x=numbers
        ),
    ]


def picture_of(figure: Figure) -> str:
    """A figure with its alternative text."""
    return f"<figure>{picture(plots.to_png(figure), 'png', str(figure.get_label()))}</figure>"


def about(record: dict) -> str:
    """Command, times, budget, machine and versions, and the whole configuration, folded."""
    made, spent = record["made_with"], record.get("budget", {})
    rows = {"variant": record["variant"], "command": made.get("command", "not recorded")}
    rows |= {f"time of {name}": f"{t:.0f} s" for name, t in record.get("seconds", {}).items()}
    for name, count in spent.items():
        if isinstance(count, dict) and count["episodes"]:
            rows[name.replace("_", " ")] = (
                f"{count['episodes']:,} episodes, {count['frames']:,} frames"
            )
    rows |= {name.replace("_", " "): made[name] for name in MACHINE if name in made}
    rows["versions"] = ", ".join(f"{name} {made[name]}" for name in PACKAGES if name in made)
    if len(starts(record)) > 1:
        rows["continued"] = (
            f"{len(starts(record)) - 1} times, with another command, version or machine"
        )
    config = {name: value for name, _, value in fields_of(Config.from_dict(record["config"]))}
    return f"{table(rows)}<details><summary>Configuration</summary>{table(config)}</details>"


def table(rows: dict) -> str:
    """A table of names and values, as HTML."""
    cells = "".join(
        f"<tr><th scope=row>{html.escape(str(name))}</th><td>{html.escape(str(value))}</td></tr>"
        for name, value in rows.items()
    )
    return (
        f'<div class=table tabindex=0 role=region aria-label="Details"><table>{cells}</table></div>'
    )
