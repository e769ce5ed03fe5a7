"""The tables and numbers of the pages, computed from claims.json: see renew.py."""

import ast
import inspect
import itertools
import json
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from gallery import CELLS, PICTURES
from PIL import Image

from stad_course import cli as course_cli
from stad_lab import cli, config
from stad_lab.agent import PRETRAINED
from stad_lab.evaluation.trajectories import MOTION
from stad_study import cli as study_cli
from stad_study.claims import PAPER
from stad_study.figures import (
    CAUSE,
    DRIVERS,
    SEEN,
    SOURCES,
    TURNING,
    difference_of,
    plot_cause,
    plot_cause_curves,
    plot_drivers,
    plot_learning_curves,
    plot_primary,
    plot_scores,
    plot_study,
)
from stad_study.study import STUDIES
from stad_study.study4_claims import SHARP
from stad_study.study5 import ARMS
from stad_study.study_claims import FAMILIES, FEATURES, MARGIN
from stad_study.verdict import (
    PAPER_GAIN,
    describe_cause,
    describe_ceiling,
    describe_changes,
    describe_others,
    describe_repetition,
    describe_verdict,
    name_verdict,
    out_of_reach,
)

ROOT = Path(__file__).parent.parent
AGENTS = (*config.VARIANTS, "cropped_input")
TAB_SPEED = Path(__file__).parent / "live" / "engine" / "speed.json"


