"""The benchmark: how fast the parts are, side by side, in one run on one machine.

    parity      how far our pictures are from Gymnasium's, and whether the rewards are equal
    renderer    frames a second on one core: Gymnasium, EnvPool if it is installed, and our engine
    loop        frames a second with V + M + C driving, and where the time of a frame goes
    training    images and frames a second of V and M in training
    run         minutes of whole runs of two presets, from nothing to the evaluated agent

Speeds depend on the machine, so contenders do the same work in turns, in alternating order, and the
median of the rounds counts. On an otherwise idle machine the run takes about half an hour, and
all else about ten minutes.
"""

import cProfile
import functools
import importlib.metadata
import importlib.util
import inspect
import pstats
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import torch
from tqdm.auto import tqdm

from stad_lab.agent import Agent, drive, load_agent
from stad_lab.config import Config, track_seeds
from stad_lab.envs.car_racing import MAX_FRAMES, make_env
from stad_lab.envs.cars import Cars
from stad_lab.envs.frames import FrameMemory
from stad_lab.envs.vector import CarRacingVector
from stad_lab.evaluation.evaluate import evaluate
from stad_lab.inference import Inference
from stad_lab.io.files import load_json, save_json
from stad_lab.io.workers import run_in_order, single_thread, worker_processes, worker_threads
from stad_lab.models.controller import control
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE
from stad_lab.training.dataset import Dataset, RandomDriver, collect
from stad_lab.training.evolution import drive_parallel
from stad_lab.training.mdn_rnn import Latents, mdn_rnn_training
from stad_lab.training.pipeline import STAGES, train
from stad_lab.training.record import RECORD, provenance
from stad_lab.training.trainer import Training, read_ahead, update
from stad_lab.training.vae import vae_training
from stad_study.parity import AREAS, compare_pictures

SOURCE = "input"  # the shipped agent that drives, and the variant that is trained
GYMNASIUM, ENVPOOL = "Gymnasium", "EnvPool"
CARS = 16  # in a batch
V_STEPS, M_STEPS, WARM_UP = 60, 12, 5  # training steps of a round, the first of them not timed

WHOLE_RUNS = {  # name -> preset, and who renders in the evaluation
    "minutes of a whole run": ("laptop", ["our engine", GYMNASIUM]),
    "minutes of a whole run, fast": ("fast", ["our engine"]),
}
# Name -> function of the round that gives a speed.
Contenders = Mapping[str, Callable[[int], float]]


