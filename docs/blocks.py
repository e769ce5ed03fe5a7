"""The tables and numbers of the pages, computed from claims.json: see renew.py."""

import ast
import inspect
import itertools
import json
import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path

from gallery import CELLS, PICTURES
from PIL import Image

from stad_lab import cli, config
from stad_lab.replication.study_claims import FAMILIES, FEATURES, MARGIN
from stad_lab.viz.replication import (
    CONDITIONS,
    SEEN,
    difference_of,
    plot_forest,
    plot_learning_curves,
    plot_representation,
    plot_study,
)

PACKAGE = Path(config.__file__).parent
PRETRAINED = PACKAGE / "pretrained"
AGENTS = (*config.VARIANTS, "cropped_input")
QUANTITIES = (
    "forward speed", "slip speed", "yaw rate", "wheel angle", "road offset", "heading error",
)  # fmt: skip


def table(head: Iterable[str], lines: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    head = list(head)
    cells = [head, ["---"] * len(head), *lines]
    escaped = ([cell.replace("|", r"\|") for cell in line] for line in cells)
    return "\n".join("| " + " | ".join(line) + " |" for line in escaped)


def fixed(value: float) -> str:
    """Two decimals, and no negative zero."""
    return f"{round(value, 2) + 0.0:.2f}"


# The replication


def results_table(claims: dict) -> str:
    """Each variant against `frame`, condition by condition."""
    lines = []
    for condition, title in CONDITIONS.items():
        found = claims["recipes"][condition]
        for variant in config.VARIANTS[1:]:
            one = found[variant]
            means = (f"{found['frame']['mean']:.0f}", f"{one['mean']:.0f}", difference_of(one))
            name = f"{title[0]} `{variant}`"
            runs = str(len(one["runs"]))
            outcome = verdict(claims["verdict"][condition])
            lines.append((name, runs, *means, f"{one['welch_p']:.2f}", outcome))
    head = ("condition, variant", "runs", "`frame`", "variant", "difference", "p", "verdict")
    return table(head, lines)


def verdict(found: dict) -> str:
    """What a condition says about the claim."""
    if not found["baseline_passes"]:
        return "inconclusive: baseline fails"
    return found["outcome"] if found["has_room"] else "inconclusive: ceiling"


def study1(claims: dict) -> str:
    """Study 1: its progress, and after the last seed its tables and figures."""
    found = claims["study1"]
    on_gpu = sum(count for name, count in found["trained_on"].items() if name != "cpu")
    trained = f"{on_gpu} of {sum(found['trained_on'].values())} V networks were trained on a GPU."
    if "comparisons" not in found:
        seeds = "{complete_seeds} of {planned_seeds} seeds"
        text = f"**{seeds} are complete** ({{pipelines}} of {{planned_pipelines}} pipelines)."
        return f"{text} {trained} Nothing is tested before the last seed.".format(**found)
    parts = [trained, comparisons_table(found), outcomes_table(found)]
    return "\n\n".join([*parts, *(image(name, study_figures(claims)) for name in STUDY1_FIGURES)])


def comparisons_table(study: dict) -> str:
    """The tests of study 1."""
    lines = []
    for family, variants in FAMILIES.items():
        for features, variant in itertools.product(FEATURES, variants):
            arm = f"{features}: {variant}"
            one, arms = study["comparisons"][arm], study["arms"]
            means = [f"{arms[name]['mean']:.0f}" for name in (f"{features}: frame", arm)]
            p = [p_value(one[key]) for key in ("p", "holm_p")]
            outcome = one["verdict"]
            if outcome == "undecided":
                outcome += f": {one['seeds_that_decide']} seeds would decide"
            name = f"`{variant}`, {SEEN[features]}"
            pipelines = str(len(one["by_seed"]))
            lines.append((family, name, pipelines, *means, difference_of(one), *p, outcome))
    head = ("test", "variant", "pairs", "`frame`", "variant", "difference", "p", "Holm's p")
    return table((*head, "verdict"), lines)


def p_value(p: float) -> str:
    """Three decimals, or that it is smaller."""
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def outcomes_table(study: dict) -> str:
    """The secondary outcomes of the arms of study 1."""
    lines = []
    for features, variant in itertools.product(FEATURES, config.VARIANTS):
        one = study["arms"][f"{features}: {variant}"]
        points = ("interquartile_mean", "tenth_percentile", "minimum", "area")
        scores = [f"{one[key]:.0f}" for key in points]
        compared = study["comparisons"].get(f"{features}: {variant}")
        faster = {}
        if compared:
            faster = {
                "difference": compared["area_difference"],
                "interval": compared["area_interval"],
            }
        name = f"`{variant}`, {SEEN[features]}"
        cells = (name, f"{one['below_800']:.1%}", *scores, difference_of(faster) if faster else "")
        lines.append(cells)
    head = ("arm", "below 800", "interquartile mean", "10th percentile", "minimum")
    return table((*head, "area under the learning curve", "less `frame`"), lines)


def study3(claims: dict) -> str:
    """Study 3: R2 from z, and in brackets from z and h, means over the seeds so far."""
    found = claims["study3"]
    text = "{seeds} of {planned_seeds} seeds are probed ({networks} V networks).".format(**found)
    if not (names := [name for name in found if name.startswith("agent: ")]):
        return text
    order = sorted(names, key=lambda name: ("untrained" in name, len(name)))
    lines = [(f"`{name[7:]}`".replace(", untrained`", "`, untrained"),
              *(r2_cell(found[name], quantity) for quantity in QUANTITIES))
             for name in order]  # fmt: skip
    picture = image("study3", study_figures(claims))
    return "\n\n".join([text, table(("V", *QUANTITIES), lines), picture])


def r2_cell(found: dict, quantity: str) -> str:
    """The mean of R2 from z with its interval, and in brackets that from z and h."""
    alone, both = (found[features][quantity] for features in FEATURES)
    low, high = (fixed(bound) for bound in alone["interval"])
    return f"{fixed(alone['mean'])}, {low} to {high} ({fixed(both['mean'])})"


STUDY1_FIGURES = ("study1", "study1_curves")


def study_figures(claims: dict) -> dict:
    """The figures of the studies for which there is data: name of the file -> Figure."""
    one, three, figures = claims["study1"], claims["study3"], {}
    if "comparisons" in one:
        drawn = plot_study(one["comparisons"], MARGIN), plot_learning_curves(one["curves"])
        figures |= dict(zip(STUDY1_FIGURES, drawn, strict=True))
    if three["seeds"] > 1:
        figures["study3"] = plot_representation(three)
    return figures


def image(name: str, figures: dict) -> str:
    """A figure in Markdown, for a page in docs."""
    return f"![{figures[name].get_label()}](../notebooks/pictures/{name}.png)"


def experiments_table(claims: dict) -> str:
    """All earlier runs, without inference."""
    head = ("experiment", "what", "V, M", "mean of each run", "mean", "below 800", "complete laps")
    head += ("candidates", "episodes")
    lines = []
    for name, one in claims["experiments"].items():
        runs = ", ".join(f"{mean:.0f}" for mean in one["runs"])
        scores = (str(one["world_models"]), runs, f"{one['mean']:.1f}")
        shares = [f"{one[key]:.0%}" for key in ("below_800", "above_900")]
        budget = [f"{one[key]:,.0f}" for key in ("agents", "episodes")]
        lines.append((f"`{name}`", one["about"], *scores, *shares, *budget))
    return table(head, lines)


# The latents


def r2(claims: dict, driver: str, world_model: str, features: str = "z") -> dict[str, float]:
    """R2 of the probe: quantity -> value; empty if it was not measured."""
    return claims["probe"][f"{driver}: {world_model}"].get(features, {})


def trainings(claims: dict, variant: str) -> list[str]:
    """The measured V networks of a variant without the indicator bar, by their names in `probe`."""
    names = [name.partition(": ")[2] for name in claims["probe"] if name.startswith("agent: ")]
    return [one for one in names if re.fullmatch(rf"(cropped|no_bar|paper)_{variant}-\d+", one)]


def representation_table(claims: dict, quantities: tuple[str, ...] = QUANTITIES) -> str:
    """The range of R2 from z over the trainings of each variant, while the agent drives."""
    lines = []
    for variant in config.VARIANTS:
        found = [r2(claims, "agent", one) for one in trainings(claims, variant)]
        ranges = [spread([one[quantity] for one in found]) for quantity in quantities]
        lines.append((f"`{variant}`", str(len(found)), *ranges))
    return table(("variant", "trainings", *quantities), lines)


def spread(values: list[float]) -> str:
    """The lowest and the highest value."""
    return f"{min(values):.2f} to {max(values):.2f}"


def latents_table(claims: dict, driver: str) -> str:
    """R2 from z, and in brackets from z and h, of one training of each variant."""
    groups = {"cropped_{}": "`{}`", "{}": "`{}`, indicator bar visible"}
    names = [(group.format(one), title.format(one)) for group, title in groups.items()
             for one in config.VARIANTS]  # fmt: skip
    names += [(f"untrained_cropped_{one}", f"`{one}`, untrained") for one in config.VARIANTS[::3]]
    return table(("V", *QUANTITIES), [probe_line(claims, driver, *name) for name in names])


def probe_line(claims: dict, driver: str, world_model: str, title: str) -> tuple[str, ...]:
    """One line of `latents_table`."""
    alone = r2(claims, driver, f"{world_model}-0")
    both = r2(claims, driver, f"{world_model}-0", "z, h")
    cells = [
        f"{fixed(alone[one])}" + (f" ({fixed(both[one])})" if both else "") for one in QUANTITIES
    ]
    return (title, *cells)


def random_yaw(claims: dict) -> list[float]:
    """R2 of the yaw rate from z of `input_output` under the random driver, of each training."""
    names = trainings(claims, "input_output")
    return [r2(claims, "random_driver", one)["yaw rate"] for one in names]


# The agents


def agents_table(claims: dict) -> str:
    """The shipped agents, one line each."""
    head = ("agent", "mean", "minimum", "10th percentile", "below 800", "Gymnasium")
    lines = []
    for name in AGENTS:
        one = claims["agents"][name]
        scores = [f"{one[key]:.1f}" for key in ("mean", "minimum", "tenth_percentile")]
        card = f"[`{name}`](stad_lab/pretrained/{name}/README.md)"
        lines.append((card, *scores, f"{one['below_800']:.0%}", one["gymnasium"]))
    return table(head, lines)


def card(claims: dict, name: str) -> str:
    """The scores and the budget of one shipped agent."""
    one = claims["agents"][name]
    low, high = one["interval"]
    lines = [
        ("mean return", f"{one['mean']:.1f} (95% interval over tracks: {low:.1f} to {high:.1f})"),
        ("standard deviation", f"{one['standard_deviation']:.1f}"),
        ("minimum", f"{one['minimum']:.1f}"),
        ("10th percentile", f"{one['tenth_percentile']:.1f}"),
        ("episodes below 800", f"{one['below_800']:.0%}"),
        ("complete laps", f"{one['above_900']:.0%}"),
        ("protocol", f"tracks 0 to 99, one episode each, Gymnasium {one['gymnasium']}"),
        ("budget", f"{one['agents']:,.0f} candidates, {one['episodes']:,.0f} episodes,"
         f" {one['frames'] / 1e6:.1f} million frames"),
    ]  # fmt: skip
    return table(("measure", "value"), lines)


def recipe(name: str) -> str:
    """The stages of a shipped agent's training, from its record."""
    record, lines = json.loads((PRETRAINED / name / "record.json").read_text("utf-8")), []
    while record:
        one = record["config"]["evolution"]
        driven = record["budget"]["evolution"]["episodes"]
        numbers = [str(one[key]) for key in ("generations", "population", "tracks")]
        numbers += [f"{one['replay_share']:.0%}", str(one["sigma"]), f"{driven:,}"]
        lines.insert(0, numbers)
        record = record.get("earlier")
    stages = ("first iteration", "second iteration", "fine-tuning")
    head = ("stage", "generations", "candidates", "tracks", "replayed", "sigma", "episodes")
    return table(head, [(stage, *one) for stage, one in zip(stages, lines, strict=False)])


def probe_card(claims: dict, name: str) -> str:
    """R2 of the probe for one V and M, with both drivers."""
    lines = []
    for driver, title in (("agent", "trained agent"), ("random_driver", "random driver")):
        for features in ("z", "z, h"):
            found = r2(claims, driver, f"{name}-0", features)
            lines.append((title, features, *(f"{fixed(found[one])}" for one in QUANTITIES)))
    return table(("driver", "features", *QUANTITIES), lines)


# Speed


def speed_table(claims: dict, key: str, head: str) -> str:
    """One comparison of the benchmark, slowest first; with the ratio to EnvPool if it took part."""
    found = sorted(claims["speed"][key].items(), key=lambda one: one[1]["median"])
    pool = max((one["median"] for name, one in found if name.startswith("EnvPool")), default=None)
    lines = [
        (name, f"{one['median']:,.0f}", f"{one['ratio']:.1f}")
        + ((f"{one['median'] / pool:.1f}",) if pool else ())
        for name, one in found
    ]
    heads = (head, "frames a second", "ratio") + (("to EnvPool",) if pool else ())
    return table(heads, lines)


def costs_table(claims: dict) -> str:
    """The time of one frame with 16 cars, part by part."""
    costs = claims["speed"]["loop: microseconds of a frame, 16 cars in one process"]
    lines = sorted(costs.items(), key=lambda one: -one[1])
    return table(("part", "microseconds a frame"), [(name, f"{one:.1f}") for name, one in lines])


def training_table(claims: dict) -> str:
    """The speed of training."""
    found = {
        key.removeprefix("training: "): one["stad_lab"]["median"]
        for key, one in claims["speed"].items()
        if key.startswith("training: ") and " a second" in key
    }
    return table(("training", "speed"), [(name, f"{one:,.0f}") for name, one in found.items()])


def stages_table(claims: dict) -> str:
    """Minutes of each stage of a whole run, whose agent is evaluated with either renderer."""
    stages = {"dataset": "dataset", "vae": "training V", "mdn_rnn": "training M",
              "controller": "CMA-ES"}  # fmt: skip
    found = claims["speed"]["run: minutes of a whole run"]
    renderers = [f"evaluation with {name}" for name in ("our engine", "Gymnasium")]
    lines = [(title, *[f"{found[stage]:.1f}"] * 2) for stage, title in stages.items()]
    lines.append(("evaluation", *(f"{found[name]:.1f}" for name in renderers)))
    trained = sum(found[stage] for stage in (*stages, "all else"))
    lines.append(("all", *(f"{trained + found[name]:.1f}" for name in renderers)))
    return table(("stage, minutes", *renderers), lines)


# The configuration, and the pictures


def commands_table(claims: dict) -> str:
    """The commands, with the first line of their help."""
    lines = [
        (f"`{name}`", (command.__doc__ or "").strip().partition("\n")[0].rstrip("."))
        for name, command in cli.COMMANDS.items()
    ]
    return table(("command", "what it does"), lines)


def settings_table(claims: dict) -> str:
    """All settings, with the values of the three presets."""
    values = [
        {name: str(value) for name, _, value in config.fields_of(preset)}
        for preset in config.PRESETS.values()
    ]
    lines = []
    for name in values[0]:
        stage, _, field = name.rpartition(".")
        kind = type(getattr(config.Config(), stage)) if stage else config.Config
        lines.append((f"`{name}`", *(one[name] for one in values), help_of(kind)[field]))
    return table(("setting", *config.PRESETS, "meaning"), lines)


def help_of(kind: type) -> dict[str, str]:
    """The docstring below each field of a dataclass: field -> text."""
    body = ast.parse(inspect.getsource(kind)).body[0].body
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def modules_list(claims: dict) -> str:
    """The directive that makes a page for each module, in the order of the layers."""
    lines = ["```{eval-rst}", ".. autosummary::", "   :toctree: modules", ""]
    return "\n".join([*lines, *(f"   {name}" for name in modules()), "```"])


def modules() -> list[str]:
    """All modules of the library, lower layers first, by the contract in pyproject.toml."""
    settings = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text("utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    place = {part: -height for height, one in enumerate(layers) for part in re.findall(r"\w+", one)}
    files = [file.relative_to(PACKAGE).with_suffix("") for file in PACKAGE.rglob("*.py")]
    names = [".".join(file.parts) for file in files if not file.name.startswith("__")]
    order = sorted(names, key=lambda name: (place[name.split(".")[0]], name))
    return [f"stad_lab.{name}" for name in order]


def gallery(claims: dict) -> str:
    """Some figures of the notebooks, with the alternative texts that their files hold."""
    files = [PICTURES / f"{cell}.png" for cell in CELLS]
    texts = [Image.open(file).text["Description"].replace("$", "") for file in files]
    pairs = zip(files, texts, strict=True)
    return "\n".join(f"![{text}](../notebooks/pictures/{file.name})" for file, text in pairs)


def forest(claims: dict):
    """The figure of the claim, a matplotlib Figure."""
    return plot_forest(claims["recipes"], claims["verdict"]["best_episode"])


BLOCKS: dict[str, Callable[[dict], str]] = {
    "agents": agents_table,
    "results": results_table,
    "study1": study1,
    "study3": study3,
    "representation": representation_table,
    "representation of turning": lambda claims: representation_table(claims, QUANTITIES[1:4]),
    "latents, agent": lambda claims: latents_table(claims, "agent"),
    "latents, random driver": lambda claims: latents_table(claims, "random_driver"),
    "experiments": experiments_table,
    "renderer": lambda claims: speed_table(
        claims, "renderer: frames a second on one core", "renderer"
    ),
    "loop": lambda claims: speed_table(claims, "loop: frames a second, a generation", "driver"),
    "costs": costs_table,
    "training": training_table,
    "stages": stages_table,
    "commands": commands_table,
    "settings": settings_table,
    "modules": modules_list,
    "gallery": gallery,
    "figure": lambda claims: f"![{forest(claims).get_label()}](notebooks/pictures/claims.png)",
    "figure in docs": lambda claims: BLOCKS["figure"](claims).replace("(note", "(../note"),
}
BLOCKS |= {f"card {name}": lambda claims, name=name: card(claims, name) for name in AGENTS}
BLOCKS |= {f"recipe {name}": lambda claims, name=name: recipe(name) for name in AGENTS}
BLOCKS |= {
    f"probe {name}": lambda claims, name=name: probe_card(claims, name)
    for name in ("cropped_frame", "cropped_output", "cropped_input_output")
}


def our_means(claims: dict) -> list[float]:
    """The means of the four variants with two iterations."""
    return [claims["recipes"]["two_iterations"][one]["mean"] for one in config.VARIANTS]


NUMBERS: dict[str, Callable[[dict], float]] = {
    "lowest of two iterations": lambda claims: min(our_means(claims)),
    "highest of two iterations": lambda claims: max(our_means(claims)),
    "lowest random yaw rate": lambda claims: min(random_yaw(claims)),
    "highest random yaw rate": lambda claims: max(random_yaw(claims)),
}
