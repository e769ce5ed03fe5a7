"""The replication: every row of the table, made by one command, and what the rows say.

A row is a variant, a recipe and some seeds. `replicate` trains V and M once, searches for C once for each seed, and
drives every C found on the official tracks. In the folder of a row::

    first/      in a recipe of two rounds: the whole first run
    world/      rollouts, V and M
    seed0/ ...  V, M and C of one search, with its log, record.json and evaluation.json

A row of finishes has neither a first round nor a world, because it goes on from the seeds of another row. In a
`retrained` row every seed is a whole run, with a V and an M of its own. The rows of FLOORS are drivers that do not look
at the road. Whatever is there already is not done again. The records that we report lie in `stad_lab/records/table`.
"""

import dataclasses
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from stad_lab.autoencoder import VARIANTS, AutoEncoder, load_autoencoder, save_autoencoder
from stad_lab.benchmark import train_m, train_v
from stad_lab.car_racing import make_env
from stad_lab.checkpoints import copy_file, load_json, save_json
from stad_lab.controller import initial_parameters, squash
from stad_lab.evaluation import SOLVED, evaluate, report
from stad_lab.evaluation import summarise as summarise_episodes
from stad_lab.evolution import CONTROLLER, LOG, drive_generation
from stad_lab.finish import FINISH, finish
from stad_lab.mdn_rnn import MDNRNN, save_mdn_rnn
from stad_lab.parallel import run_tasks, worker_processes
from stad_lab.pipeline import provenance, total_budget, train
from stad_lab.rollouts import RandomDriver, collect_rollouts
from stad_lab.search_space import COMPONENTS, START
from stad_lab.settings import Settings, check_same_run

RECORDS = Path(__file__).parent / "records" / "table"
KEPT = ("record.json", LOG, "evaluation.json", CONTROLLER)  # of every run, as far as it has them
FLOORS = {  # rows of drivers that do not look at the road
    "random_driver": "smooth random steering and gas, as for the rollouts",
    "gentle_driver": "straight on with little gas, as the first agent that evolution tries",
}
# World Models' own log, in generations of 64 agents with 16 episodes each: episodes -> score.
WORLD_MODELS = {25 * 64 * 16: 823.0, 50 * 64 * 16: 867.0, 200 * 64 * 16: 880.0, 1800 * 64 * 16: 900.5}
PAPER = {"frame": 827.0, "input": 905.0, "output": 906.0, "input_output": 902.0}  # its table, on CarRacing-v0
TRACKS = 100  # official tracks, those of the seeds 0 to 99, on which every C is reported
EARLY = (0, 1, 2, 3, 4)  # seeds of the rows whose runs are short, and whose scores scatter the most
TOP = 90  # the paper also quotes the mean of the best 90 of its 100 episodes
RESAMPLES = 10_000


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    variant: str
    about: str
    """What is special about it, for the reader."""
    settings: Settings
    """Of the only round, of the second, or of the finish."""
    first: Settings | None = None
    """Of the first round, in a recipe of two."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the searches for C. V and M, and a first round, are made once."""
    world: str | None = None
    """Name of the row whose rollouts, V and M it shares; None for its own."""
    base: str | None = None
    """Name of the row whose searches it goes on from, seed by seed, with a finish."""
    retrained: bool = False
    """Whether each seed is a whole run, with rollouts, V and M of its own."""

    def settings_of(self, seed: int) -> Settings:
        """The settings of one of its seeds."""
        return dataclasses.replace(
            self.settings, evolution_seed=seed, seed=seed if self.retrained else self.settings.seed
        )