def benchmark(parts: list[str], rounds: int = 5, file: Path | None = None) -> dict:
    """Run some parts of the benchmark and print their tables.

    Args:
        parts: of "parity", "renderer", "loop", "training", "run".
        rounds: how often the contenders take turns.
        file: where to write the result, after every part; None for nowhere.

    Returns:
        What it was made with, and the tables of each part; of contenders every measurement.

    Raises:
        ValueError: an unknown part, or fewer than 1 round.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or rounds < 1:
        known = f"choose from {', '.join(PARTS)}, with 1 round or more"
        raise ValueError(f"parts={unknown or list(parts)}, rounds={rounds}: {known}")
    command = f"python -m stad_study benchmark --parts {' '.join(parts)} --rounds {rounds}"
    result: dict[str, Any] = {
        "kind": "benchmark",
        "made_with": provenance(command) | {"trained_on": "cpu"},
        "rounds": rounds,
    }
    for part in parts:
        result[part] = PARTS[part](rounds)
        print(f"\n{part}")
        for name, table in result[part].items():
            print(describe(name, table))
        if file:
            save_json(file, result)
    return result


def take_turns(contenders: Contenders, rounds: int, label: str) -> dict:
    """Let contenders take turns, after one turn of each that does not count.

    Returns:
        name -> {"median", "rounds": every speed, "ratio" to the first contender's}, and the "ratio
        to EnvPool" if that takes part.
    """
    for contender in contenders.values():
        contender(rounds)  # caches fill, memory is allocated
    speeds: dict[str, list[float]] = {name: [] for name in contenders}
    for number in tqdm(range(rounds), label, unit="round"):
        for name in list(contenders)[:: -1 if number % 2 else 1]:
            speeds[name].append(contenders[name](number))
    medians = {name: float(np.median(values)) for name, values in speeds.items()}
    units = {"ratio": next(iter(medians.values()))}
    if pools := [median for name, median in medians.items() if name.startswith(ENVPOOL)]:
        units[f"ratio to {ENVPOOL}"] = max(pools)
    return {
        name: {"median": median, "rounds": speeds[name]}
        | {ratio: median / unit for ratio, unit in units.items()}
        for name, median in medians.items()
    }


def describe(name: str, table: dict) -> str:
    """A table as lines of text: of contenders the median and their ratios."""
    lines = [f"  {name}"]
    for row, value in table.items():
        if isinstance(value, dict):
            ratios = [f"{value[key]:>8.2f}x" for key in value if key.startswith("ratio")]
            text = f"{value['median']:>10,.0f}" + "".join(ratios)
        else:
            text = f"{value:>10,.3f}" if isinstance(value, float) else f"{value!s:>10}"
        lines.append(f"    {row:<44}{text}")
    return "\n".join(lines)


def measure_parity(rounds: int) -> dict:
    """Drive 20 whole episodes in both environments, on and off the road, once."""
    with worker_processes(2) as executor:
        tasks = [(number,) for number in range(20)]
        episodes = run_in_order(executor, compare_pictures, tasks, "parity")
    errors = np.concatenate([errors for errors, _ in episodes])
    table: dict[str, float] = {}
    for name, value in (("mean", errors.mean(axis=0)), ("worst picture", errors.max(axis=0))):
        table |= {f"{area}, {name}": float(own) for area, own in zip(AREAS, value, strict=True)}
    equal = all(equal for _, equal in episodes)
    table |= {"pictures compared": len(errors), "rewards and endings equal": equal}
    return {"mean absolute difference between the pictures, of 255": table}


def measure_renderer(rounds: int) -> dict:
    """Frames a second on one core with random driving, resets included.

    EnvPool has its own tracks and a simpler picture: it does about the same work.
    """
    cv2.setNumThreads(1)
    reference, single = make_env(fast=False), make_env()
    vector, cars = CarRacingVector(CARS), Cars(CARS, "frame", bar=False)
    for started in (reference, single, vector, cars):
        started.reset()
    steps: dict[str, tuple[Callable, int]] = {
        GYMNASIUM: (functools.partial(step_env, reference), 1)
    }
    if importlib.util.find_spec("envpool"):
        import envpool

        name = f"{ENVPOOL} {importlib.metadata.version('envpool')}"
        for count, text in ((1, "1 car"), (CARS, f"{CARS} cars")):
            pool = envpool.make_gymnasium("CarRacing-v3", num_envs=count, num_threads=1, seed=0)
            pool.reset()
            steps[f"{name}, {text}"] = pool.step, count
    else:
        print("EnvPool is not installed and takes no part: pip install envpool")
    steps["observation, 1 car"] = functools.partial(step_env, single), 1
    steps[f"observation, {CARS} cars"] = vector.step, CARS
    steps[f"agent's frame, {CARS} cars"] = functools.partial(step_cars, cars, True), CARS
    steps[f"no picture, {CARS} cars"] = functools.partial(step_cars, cars, False), CARS
    speeds = {name: functools.partial(random_speed, *pair) for name, pair in steps.items()}
    return {"frames a second on one core": take_turns(speeds, rounds, "renderer")}


def random_speed(step: Callable, cars: int, number: int) -> float:
    """Frames a second of 1,000 calls of `step` with random actions, float32 (cars, 3)."""
    drivers = [RandomDriver(rng) for rng in np.random.default_rng(number).spawn(cars)]
    actions = np.array([[driver.act() for driver in drivers] for _ in range(MAX_FRAMES)])
    begin = time.perf_counter()
    for action in actions:
        step(action)
    return actions[..., 0].size / (time.perf_counter() - begin)


def step_env(env: gym.Env, actions: np.ndarray) -> None:
    """A step of one environment, and its reset after an episode."""
    if any(env.step(actions[0])[2:4]):
        env.reset()


def step_cars(cars: Cars, draw: bool, actions: np.ndarray) -> None:
    """A step of all cars, with or without their pictures, and their reset after an episode."""
    _, ended = cars.step(actions)
    ended |= cars.cars["frames"] >= MAX_FRAMES
    if ended.any():
        cars.reset(which=np.flatnonzero(ended))
    if draw:
        cars.draw()


def measure_loop(rounds: int) -> dict:
    """A generation of 8 agents, batches of several sizes, and the parts of a frame."""
    config, agent = Config.preset("paper", evolution={"tracks": 1}), load_agent(SOURCE)
    world_model, parameters = agent.world_model, agent.parameters
    shape = config.evolution.population, parameters.size
    population = parameters + 0.01 * np.random.default_rng(0).standard_normal(shape)
    with worker_threads(1) as one, worker_threads(2) as two:
        speed = functools.partial(generation_speed, population, config)
        contenders = {
            "V + M + C, 1 thread": functools.partial(speed, one, world_model),
            "V + M + C, 2 threads": functools.partial(speed, two, world_model),
        }
        tables = {"frames a second, a generation": take_turns(contenders, rounds, "loop")}
        batches = {}
        for cars in (1, 2, 4, 8, 16, 32):
            brief = config.replace(evolution={"cars": cars, "tracks": 2 * cars, "max_frames": 250})
            speed = functools.partial(generation_speed, parameters[None], brief, one, world_model)
            batches[f"{cars} car{'s' * (cars > 1)}"] = speed
        tables["frames a second, cars in one process"] = take_turns(batches, rounds, "cars")
        budgets = [one.submit(frame_budget, CARS).result() for _ in range(rounds)]
    medians = {part: float(np.median([own[part] for own in budgets])) for part in budgets[0]}
    return tables | {f"microseconds of a frame, {CARS} cars in one process": medians}


def generation_speed(
    population: np.ndarray, config: Config, executor: Executor, source: object, number: int
) -> float:
    """Frames a second of all agents together, on the tracks of generation `number`."""
    tracks = track_seeds("evolve", config.evolution.tracks, 9, number)
    agents, begin = np.repeat(population, len(tracks), axis=0), time.perf_counter()
    task = (source, config.evolution, agents, tracks * len(population))
    return drive_parallel(executor, *task)[1].sum() / (time.perf_counter() - begin)


def frame_budget(cars: int, frames: int = 400) -> dict[str, float]:
    """Microseconds that each part of a frame takes for one car of a batch, resets included.

    "all else" is what the rest of the loop takes, mostly Python. A profiler times one drive; it
    slows Python down a little.
    """
    single_thread()
    parts: dict[str, list[Callable]] = {
        "reset": [Cars.reset], "physics": [Cars.step], "picture": [Cars.draw],
        "frames": [FrameMemory.push],
        "V": [Inference.encode], "M": [Inference.remember], "C": [control],
    }  # fmt: skip
    agent, profile = load_agent(SOURCE), cProfile.Profile()
    batch = Agent(agent.world_model, np.repeat(agent.parameters[None], cars, axis=0))
    drive(batch, range(cars), max_frames=5)
    begin = time.perf_counter()
    count = profile.runcall(drive, batch, range(cars), max_frames=frames).lengths.sum()
    whole = time.perf_counter() - begin
    codes = {name: [inspect.unwrap(one).__code__ for one in own] for name, own in parts.items()}
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]  # typeshed lacks it
    seconds = {
        name: sum(stats[code.co_filename, code.co_firstlineno, code.co_name][3] for code in own)
        for name, own in codes.items()
    }
    seconds |= {"all else": whole - sum(seconds.values()), "together": whole}
    return {name: 1e6 * float(value / count) for name, value in seconds.items()}


def measure_training(rounds: int) -> dict:
    """V and M in training, with all cores."""
    with tempfile.TemporaryDirectory() as folder:
        config = Config.preset("laptop", variant=SOURCE, data={"episodes": 100})
        collect(config, Path(folder))
        dataset, tables = Dataset(Path(folder)), {}
        for width in (16, 32):
            wide = config.replace(vae={"width": width, "steps": V_STEPS})
            one = {"stad_lab": functools.partial(v_speed, wide, dataset)}
            tables[f"images a second, V of width {width}"] = take_turns(one, rounds, "V")
    paper = Config.preset("paper", mdn_rnn={"steps": M_STEPS})
    one = {"stad_lab": functools.partial(m_speed, paper)}
    return tables | {"frames a second, M at paper settings": take_turns(one, rounds, "M")}


def v_speed(config: Config, dataset: Dataset, number: int) -> float:
    """Images a second of V in training."""
    vae = VAE.of(config)
    vae.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return training_speed(vae_training(config, dataset, vae, Path("unused")), config.vae.batch)


def m_speed(config: Config, number: int) -> float:
    """Frames a second of M in training, on noise."""
    settings, size = config.mdn_rnn, config.vae.latent_size
    rng, count = np.random.default_rng(number), settings.sequence + 1
    encoded = [rng.standard_normal((2, count, size), np.float32) for _ in range(4)]
    latents = Latents(encoded, [np.zeros((count, 3), np.float32)] * 4, 3, "")
    mdn_rnn = MDNRNN.of(config)
    training = mdn_rnn_training(config, latents, mdn_rnn, Path("unused"))
    return training_speed(training, settings.batch * settings.sequence)


def training_speed(training: Training, items: int) -> float:
    """Items a second over the steps of a training; a step has so many."""
    optimizer = torch.optim.Adam(training.model.parameters(), lr=0.0, fused=True)
    for step, batch in read_ahead(training.batch, range(training.steps)):
        if step == WARM_UP:
            begin = time.perf_counter()
        update(training.model, optimizer, training.losses(*batch)["total"], training.learning_rate)
    return (training.steps - WARM_UP) * items / (time.perf_counter() - begin)


def measure_run(rounds: int) -> dict:
    """A whole run of each preset, with the evaluation of its agent on 100 tracks."""
    return {name: time_run(*run) for name, run in WHOLE_RUNS.items()}


def time_run(preset: str, renderers: list[str]) -> dict[str, float]:
    """Minutes of each stage of one run, and of the evaluations with some renderers."""
    config = Config.preset(preset, variant=SOURCE)
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        train(config, folder)
        seconds = load_json(Path(folder) / RECORD)["seconds"]
        seconds = {stage: seconds[stage] for stage in STAGES}
        seconds["all else"] = time.perf_counter() - begin - sum(seconds.values())
        for name in renderers:
            begin = time.perf_counter()
            evaluate(folder, fast=name != GYMNASIUM, processes=config.processes)
            seconds[f"evaluation with {name}"] = time.perf_counter() - begin
    return {name: own / 60 for name, own in seconds.items()}


PARTS = {
    "parity": measure_parity,
    "renderer": measure_renderer,
    "loop": measure_loop,
    "training": measure_training,
    "run": measure_run,
}