def table(head: Iterable[str], lines: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    head = list(head)
    cells = [head, ["---"] * len(head), *lines]
    escaped = ([cell.replace("|", r"\|") for cell in line] for line in cells)
    return "\n".join("| " + " | ".join(line) + " |" for line in escaped)


def fixed(value: float) -> str:
    """Two decimals, and no negative zero."""
    return f"{value:z.2f}"


# The replication


def paper_table(claims: dict) -> str:
    """What the paper reports."""
    both = "frame, difference"
    sees = ("frame", both, "frame", both), ("frame", "frame", both, both)
    lines = [
        (f"`{variant}`", *seen, f"{score:.0f}")
        for (variant, score), *seen in zip(PAPER.items(), *sees, strict=True)
    ]
    return table(("variant", "V sees", "V reconstructs", "points"), lines)


def finding(claims: dict) -> str:
    """The finding of the replication, for the overview: the verdicts, and their limit."""
    study = claims["study1"]
    told = [*describe_verdict(study)[:2], describe_ceiling(study), describe_others(study)]
    return " ".join(filter(None, told))


def verdict(claims: dict) -> str:
    """The verdict of study 1, point by point, and what study 5 adds to it."""
    told, repeated = describe_verdict(claims["study1"]), claims["study5"]["comparisons"]
    told[2] += " " + describe_repetition(repeated["interaction"])
    told.insert(3, describe_changes(repeated))
    return "\n".join(f"- {sentence}" for sentence in told)


def gains(claims: dict) -> str:
    """The two primary differences in one line, for the front page."""
    study, told = claims["study1"], []
    for features in SEEN:
        one = study["comparisons"][f"{features}: input_output"]
        told.append(f"{name_verdict(one)} ({round(one['difference'])} points)")
    both, alone = told
    if out_of_reach(study, "z, h"):
        both += "; agents without it plus the paper's gain would exceed our best runs"
    return (
        "Does it help to see and reconstruct what has moved? A paper says so. We trained agents"
        " with and without it twelve times each. If the driver also sees the memory of earlier"
        f" frames, as in World Models: {both}. Without that memory: {alone}."
    )


def verdict_figure(claims: dict) -> str:
    """The two primary differences of study 1, for the overview."""
    return image("study1_primary", claims).replace("../notebooks", "notebooks")


def study1(claims: dict) -> str:
    """The forest plot of study 1, and its tests."""
    return "\n\n".join([image("study1", claims), comparisons_table(claims["study1"])])


def afterwards(claims: dict) -> str:
    """The comparisons that were computed after study 1."""
    names = {
        f"{features}: input_output less input": f"`input_output` - `input`, {seen}"
        for features, seen in SEEN.items()
    }
    lines, first = [], len(claims["study1"]["afterwards"]["interaction"]["by_seed"])
    for name, title in names.items():
        one = claims["study1"]["afterwards"][name]
        lines.append((title, difference_of(one), p_value(one["p"])))
    one, title = claims["studies1_and_6"], "`input_output` - `frame`, C sees z and h"
    title += f", {len(one['by_seed'])} seeds, {len(one['by_seed']) - first} of them of study 6"
    lines.append((title, difference_of(one), p_value(one["p"])))
    return table(("comparison", "difference (95% interval)", "p"), lines)


def cause(claims: dict) -> str:
    """Study 5: its meaning, figures and tables."""
    study = claims["study5"]
    meaning = "**" + " ".join(describe_cause(study)) + "**"
    tables = [cause_table(study), repeated_table(study, claims["study1"]), changed_table(study)]
    return "\n\n".join([meaning, image("study5", claims), *tables, image("study5_curves", claims)])


def cause_table(study: dict) -> str:
    """The comparisons of study 5; those without a p-value are not tested."""
    lines = []
    for name, title in CAUSE.items():
        if name in study["comparisons"]:
            one = study["comparisons"][name]
            low, high = one["t_interval"]
            cells = (title, difference_of(one), f"{low:.1f} to {high:.1f}")
            tests = [p_value(one[key]) for key in ("p", "holm_p") if key in one] or ["", ""]
            outcome = verdict_of(one) if "verdict" in one else "not tested"
            if outcome in ("gain", "harm") and max(map(abs, one["interval"])) < MARGIN:
                outcome += f", of fewer than {MARGIN} points"
            lines.append((*cells, *tests, outcome))
    head = ("comparison", "difference (95% interval)", "t-interval", "p", "Holm's p", "verdict")
    return table(head, lines)


def repeated_table(study: dict, first: dict) -> str:
    """The arms of part 5a, each beside the same arm of study 1."""
    lines = []
    for variant in ("frame", "input", "input_output"):
        arms = (f"{features}: {variant}" for features in SEEN)
        both = [
            (study["arms"][f"{variant}: {features}"]["mean"], first["arms"][arm]["mean"])
            for features, arm in zip(SEEN, arms, strict=True)
        ]
        lines.append((f"`{variant}`", *(f"{now:.0f} (study 1: {then:.0f})" for now, then in both)))
    return table(("mean of the seeds", *SEEN.values()), lines)


def changed_table(study: dict) -> str:
    """The means of the arms of parts 5b and 5c, below those whose C sees z as it is."""
    variants, lines = ("frame", "input_output"), []
    for sees in dict.fromkeys(["z", *(sees for _, sees in ARMS["5c"] + ARMS["5b"])]):
        arms = [study["arms"].get(f"{variant}: {sees}") for variant in variants]
        lines.append((f"C sees {sees}", *(f"{one['mean']:.0f}" if one else "" for one in arms)))
    return table(("mean of the seeds", *(f"`{variant}`" for variant in variants)), lines)


def strongest(claims: dict) -> str:
    """Study 4: how many runs are done; after the last the agent of each variant."""
    study = claims["study4"]
    if "agents" not in study:
        return f"Runs done: {study['runs']} of {study['planned']}."
    lines = []
    for variant, one in study["agents"].items():
        scores = ", ".join(f"{score:.1f}" for score in one["scores"])
        cells = (f"`{variant}`", scores, f"{one['mean']:.1f}", f"{one['minimum']:.0f}")
        unknown = "not listed" if one["failures"] else 0
        sharp = study["places"].get(variant, {}).get("at a sharp bend", unknown)
        cells += (str(one["failures"]), str(sharp), f"{study['shipped'][variant]:.1f}")
        lines.append(cells)
    head = ("variant", "three seeds", "chosen agent", "minimum", "below 800")
    told = [table((*head, f"of these at a bend of {SHARP:.0f} degrees", "shipped before"), lines)]
    reached = [f"`{variant}`" for variant, one in study["agents"].items() if one["reached"]]
    outcome = "replaced, all together" if study["replaced"] else "kept"
    told.append(
        f"The goal is reached by {', '.join(reached) or 'none'}. The four agents that were shipped"
        f" before are {outcome}."
    )
    if study["places"]:
        told.append(what_follows(study["places"]))
    return "\n\n".join(told)


def what_follows(places: dict[str, dict]) -> str:
    """What the agents of study 4 do in their failures."""
    counts: Counter[str] = sum((Counter(one["then"]) for one in places.values()), Counter())
    told = ", ".join(f"{what} ({count})" for what, count in counts.most_common())
    return f"After its mistake the car {told}."


def outcomes(claims: dict) -> str:
    """The secondary outcomes of study 1, the score of every pipeline, and the learning curves."""
    figures = [image(name, claims) for name in ("study1_scores", "study1_curves")]
    return "\n\n".join([outcomes_table(claims["study1"]), *figures])


def comparisons_table(study: dict) -> str:
    """The tests of study 1."""
    lines = []
    for family, variants in FAMILIES.items():
        for features, variant in itertools.product(SEEN, variants):
            one = study["comparisons"][f"{features}: {variant}"]
            low, high = one["t_interval"]
            cells = (family, f"`{variant}`, {SEEN[features]}", difference_of(one))
            cells += (f"{low:.1f} to {high:.1f}", f"{one['deviation']:.0f}")
            tests = (p_value(one[key]) for key in ("p", "holm_p"))
            lines.append((*cells, *tests, verdict_of(one)))
    head = ("test", "variant minus `frame`", "difference (95% interval)", "t-interval")
    return table((*head, "SD of pairs", "p", "Holm's p", "verdict"), lines)


def verdict_of(one: dict) -> str:
    """The verdict of a comparison; of an undecided one with the seeds that would decide."""
    undecided = one["verdict"] == "undecided"
    return one["verdict"] + (f" ({one['seeds_that_decide']} seeds)" if undecided else "")


def p_value(p: float) -> str:
    """Three decimals, or that it is smaller."""
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def outcomes_table(study: dict) -> str:
    """The secondary outcomes of the arms of study 1."""
    lines = []
    for features, variant in itertools.product(SEEN, config.VARIANTS):
        one = study["arms"][f"{features}: {variant}"]
        points = ("mean", "interquartile_mean", "tenth_percentile", "minimum", "area")
        mean, *scores = [f"{one[key]:.0f}" for key in points]
        lead = "" if variant == "frame" else area_of(study, features, variant)
        name = f"`{variant}`, {SEEN[features]}"
        lines.append((name, mean, f"{one['below_800']:.1%}", *scores, lead))
    head = ("arm", "mean", "below 800", "interquartile mean", "10th percentile", "minimum")
    return table((*head, "area", "area minus that of `frame`"), lines)


def area_of(study: dict, features: str, variant: str) -> str:
    """The difference of the areas under the learning curves to `frame`, with its interval."""
    one = study["comparisons"][f"{features}: {variant}"]
    return difference_of({"difference": one["area_difference"], "interval": one["area_interval"]})


def study3(claims: dict, driver: str) -> str:
    """R2 from z, and from z and h, with one driver: means over the seeds."""
    found, lines, widest = claims["study3"], [], 0.0
    names = [name for name in found if name.startswith(f"{driver}: ")]
    for features, name in itertools.product(FEATURES, names):
        ones = [found[name][features][quantity] for quantity in MOTION]
        widest = max([widest, *(high - low for low, high in (one["interval"] for one in ones))])
        cells = [fixed(one["mean"]) for one in ones]
        lines.append([network(name.partition(": ")[2]), SOURCES[features], *cells])
    told = f"The 95% intervals over the seeds are at most {widest:.2f} wide."
    return table(("V", "from", *MOTION), lines) + f"\n\n{told}"


def turning_table(claims: dict) -> str:
    """R2 from z of what a single frame does not show, and of the yaw rate with both drivers."""
    lines = []
    for name in (*config.VARIANTS, "input_output, untrained"):
        agent, random = (claims["study3"][f"{one}: {name}"]["z"] for one in DRIVERS)
        cells = [r2_cell(agent[quantity]) for quantity in TURNING]
        lines.append([network(name), *cells, r2_cell(random["yaw rate"])])
    return table(("V", *TURNING, "yaw rate, random driver"), lines)


def network(name: str) -> str:
    """The name of a V in Markdown: only its variant is code."""
    variant, *rest = name.split(", ")
    return ", ".join([f"`{variant}`", *rest])


def r2_cell(one: dict) -> str:
    """The mean of R2 with its interval."""
    low, high = (fixed(bound) for bound in one["interval"])
    return f"{fixed(one['mean'])} ({low} to {high})"


FIGURES: dict[str, Callable] = {  # name of the file -> what draws it from claims.json
    "study1": lambda claims: plot_study(claims["study1"]["comparisons"], MARGIN, PAPER_GAIN),
    "study1_scores": lambda claims: plot_scores(claims["study1"]["arms"]),
    "study1_curves": lambda claims: plot_learning_curves(claims["study1"]["curve_differences"]),
    "study1_primary": lambda claims: plot_primary(claims["study1"]["comparisons"], MARGIN),
    "study3": lambda claims: plot_drivers(claims["study3"]),
    "study5": lambda claims: plot_cause(claims["study5"]["comparisons"], MARGIN),
    "study5_curves": lambda claims: plot_cause_curves(
        claims["study5"]["arms"], config.PRESETS["laptop"].evolution.validate_every
    ),
}


def image(name: str, claims: dict) -> str:
    """A figure in Markdown, for a page in docs."""
    return f"![{FIGURES[name](claims).get_label()}](../notebooks/pictures/{name}.png)"


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


def r2(claims: dict, driver: str, world_model: str, features: str) -> dict[str, float]:
    """R2 of the probe: quantity -> value."""
    return claims["probe"][f"{driver}: {world_model}"][features]


def bar_table(claims: dict) -> str:
    """R2 of one training of each variant with the indicator bar, while the agent drives."""
    lines = []
    for variant in config.VARIANTS:
        alone, both = (r2(claims, "agent", f"{variant}-0", features) for features in FEATURES)
        cells = [f"{fixed(alone[one])} ({fixed(both[one])})" for one in MOTION]
        lines.append((f"`{variant}`", *cells))
    return table(("V", *MOTION), lines)


# The agents


def agents_table(claims: dict) -> str:
    """The shipped agents, one line each."""
    head = ("agent", "mean", "minimum", "10th percentile", "below 800")
    lines = []
    for name in AGENTS:
        one = claims["agents"][name]
        scores = [f"{one[key]:.1f}" for key in ("mean", "minimum", "tenth_percentile")]
        card = f"[`{name}`](stad_lab/pretrained/{name}/README.md)"
        lines.append((card, *scores, f"{one['below_800']:.0%}"))
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


def front_matter(claims: dict, name: str) -> str:
    """A card's metadata in the form of model hubs: YAML, with the recorded scores of an agent."""
    tags = ("reinforcement-learning", "world-models", "vae", "mdn-rnn", "cma-es", "CarRacing-v3")
    lines = ["license: mit", "library_name: stad_lab", "tags:", *(f"  - {tag}" for tag in tags)]
    if one := claims["agents"].get(name):
        scores = {
            "mean_reward": f"{one['mean']:.2f} +/- {one['standard_deviation']:.2f}",
            "minimum_reward": f"{one['minimum']:.2f}",
            "tenth_percentile_reward": f"{one['tenth_percentile']:.2f}",
        }
        lines += [
            "pipeline_tag: reinforcement-learning", "model-index:", f"  - name: {name}",
            "    results:", "      - task:", "          type: reinforcement-learning",
            "        dataset:", "          type: CarRacing-v3",
            "          name: CarRacing-v3, tracks 0 to 99", "        metrics:",
        ]  # fmt: skip
        for kind, value in scores.items():
            lines += [f"          - type: {kind}", f"            value: {value}"]
    return "\n".join(["---", *lines, "---", "", ""])


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
    for driver, title in (("agent", "agent `cropped_input`"), ("random_driver", "random driver")):
        for features in ("z", "z, h"):
            found = r2(claims, driver, f"{name}-0", features)
            lines.append((title, features, *(f"{fixed(found[one])}" for one in MOTION)))
    return table(("driver", "features", *MOTION), lines)


# Speed


def speed_table(claims: dict, key: str, head: str) -> str:
    """One comparison of the benchmark, slowest first; with the ratio to EnvPool if it took part."""
    found = sorted(claims["speed"][key].items(), key=lambda one: one[1]["median"])
    pool = max((one["median"] for name, one in found if name.startswith("EnvPool")), default=None)
    lines = [
        (name, f"{one['median']:,.0f}", times(one["ratio"]))
        + ((times(one["median"] / pool),) if pool else ())
        for name, one in found
    ]
    heads = (head, "frames a second", "times the first row")
    heads += ("times the faster EnvPool",) if pool else ()
    return table(heads, lines)


def times(ratio: float) -> str:
    """A ratio of speeds, which rounds measure to some percent."""
    return f"{ratio:.1f}" if ratio < 10 else f"{ratio:,.0f}"


def tab_table(claims: dict) -> str:
    """The engine in a browser tab, from the record of docs/live/record_tab.py."""
    record = json.loads(TAB_SPEED.read_text(encoding="utf-8"))
    lines = [(driver, f"{speed:,.0f}") for driver, speed in record["median"].items()]
    return table((f"in a tab ({record['browser'].split('.')[0]})", "frames a second"), lines)


def costs_table(claims: dict) -> str:
    """The time of one frame with 16 cars, part by part."""
    costs = claims["speed"]["loop: microseconds of a frame, 16 cars in one process"]
    lines = sorted(costs.items(), key=lambda one: (one[0] == "together", -one[1]))
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
    parts = []
    for program in (cli.PROGRAM, course_cli.PROGRAM, study_cli.PROGRAM):
        lines = [
            (f"`{name}`", (command.__doc__ or "").strip().partition("\n")[0].rstrip("."))
            for name, command in program.commands.items()
        ]
        parts += [table((f"`{program.name}`", "what it does"), lines)]
    return "\n\n".join(parts)


def faster_recipe(claims: dict) -> str:
    """What study 6 says of the preset `fast`."""
    found = claims["study6"]
    outcome = "ruled out" if found["not_worse"] else "not ruled out"
    pairs, seeds = len(found["scores"]["study6_fast"]), len(STUDIES["study6_fast"].seeds)
    return (
        "With V and M trained on one core, a run took"
        f" {found['minutes']['study6_fast']:.0f} minutes with `fast` and"
        f" {found['minutes']['study6_laptop']:.0f} with `laptop` (medians)."
        f" The mean difference of their scores, `fast` minus `laptop`, is"
        f" {found['difference']:+.1f} points over {pairs} pairs; a loss of {MARGIN} points or more"
        f" is {outcome}."
        f" ([Study 6](protocol.md#study-6-a-faster-recipe): the one-sided 95% bound is"
        f" {found['lower_bound']:+.1f}, from the means of {seeds} seeds"
        f" {found['lower_bound_of_seeds']:+.1f}; standard deviation {found['deviation']:.0f};"
        " `frame` and `input_output`, z and h.)"
    )


def settings_table(claims: dict) -> str:
    """All settings, with the values of the presets."""
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
    """All modules: the library's, lower layers first as in pyproject.toml, and those beside it."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    place = {part: -height for height, one in enumerate(layers) for part in re.findall(r"\w+", one)}
    library = sorted(modules_of("stad_lab"), key=lambda name: place[name.split(".")[1]])
    return [*library, *modules_of("stad_course"), *modules_of("stad_study")]


def modules_of(package: str) -> list[str]:
    """The modules of a package, by their whole names."""
    files = [file for file in (ROOT / package).rglob("*.py") if not file.name.startswith("__")]
    return sorted(".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files)


def gallery(claims: dict) -> str:
    """Some figures of the notebooks, with the alternative texts that their files hold."""
    shown = []
    for cell, words in CELLS.items():
        file = PICTURES / f"{cell}.png"
        text = Image.open(file).text["Description"].replace("$", "")
        (notebook,) = (PICTURES.parent).glob(f"{cell.partition('-')[0]}_*.ipynb")
        caption = f"[{words}](../notebooks/{notebook.name})"
        picture = f"![{text}](../notebooks/pictures/{file.name})"
        shown.append(f"```{{container}} shown\n{picture}\n\n{caption}\n```")
    return "\n\n".join(["````{container} gallery", *shown, "````"])


BLOCKS: dict[str, Callable[[dict], str]] = {
    "agents": agents_table,
    "paper": paper_table,
    "finding": finding,
    "verdict": verdict,
    "gains": gains,
    "verdict's figure": verdict_figure,
    "study1": study1,
    "afterwards": afterwards,
    "outcomes": outcomes,
    "cause": cause,
    "strongest": strongest,
    "faster recipe": faster_recipe,
    "turning": turning_table,
    "study3, agent": lambda claims: study3(claims, "agent"),
    "study3, random driver": lambda claims: study3(claims, "random_driver"),
    "study3, figure": lambda claims: image("study3", claims),
    "indicator bar": bar_table,
    "experiments": experiments_table,
    "renderer": lambda claims: speed_table(
        claims, "renderer: frames a second on one core", "renderer"
    ),
    "tab": tab_table,
    "loop": lambda claims: speed_table(claims, "loop: frames a second, a generation", "driver"),
    "costs": costs_table,
    "training": training_table,
    "stages": stages_table,
    "commands": commands_table,
    "settings": settings_table,
    "modules": modules_list,
    "gallery": gallery,
}
BLOCKS |= {f"card {name}": lambda claims, name=name: card(claims, name) for name in AGENTS}
BLOCKS |= {f"recipe {name}": lambda claims, name=name: recipe(name) for name in AGENTS}
BLOCKS |= {
    f"probe {name}": lambda claims, name=name: probe_card(claims, name)
    for name in ("cropped_frame", "cropped_output", "cropped_input_output")
}


def stays(study: dict, features: str) -> int:
    """How many seeds of study 1 can be left out, each alone, without another primary verdict."""
    verdict = study["comparisons"][f"{features}: input_output"]["verdict"]
    return study["verdicts_without_a_seed"][features].count(verdict)


NUMBERS: dict[str, Callable[[dict], float]] = {
    "trained networks": lambda claims: sum(claims["study1"]["trained_on"].values()),
    "networks of a GPU": lambda claims: sum(
        count for name, count in claims["study1"]["trained_on"].items() if name != "cpu"
    ),
    "probed networks": lambda claims: claims["study3"]["networks"],
    "verdicts that stay": lambda claims: stays(claims["study1"], "z, h"),
    "diagnostic verdicts that stay": lambda claims: stays(claims["study1"], "z"),
}