def make_rows() -> dict[str, Row]:
    """All rows of the table by name."""
    rows = {}
    for variant in VARIANTS:
        rows[f"paper_{variant}"] = Row(variant, "the paper's recipe", Settings.preset("paper"))
    # 900 + 55 x 64 + 11 x 16: 4,596 episodes.
    one = Settings.preset("laptop", crop_bar=False)
    # 900 + 15 x 64 + 3 x 16 episodes in the first round, 110 + 40 x 64 + 8 x 16 in the second: 4,706 in all.
    first = dataclasses.replace(one, generations=15)
    second = dataclasses.replace(first, agent_episodes=110, generations=40, sigma=0.05, revisited_share=0.5)
    for variant in VARIANTS:
        rows[f"two_rounds_{variant}"] = Row(variant, "our recipe", second, first)
    # Before the ceiling: 900 + 15 x 64 + 3 x 16 = 1,908 episodes.
    for variant in VARIANTS:
        rows[f"early_{variant}"] = Row(variant, "the first round of our recipe", first, seeds=EARLY, retrained=True)
    # 15 x 256 + 3 x 16 episodes more, and 480 agents: 8,594 episodes and 4,000 agents in all.
    finished = dataclasses.replace(second, **FINISH)
    for variant in VARIANTS:
        base = f"two_rounds_{variant}"
        rows[f"finished_{variant}"] = Row(variant, "our recipe and a finish", finished, base=base)
    longer = dataclasses.replace(second, generations=160, sigma_decay=0.99)
    rows["long_input"] = Row("input", "our recipe, four times as long", longer, first, (0,), "two_rounds_input")
    never_back = dataclasses.replace(second, revisited_share=0.0)
    rows["two_rounds_new_tracks"] = Row("input", "our recipe, new tracks alone", never_back, first, seeds=(0,))
    before = [dataclasses.replace(settings, **BEFORE) for settings in (second, first)]
    rows["two_rounds_few_agents"] = Row("input", "our recipe before it was improved", *before, seeds=(0,))
    rows["one_round"] = Row("input", "one round", one)
    for name, (about, changes, shares) in ABLATIONS.items():
        settings, world = dataclasses.replace(one, **changes), "one_round" if shares else None
        rows[name] = Row("input", about, settings, seeds=(0,), world=world)
    about = f"{rows['no_bar'].about}, and no difference images"
    rows["no_bar_frame"] = dataclasses.replace(rows["no_bar"], variant="frame", about=about)
    return rows


# Our recipe before it was improved.
BEFORE = {
    "population": 16,
    "tracks": 4,
    "revisited_share": 0.0,
    "components": 0,
    "sigma_decay": 0.0,
    "crop_bar": True,
}
# Name -> what it is, the change of the "one_round" recipe, and whether V is the same.
ABLATIONS = {
    "no_M": ("one round, C sees z alone", {"features": "z"}, True),
    "no_z": ("one round, C sees h alone", {"features": "h"}, True),
    "untrained_M": ("one round, M's weights are random", {"m_steps": 0}, True),
    "few_agents": ("one round, 16 agents on 4 tracks each", {"population": 16, "tracks": 4}, True),
    "last_mean": ("one round, the last CMA mean alone", {"averaged_share": 0.0}, True),
    "every_weight": ("one round, every weight of C searched", {"components": 0}, True),
    "own_sigma": ("one round, CMA-ES's own step size", {"sigma_decay": 0.0}, True),
    "no_bar": ("one round, the indicator bar cut off: the laptop settings", {"crop_bar": True}, False),
    **{f"stride_{k}": (f"one round, stride {k}", {"stride": k}, False) for k in (1, 2, 8)},
    **{f"latent_{n}": (f"one round, {n} latents", {"latent_size": n}, False) for n in (16, 64)},
}
ROWS = make_rows()


def replicate(
    name: str, folder: str | Path, executor: Executor | None = None, seeds: Sequence[int] | None = None
) -> dict:
    """Make one row of the table, or what is missing of it; run it again after an interrupt to go on.

    Args:
        name: one of ROWS or FLOORS.
        folder: of all rows; this one goes into `folder/name`.
        executor: who drives; None for processes of this machine.
        seeds: some of the row's seeds; None for all. A floor has none.

    Returns:
        What `summarise` makes of these seeds.

    Raises:
        ValueError: an unknown row or seed, or a folder with something else in it.
        OSError, TaskError, FloatingPointError: as `train` and `evaluate`.
    """
    if name in FLOORS:
        return drive_floor(name, Path(folder) / name / "seed0", executor)
    row, folder = find_row(name, seeds), Path(folder)
    folders = {seed: folder / name / f"seed{seed}" for seed in row.seeds}
    if row.base:
        finish_row(row, folder, folders, executor)
    elif row.retrained:
        for seed, own in folders.items():
            evaluate_row(row, own, train(row.variant, row.settings_of(seed), own, executor=executor), executor)
    else:
        first, world = make_world(ROWS[row.world] if row.world else row, folder / (row.world or name), executor)
        for seed, own in folders.items():
            search(row, seed, own, first, world, executor)
    return summarise(list(folders.values()))


def find_row(name: str, seeds: Sequence[int] | None = None) -> Row:
    """The row of a name, if wanted with some of its seeds alone. Raises ValueError if there is no such row or seed."""
    if name not in ROWS:
        raise ValueError(f"unknown row {name!r}: choose one of {', '.join([*ROWS, *FLOORS])}")
    row = ROWS[name]
    for seed in seeds or ():
        if seed not in row.seeds:
            raise ValueError(f"row {name!r} has no seed {seed}: choose of {', '.join(map(str, row.seeds))}")
    return dataclasses.replace(row, seeds=tuple(seeds)) if seeds else row


def drive_floor(name: str, folder: Path, executor: Executor | None) -> dict:
    """Drive the official tracks without looking, and write `evaluation.json` and a record."""
    if not (folder / "evaluation.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        begin, tracks = time.perf_counter(), list(range(TRACKS))
        with worker_processes(Settings().processes, executor) as executor:
            tasks = [(name, track) for track in tracks]
            found = dict(tqdm(run_tasks(executor, drive_blindly, tasks), name, TRACKS, unit="episode"))
        returns, frames = (np.array(part) for part in zip(*(found[track] for track in tracks), strict=True))
        told = {"variant": name, "renderer": "none: it does not look"} | report(tracks, returns, frames)
        record = {"variant": name, "made_with": provenance(f"python -m stad_lab replicate --row {name} --out ...")}
        save_json(folder / "record.json", record | {"budget": {}})
        save_json(folder / "evaluation.json", told | {"seconds": time.perf_counter() - begin})
    return summarise([folder])


def drive_blindly(name: str, track: int) -> tuple[float, int]:
    """Drive an official track as a row of FLOORS: (return, frames). Runs in a worker process.

    Rewards do not depend on the renderer, so the fast one serves.
    """
    driver, gentle = (
        RandomDriver(np.random.default_rng([0, track])),
        squash(np.array([0.0, Settings().initial_gas, 0.0])),
    )
    env = make_env(fast=True)
    env.reset(seed=track)
    total, frames, ended = 0.0, 0, False
    while not ended:
        action = driver.act() if name == "random_driver" else gentle
        _, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
        total, frames, ended = total + reward, frames + 1, terminated or truncated
    env.close()
    return total, frames


def finish_row(row: Row, folder: Path, folders: dict[int, Path], executor: Executor | None) -> None:
    """Make the finishes of a row, seed -> folder, and those seeds of its base that are not there."""
    for seed, own in folders.items():
        base = folder / row.base / own.name
        if not (base / "evaluation.json").exists():
            replicate(row.base, folder, executor, [seed])
        searches = [one.settings_of(seed) for one in (ROWS[row.base], row)]
        check_same_run(base, load_json(base / "record.json")["settings"], searches[0].as_dict())
        worked = finish(row.variant, searches[1], base, own, executor)
        evaluate_row(row, own, worked, executor)


def make_world(row: Row, folder: Path, executor: Executor | None) -> tuple[Path | None, Path]:
    """Make a row's rollouts, V and M, and before them its first round: the folders of both."""
    first, world = folder / "first" if row.first else None, folder / "world"
    if row.first:
        train(row.variant, row.first, first, executor=executor)
    train(row.variant, row.settings, world, until="mdn_rnn", executor=executor, earlier=first)
    return first, world


def search(row: Row, seed: int, folder: Path, first: Path | None, world: Path, executor: Executor | None) -> None:
    """Search for C with one seed, and drive what was found on the official tracks.

    Where a search begins, and along which components, depends on the world alone: the first seed finds it for all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    trained = ("autoencoder", "mdn_rnn") if row.settings.m_steps else ("autoencoder",)
    made = [world / f"{part}.safetensors" for part in trained]
    made += [path for part in (COMPONENTS, START) for path in folder.parent.glob(f"seed*/{part}")]
    for source in made:
        if not (folder / source.name).exists():
            copy_file(source, folder)
    worked = train(row.variant, row.settings_of(seed), folder, world / "rollouts", executor=executor, earlier=first)
    evaluate_row(row, folder, worked, executor)


def evaluate_row(row: Row, folder: Path, worked: bool, executor: Executor | None) -> None:
    """Drive what a search found on the official tracks, and write `evaluation.json`, if it is new or was not driven."""
    if worked or not (folder / "evaluation.json").exists():
        save_json(folder / "evaluation.json", evaluate(row.variant, folder, TRACKS, executor=executor))


def keep(name: str, folder: str | Path, target: Path = RECORDS) -> list[Path]:
    """Copy the records of a row's finished seeds to where the notebooks look for them; returns their new folders.

    With them go the records of the first round and of the world, if the row has its own. Seeds that are made elsewhere,
    in a folder without seed 0, may have V and M from another training by the same settings. If so, the records of that
    one go to `first_of_seed1` and `world_of_seed1`, by the first of these seeds; if not, they are there already.
    """
    kept = []
    for seed in (0,) if name in FLOORS else find_row(name).seeds:
        source = Path(folder) / name / f"seed{seed}"
        if (source / "evaluation.json").exists():
            kept.append(target / name / source.name)
            copy_records(source, kept[-1])
    with_seed_0 = bool(kept) and kept[0].name == "seed0"
    known = worlds(kept) <= worlds([path for path in (target / name).glob("seed*") if path not in kept])
    for part in ("first", "world"):
        if (Path(folder) / name / part).exists() and (with_seed_0 or not known):
            own = part if with_seed_0 else f"{part}_of_{kept[0].name}"
            copy_records(Path(folder) / name / part, target / name / own)
    return kept


def copy_records(source: Path, target: Path) -> None:
    """Copy a run's records, as far as it has them."""
    target.mkdir(parents=True, exist_ok=True)
    for file in KEPT:
        if (source / file).exists():
            copy_file(source / file, target)


def kept_rows(records: Path = RECORDS) -> dict[str, list[Path]]:
    """The rows that have been made: name -> folders of its seeds, in the order of FLOORS and ROWS."""
    found = {name: sorted((records / name).glob("seed*")) for name in [*FLOORS, *ROWS]}
    return {name: folders for name, folders in found.items() if folders}


def stage_times(row: Path) -> dict[str, float]:
    """How long the stages of a row took, from nothing to the evaluated agent of seed 0, in seconds.

    Args:
        row: folder of a row that has a world of its own. The stages of a first round count too.

    Returns:
        "rollouts", "autoencoder", "mdn_rnn", "controller" and "evaluation" -> seconds.
    """
    times: Counter[str] = Counter()
    for part in ("first", "world", "seed0") if (row / "first").exists() else ("world", "seed0"):
        times.update(load_json(row / part / "record.json")["seconds"])
    return dict(times) | {"evaluation": load_json(row / "seed0" / "evaluation.json")["seconds"]}


def lost_points(folders: list[Path]) -> dict[str, float]:
    """Where the points up to 1,000 went, mean of all episodes: 1,000 less the sum of the parts is the mean return.

    Returns:
        "speed": 0.1 for each frame of a lap, had every episode been a complete lap at the mean time of those that were.
        "waiting": 0.1 for each frame more. A lap ends when all tiles are visited, so that one missed tile prolongs the
        episode to its last frame; only leaving the field shortens it. "tiles": those not visited, and the 100 points
        for leaving the field.
    """
    episodes = [episode for folder in folders for episode in load_json(folder / "evaluation.json")["episodes"]]
    returns, frames = (np.array([episode[name] for episode in episodes]) for name in ("return", "frames"))
    laps = frames[returns >= SOLVED]  # 1,000 frames at most, so 900 points at least; and with a tile missing, fewer
    speed = laps.mean() if len(laps) else frames.mean()
    return {
        "speed": float(0.1 * speed),
        "waiting": float(0.1 * (frames.mean() - speed)),
        "tiles": float((1000 - returns - 0.1 * frames).mean()),
    }


def learning_curve(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The scores on the validation tracks of one seed, and how many episodes had been driven for each: two (looks,).

    All episodes count: the random driver's, those of a first round and of its agent, and the validation itself.
    """
    log, record = load_json(folder / LOG)["generations"], load_json(folder / "record.json")
    own = sum(record["budget"][part]["episodes"] for part in ("evolution", "validation"))
    driven, episodes, scores = total_budget(record)["episodes"] - own, [], []
    for entry in log:
        driven += sum(len(returns) for returns in entry["returns"])
        if "validation" in entry:
            driven += len(entry["validation"]["returns"])
            episodes.append(driven)
            scores.append(entry["validation"]["mean"])
    return np.array(episodes), np.array(scores)


def summarise(folders: list[Path]) -> dict:
    """What the table shows of a row, from the folders of its seeds.

    Returns:
        "mean", "standard_deviation" (over all episodes), "interval" (95%, of the mean, over seeds and tracks), "seeds"
        (the mean of each), "worlds" (how many trainings of V and M are behind them), "above_900" (share of episodes),
        "top_90" (mean of each seed's best 90 episodes), and the budget of one seed: "agents", "episodes", "frames"
        (means over the seeds), with all that was driven before it.
    """
    returns = official_returns(folders)
    budgets = [total_budget(load_json(folder / "record.json")) for folder in folders]
    return {
        **summarise_episodes(returns.ravel()),
        "interval": bootstrap(returns),
        "seeds": returns.mean(axis=1).tolist(),
        "worlds": len(worlds(folders)),
        "top_90": float(np.sort(returns, axis=1)[:, -TOP:].mean()),
        **{unit: float(np.mean([spent[unit] for spent in budgets])) for unit in ("agents", "episodes", "frames")},
    }


def worlds(folders: list[Path]) -> set[tuple[str, str]]:
    """The identities of the V's and M's that the searches in some folders had; none of a driver of FLOORS."""
    logs = [load_json(folder / LOG) for folder in folders if (folder / LOG).exists()]
    return {(log["autoencoder"], log["mdn_rnn"]) for log in logs}


def official_returns(folders: list[Path]) -> np.ndarray:
    """The returns of a row's seeds on the official tracks, float64 (seeds, tracks), from their folders."""
    evaluations = [load_json(folder / "evaluation.json", "evaluate again") for folder in folders]
    return np.array([[episode["return"] for episode in found["episodes"]] for found in evaluations])


def bootstrap(returns: np.ndarray, resamples: int = RESAMPLES) -> list[float]:
    """95% interval of the mean of returns (seeds, tracks), by a bootstrap of the seeds and of the tracks.

    All seeds drive the same tracks, so a track is drawn for all of them together. From three seeds the
    interval may be too narrow (notebook 05, step 7). Agarwal et al., 2021, argue for bootstraps where runs are few.
    """
    means = resampled_means(returns, *draw_tracks(returns, resamples))
    return [float(bound) for bound in np.percentile(means, [2.5, 97.5])]


def bootstrap_gain(before: np.ndarray, after: np.ndarray, resamples: int = RESAMPLES) -> list[float]:
    """95% interval of the mean of `after` less the mean of `before`, both returns (seeds, tracks) on the same tracks.

    Seeds are drawn anew for each of the two, tracks once for both: a long track costs both of them time. Of a row with
    one seed the luck of its search is left out, so that the interval is too narrow.
    """
    rng, tracks = draw_tracks(before, resamples)
    gains = resampled_means(after, rng, tracks) - resampled_means(before, rng, tracks)
    return [float(bound) for bound in np.percentile(gains, [2.5, 97.5])]


def draw_tracks(returns: np.ndarray, resamples: int) -> tuple[np.random.Generator, np.ndarray]:
    """The Generator of a bootstrap, and the tracks of each resample, int (resamples, 1, tracks)."""
    rng, tracks = np.random.default_rng(0), returns.shape[1]
    return rng, rng.integers(tracks, size=(resamples, 1, tracks))


def resampled_means(returns: np.ndarray, rng: np.random.Generator, tracks: np.ndarray) -> np.ndarray:
    """The mean return of each resample, float64 (resamples,), with seeds drawn here."""
    seeds = rng.integers(len(returns), size=(len(tracks), len(returns), 1))
    return returns[seeds, tracks].mean(axis=(1, 2))


def forecast(name: str, seeds: Sequence[int] | None = None) -> dict[str, float]:
    """How long a row, or some of its seeds, takes on this machine, in seconds: what it is for -> time.

    Measures for about half a minute.

    An agent's episode is taken to have as many frames as it may have at most, so the searches may be quicker.
    """
    if name in FLOORS:
        return {"evaluations": TRACKS * 1000 / (Settings().processes * blind_speed(name))}
    row = find_row(name, seeds)
    if row.base:
        times, before = forecast(row.base, row.seeds), ROWS[row.base].settings
        longer = most_frames(row.settings) / most_frames(before)
        return times | {"finishes": times["searches"] * longer, "evaluations": 2 * times["evaluations"]}
    with tempfile.TemporaryDirectory() as folder:
        speed = speeds(row, Path(folder))
    runs = len(row.seeds) if row.retrained else 1
    rounds = [row.first, row.settings] if row.first else [row.settings] * runs
    return {
        "rollouts": sum(s.episodes * s.episode_frames + s.agent_episodes * s.max_frames for s in rounds)
        / speed["V, M, C"],
        "V": sum(s.v_steps * s.v_batch for s in rounds) / speed["V"],
        "M": sum(s.m_steps * s.m_batch * s.m_sequence for s in rounds) / speed["M"],
        "first search": most_frames(row.first) / speed["V, M, C"] if row.first else 0.0,
        "searches": len(row.seeds) * most_frames(row.settings) / speed["V, M, C"],
        "evaluations": len(row.seeds) * TRACKS * 1000 / speed["official"],
    }


def most_frames(settings: Settings) -> int:
    """How many frames a search for C drives at most, with its looks at the validation tracks."""
    looks = settings.generations // settings.validate_every * settings.validation_tracks
    return (settings.generations * settings.population * settings.tracks + looks) * settings.max_frames


def speeds(row: Row, folder: Path) -> dict[str, float]:
    """What this machine does in a second: frames driven with V, M and C, images of V, frames of M, official frames."""
    settings, length = row.settings, 60
    collect_rollouts(Settings.preset("quick"), folder / "rollouts")
    mdn_rnn = MDNRNN(settings.latent_size, settings.hidden_size, settings.mixtures)
    autoencoder = AutoEncoder(row.variant, settings.latent_size, settings.width)
    save_autoencoder(folder / "autoencoder.safetensors", autoencoder, settings, [])
    v_identity = load_autoencoder(folder / "autoencoder.safetensors")[1]["identity"]
    save_mdn_rnn(folder / "mdn_rnn.safetensors", mdn_rnn, row.variant, [], v_identity)
    brief = dataclasses.replace(settings, max_frames=length)
    start = initial_parameters(settings.latent_size, settings.hidden_size, settings.initial_gas)
    with worker_processes(settings.processes) as executor:
        for _ in range(2):  # the first time workers start
            begin = time.perf_counter()
            entry = drive_generation(executor, folder, row.variant, brief, [], np.tile(start, (settings.population, 1)))
            driven = entry["frames"] / (time.perf_counter() - begin)
    env = make_env(fast=False)
    env.reset(seed=0)
    begin = time.perf_counter()
    for _ in range(length):
        env.step(np.array([0.0, 0.1, 0.0], np.float32))
    official = length / (time.perf_counter() - begin)
    env.close()
    return {
        "V, M, C": driven,
        "official": settings.processes * official,
        "V": train_v(False, settings.width, folder / "rollouts", 0, steps=12)[0],
        "M": train_m(False, 0, steps=6, batch=settings.m_batch // 4),
    }


def blind_speed(name: str) -> float:
    """Frames a second that a driver of FLOORS drives here."""
    begin = time.perf_counter()
    return drive_blindly(name, 0)[1] / (time.perf_counter() - begin)


def describe_forecast(name: str, times: dict[str, float]) -> str:
    """One line that says how long a row takes."""
    parts = ", ".join(f"{part} {seconds / 60:.0f} min" for part, seconds in times.items() if seconds)
    return (
        f"{name}: at most {sum(times.values()) / 3600:.1f} hours on this machine, if nothing of it is there ({parts})"
    )


def describe_row(name: str, found: dict) -> str:
    """One line of the table."""
    low, high = found["interval"]
    return (
        f"{name}: {found['mean']:.1f} +- {found['standard_deviation']:.0f} on {TRACKS} official tracks"
        f" ({len(found['seeds'])} seeds), 95% interval of the mean {low:.0f} to {high:.0f},"
        f" {100 * found['above_900']:.0f}% above {SOLVED}, best {TOP} {found['top_90']:.1f};"
        f" a seed cost {found['agents']:.0f} agents, {found['episodes']:.0f} episodes"
    )
