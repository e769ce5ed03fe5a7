"""The benchmark: how fast the parts are, side by side, in one run on one machine.

    parity      how far the fast renderer is from Gymnasium's, and whether the rewards are equal
    renderer    frames a second on one core: Gymnasium, EnvPool if it is installed, and ours
    loop        frames a second with V + M + C driving, and where the time of a frame goes
    training    images and frames a second of V and M in training
    cluster     a generation by processes of this machine and by a Dask cluster, and a projection

Speeds depend on the machine, so contenders do the same work in turns, in alternating order, and the
median of the rounds counts. It takes about ten minutes on an otherwise idle machine, on the CPU.
"""

import functools
import importlib.metadata
import importlib.util
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import torch
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from stad_lab.agent import PRETRAINED, Agent, drive, load_agent
from stad_lab.config import Config, track_seeds
from stad_lab.envs.car_racing import BAR_TOP, HULL_COLUMN, HULL_ROW, MAX_FRAMES, make_env, place_car
from stad_lab.envs.frames import OBSERVATION_SHAPE, FrameMemory, to_frame, to_pictures
from stad_lab.io.files import save_json
from stad_lab.io.weights import (
    MDN_RNN_FILE,
    VAE_FILE,
    load_vae,
    load_world_model,
    save_mdn_rnn,
    save_vae,
)
from stad_lab.io.workers import run_in_order, worker_processes
from stad_lab.models.controller import control, initial_parameters
from stad_lab.models.mdn_rnn import MDNRNN
from stad_lab.models.vae import VAE, to_tensor
from stad_lab.training.dataset import Dataset, RandomDriver, collect
from stad_lab.training.evolution import drive_group, drive_parallel, hand_out, make_strategy
from stad_lab.training.mdn_rnn import Latents, mdn_rnn_training
from stad_lab.training.pipeline import provenance
from stad_lab.training.trainer import Training, read_ahead, update
from stad_lab.training.vae import vae_training

SOURCE = "input"  # the shipped agent that drives
GYMNASIUM, FAST, PHYSICS = "Gymnasium", "stad_lab", "physics alone, no picture"
CAR_WINDOW = (slice(HULL_ROW - 12, HULL_ROW + 12), slice(HULL_COLUMN - 12, HULL_COLUMN + 12))
V_STEPS, M_STEPS, WARM_UP = 60, 12, 5  # training steps of a round, the first of them not timed


def benchmark(parts: list[str], rounds: int = 5, file: Path | None = None) -> dict:
    """Run some parts of the benchmark and print their tables.

    Args:
        parts: of "parity", "renderer", "loop", "training", "cluster".
        rounds: how often the contenders take turns.
        file: where to write the result, after every part; None for nowhere.

    Returns:
        What it was made with, and for each part its tables with every measurement.

    Raises:
        ValueError: an unknown part, or fewer than 1 round.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or rounds < 1:
        known = f"choose from {', '.join(PARTS)}, with 1 round or more"
        raise ValueError(f"parts={unknown or list(parts)}, rounds={rounds}: {known}")
    command = f"python -m stad_lab benchmark --parts {' '.join(parts)} --rounds {rounds}"
    result = {"made_with": provenance(command) | {"trained_on": "cpu"}, "rounds": rounds}
    for part in parts:
        result[part] = PARTS[part](rounds)
        print(f"\n{part}")
        for name, table in result[part].items():
            print(describe(name, table))
        if file:
            save_json(file, result)
    return result


def take_turns(contenders: dict[str, Callable[[int], float]], rounds: int, label: str) -> dict:
    """Let contenders take turns.

    Args:
        contenders: name -> function of the round's number that returns a speed.

    Returns:
        name -> {"median", "ratio" to the first contender's, "rounds": every speed}.
    """
    speeds = {name: [] for name in contenders}
    for number in tqdm(range(rounds), label, unit="round"):
        for name in list(contenders)[:: -1 if number % 2 else 1]:
            speeds[name].append(contenders[name](number))
    medians = {name: float(np.median(values)) for name, values in speeds.items()}
    first = next(iter(medians.values()))
    return {
        name: {"median": median, "ratio": median / first, "rounds": speeds[name]}
        for name, median in medians.items()
    }


def describe(name: str, table: dict) -> str:
    """A table as lines of text."""
    lines = [f"  {name}"]
    for row, value in table.items():
        if isinstance(value, dict):
            text = f"{value['median']:>10,.0f}{value['ratio']:>8.2f}x"
        else:
            text = f"{value:>10,.3f}" if isinstance(value, float) else f"{value!s:>10}"
        lines.append(f"    {row:<44}{text}")
    return "\n".join(lines)


def measure_parity(rounds: int) -> dict:
    """Drive 20 whole episodes in both environments, on and off the road, once."""
    with worker_processes(2) as executor:
        tasks = [(number,) for number in range(20)]
        episodes = run_in_order(executor, compare_pictures, tasks, "parity")
    errors, table = np.concatenate([errors for errors, _ in episodes]), {}
    for name, value in (("mean", errors.mean(axis=0)), ("worst frame", errors.max(axis=0))):
        areas = ("whole picture", "window of 24 x 24 around the car", "indicator bar")
        table |= {f"{area}, {name}": float(own) for area, own in zip(areas, value, strict=True)}
    equal = all(equal for _, equal in episodes)
    table |= {"frames compared": len(errors), "rewards and endings equal": equal}
    return {"mean absolute difference between the pictures, of 255": table}


def compare_pictures(number: int, frames: int = MAX_FRAMES) -> tuple[np.ndarray, bool]:
    """One random episode in both environments, the odd ones from a random tile.

    Returns:
        Mean absolute differences (pictures, 3) of the whole picture, the window around the car and
        the indicator bar; and whether all rewards and endings were bit-identical.
    """
    rng = np.random.default_rng(number)
    driver, envs = RandomDriver(rng), [make_env(fast) for fast in (True, False)]
    pictures = [[env.reset(seed=track_seeds("test", 20)[number])[0]] for env in envs]
    if number % 2:
        start = {"tile": int(rng.integers(10_000)), "speed": rng.uniform(0, 90)}
        start["turn"] = 0.15 * rng.standard_normal()
        pictures = [[place_car(env, **start)] for env in envs]
    equal, ended = True, False
    while len(pictures[0]) <= frames and not ended:
        action = driver.act()
        ours, theirs = (env.step(action) for env in envs)
        equal &= ours[1:] == theirs[1:]
        for seen, step in zip(pictures, (ours, theirs), strict=True):
            seen.append(step[0])
        ended = any(ours[2:4]) or any(theirs[2:4])
    difference = np.abs(np.array(pictures[0], np.int16) - np.array(pictures[1], np.int16))
    areas = [difference, difference[:, *CAR_WINDOW], difference[:, BAR_TOP:]]
    return np.stack([area.mean(axis=(1, 2, 3)) for area in areas], axis=1), equal


def measure_renderer(rounds: int) -> dict:
    """Frames a second on one core, whole random episodes, resets included.

    EnvPool has its own tracks and a simpler picture: it does about the same work.
    """
    cv2.setNumThreads(1)
    envs = {GYMNASIUM: make_env(fast=False), FAST: make_env(), PHYSICS: make_blind_env()}
    contenders = {name: functools.partial(random_episodes, env) for name, env in envs.items()}
    if importlib.util.find_spec("envpool"):
        import envpool

        pool = envpool.make_gymnasium("CarRacing-v3", num_envs=1, num_threads=1, seed=0)
        pool.reset()
        name = f"EnvPool {importlib.metadata.version('envpool')}"
        contenders[name] = functools.partial(pool_episode, pool)
    else:
        print("EnvPool is not installed and takes no part: pip install envpool")
    warm_up(contenders, rounds)
    return {"frames a second on one core": take_turns(contenders, rounds, "renderer")}


def warm_up(contenders: dict[str, Callable[[int], float]], rounds: int) -> None:
    """Let every contender run once without counting: caches fill, memory is allocated."""
    for contender in contenders.values():
        contender(rounds)


def make_blind_env() -> gym.Env:
    """The environment with its physics and rewards, but with a black picture."""
    env = make_env()
    env.unwrapped._render = lambda mode: np.zeros(OBSERVATION_SHAPE, np.uint8)
    return env


def random_actions(number: int) -> np.ndarray:
    """The random driver's actions for one episode, float32 (1000, 3)."""
    driver = RandomDriver(np.random.default_rng(number))
    return np.array([driver.act() for _ in range(MAX_FRAMES)])


def random_episodes(env: gym.Env, number: int, seconds: float = 1.0) -> float:
    """Frames a second of whole episodes, until so many seconds have passed."""
    actions, frames, episodes, begin = random_actions(number), 0, 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        env.reset(seed=100 * number + episodes)
        episodes += 1
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            frames += 1
            if terminated or truncated:
                break
    return frames / (time.perf_counter() - begin)


def pool_episode(pool: Any, number: int) -> float:
    """Frames a second of EnvPool in one episode, with the reset that it makes by itself."""
    actions, begin = random_actions(number)[:, None], time.perf_counter()
    for action in actions:
        pool.step(action)
    return len(actions) / (time.perf_counter() - begin)


def measure_loop(rounds: int) -> dict:
    """A generation of 8 agents, cars in one batch, and the parts of a frame."""
    config, folder, agent = Config.preset("paper"), PRETRAINED / SOURCE, load_agent(SOURCE)
    shape = config.evolution.population, agent.parameters.size
    population = agent.parameters + 0.01 * np.random.default_rng(0).standard_normal(shape)
    with (
        tempfile.TemporaryDirectory() as large,
        worker_processes(1) as one,
        worker_processes(2) as two,
    ):
        save_world_models_sizes(Path(large))
        speed = functools.partial(generation_speed, population, config)
        contenders = {
            "Gymnasium alone, no agent, 2 processes": functools.partial(gymnasium_speed, two),
            "8 agents, shipped V + M + C, 2 processes": functools.partial(speed, two, folder),
            "8 agents, shipped V + M + C, 1 process": functools.partial(speed, one, folder),
            "8 agents, World Models' sizes, 2 processes": functools.partial(speed, two, large),
        }
        warm_up(contenders, rounds)
        tables = {"frames a second, a generation": take_turns(contenders, rounds, "loop")}
        batches = {
            f"{cars} cars": functools.partial(batch_speed, one, agent.parameters, cars, 250)
            for cars in (1, 2, 4, 8, 16, 32)
        }
        tables["frames a second, one batch in one process"] = take_turns(batches, rounds, "cars")
        for cars in (4, 16):
            budgets = [one.submit(frame_budget, cars).result() for _ in range(rounds)]
            medians = {part: np.median([own[part] for own in budgets]) for part in budgets[0]}
            table = {part: float(median) for part, median in medians.items()}
            tables[f"microseconds of a frame, a batch of {cars} cars"] = table
    return tables


def save_world_models_sizes(folder: Path) -> None:
    """Write an untrained V of World Models' width and the shipped M, which takes as much time."""
    torch.manual_seed(0)
    config = Config.preset("paper", variant=SOURCE)
    vae = VAE(config.variant, config.vae.latent_size, config.vae.width)
    save_vae(folder / VAE_FILE, vae, config)
    mdn_rnn = load_world_model(PRETRAINED / SOURCE).mdn_rnn
    weights = load_vae(folder / VAE_FILE)[1]["weights"]
    save_mdn_rnn(folder / MDN_RNN_FILE, mdn_rnn, config, vae=weights)


def generation_speed(
    population: np.ndarray, config: Config, executor: Executor, source: Any, number: int
) -> float:
    """Frames a second of all agents together, on the tracks of generation `number`."""
    tracks = track_seeds("evolve", config.evolution.tracks, 9, number)
    agents, begin = np.repeat(population, len(tracks), axis=0), time.perf_counter()
    task = (source, config.evolution, agents, tracks * len(population))
    _, lengths = drive_parallel(executor, *task)
    return lengths.sum() / (time.perf_counter() - begin)


def batch_speed(
    executor: Executor, parameters: np.ndarray, cars: int, frames: int, number: int
) -> float:
    """Frames a second of one process in which so many cars drive in one batch."""
    agents, begin = np.repeat(parameters[None], cars, axis=0), time.perf_counter()
    task = (PRETRAINED / SOURCE, agents, list(range(cars)), True, {"max_frames": frames})
    _, lengths = executor.submit(drive_group, *task).result()
    return lengths.sum() / (time.perf_counter() - begin)


def gymnasium_speed(executor: Executor, number: int) -> float:
    """Frames a second of Gymnasium's own environment in two processes, random driving."""
    futures = [executor.submit(gymnasium_episode, 2 * number + process) for process in range(2)]
    return sum(future.result() for future in futures)


def gymnasium_episode(number: int) -> float:
    """Frames a second of Gymnasium's own environment. Runs in a worker process."""
    return random_episodes(make_env(fast=False), number)


def frame_budget(cars: int, frames: int = 400) -> dict[str, float]:
    """Microseconds of each part of a frame of one car, in a batch. Runs in a worker process.

    Parts are timed one by one; "all else" is what a real episode takes beyond their sum.
    """
    agent = load_agent(SOURCE)
    world_model, parameters = agent.world_model, np.repeat(agent.parameters[None], cars, axis=0)
    batch, tracks = Agent(world_model, parameters), list(range(cars))
    drive(batch, tracks, max_frames=50)
    begin = time.perf_counter()
    lengths = drive(batch, tracks, max_frames=frames).lengths
    whole = (time.perf_counter() - begin) / lengths.sum()

    env, blind = make_env(bar=not world_model.crop_bar), make_blind_env()
    observation, actions = env.reset(seed=0)[0], []
    for _ in range(frames):
        actions.append(agent.act(observation))
        observation = env.step(actions[-1])[0]
    seconds = {"reset": seconds_of(lambda: env.reset(seed=0), 10) / frames}
    blind.reset(seed=0)
    with_picture, without = iter(actions), iter(actions)
    seconds["physics"] = seconds_of(lambda: blind.step(next(without)), frames)
    both = seconds_of(lambda: env.step(next(with_picture)), frames)
    seconds["picture"] = both - seconds["physics"]
    memory, seen = FrameMemory(world_model.stride), [observation] * cars

    def prepare() -> list[torch.Tensor]:
        pictures = np.stack([to_frame(one, world_model.crop_bar) for one in seen])
        return [to_tensor(one) for one in to_pictures(pictures, memory.push(pictures))]

    z, h = world_model.sizes
    latents, chosen = torch.zeros(cars, 1, z), torch.zeros(cars, 1, 3)
    state, features = (torch.zeros(1, cars, h),) * 2, np.zeros((cars, z + h), np.float32)
    pictures, count = prepare(), frames // 4
    parts = {
        "preparation": prepare,
        "V": lambda: world_model.vae.encode(*pictures),
        "M": lambda: world_model.mdn_rnn.remember(latents, chosen, state),
        "C": lambda: control(parameters, features),
    }
    with torch.inference_mode():
        seconds |= {name: seconds_of(part, count) / cars for name, part in parts.items()}
    seconds["all else"] = whole - sum(seconds.values())
    return {name: 1e6 * value for name, value in {**seconds, "together": whole}.items()}


def seconds_of(call: Callable, count: int) -> float:
    """Mean seconds of one of `count` calls."""
    begin = time.perf_counter()
    for _ in range(count):
        call()
    return (time.perf_counter() - begin) / count


def measure_training(rounds: int) -> dict:
    """V and M in training, with all cores."""
    with tempfile.TemporaryDirectory() as folder:
        config = Config.preset("laptop", variant=SOURCE, data={"episodes": 100})
        collect(config, Path(folder))
        dataset = Dataset(Path(folder))
        widths = {
            f"V of width {width}": functools.partial(
                v_speed, config.replace(vae={"width": width, "steps": V_STEPS}), dataset
            )
            for width in (16, 32)
        }
        tables = {"images a second": take_turns(widths, rounds, "V")}
    paper = Config.preset("paper", mdn_rnn={"steps": M_STEPS})
    contenders = {"M at paper settings": functools.partial(m_speed, paper)}
    return tables | {"frames a second": take_turns(contenders, rounds, "M")}


def v_speed(config: Config, dataset: Dataset, number: int) -> float:
    """Images a second of V in training."""
    vae = VAE(config.variant, config.vae.latent_size, config.vae.width)
    vae.to(memory_format=torch.channels_last)
    return training_speed(vae_training(config, dataset, vae, Path("unused")), config.vae.batch)


def m_speed(config: Config, number: int) -> float:
    """Frames a second of M in training, on noise."""
    settings, size = config.mdn_rnn, config.vae.latent_size
    rng, count = np.random.default_rng(number), settings.sequence + 1
    encoded = [rng.standard_normal((2, count, size), np.float32) for _ in range(4)]
    latents = Latents(encoded, [np.zeros((count, 3), np.float32)] * 4, 3, "")
    mdn_rnn = MDNRNN(size, settings.hidden_size, settings.mixtures)
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


def measure_cluster(rounds: int) -> dict:
    """A generation of 16 agents on 4 tracks, 100 frames each; costs; and what they project."""
    from distributed import LocalCluster  # Dask takes a second to import
    from distributed.protocol.pickle import dumps

    from stad_lab.io.dask_cluster import cluster

    brief = {"population": 16, "tracks": 4, "max_frames": 100, "patience": 0}
    config, agent = Config.preset("laptop", evolution=brief), load_agent(SOURCE)
    population = np.repeat(agent.parameters[None], 16, axis=0)
    address = {"threads_per_worker": 1, "dashboard_address": None}
    with (
        worker_processes(1) as one,
        worker_processes(2) as two,
        LocalCluster(1, **address) as small,
        LocalCluster(2, **address) as large,
        cluster(small.scheduler_address) as dask_one,
        cluster(large.scheduler_address) as dask_two,
    ):
        executors = {"own processes, 1": one, "own processes, 2": two}
        executors |= {"Dask, 1 worker": dask_one, "Dask, 2 workers": dask_two}
        contenders = {}
        for name, executor in executors.items():
            source = hand_out(executor, PRETRAINED / SOURCE)
            speed = functools.partial(generation_speed, population, config, executor, source)
            contenders[name] = speed
        warm_up(contenders, rounds)
        tables = {"frames a second, a generation": take_turns(contenders, rounds, "cluster")}
        calls = {
            f"frames a second, a batch of {cars}": functools.partial(
                batch_speed, one, agent.parameters, cars, 100
            )
            for cars in (1, 16)
        }
        calls["milliseconds of Dask for a task"] = lambda _: task_cost(dask_two)
        calls["milliseconds of CMA-ES for a generation of 64"] = lambda _: cma_cost()
        costs = {
            name: float(np.median([call(number) for number in range(rounds)]))
            for name, call in calls.items()
        }
    costs["kilobytes of a task with one car"] = len(dumps(agent.parameters)) / 1e3
    costs["kilobytes of V and M, once for each worker"] = len(dumps(agent.world_model)) / 1e3
    tables["costs"] = costs
    tables["projected efficiency, 1,024 episodes of 1,000 frames"] = {
        f"{workers:,} workers": project(costs, workers) for workers in (1, 2, 64, 1024)
    }
    return tables


def task_cost(executor: Executor, count: int = 400) -> float:
    """Milliseconds that the executor takes for a task that does nothing."""
    begin = time.perf_counter()
    for future in [executor.submit(int, number) for number in range(count)]:
        future.result()
    return 1e3 * (time.perf_counter() - begin) / count


def cma_cost(generations: int = 5) -> float:
    """Milliseconds that CMA-ES takes for a generation of 64 agents of 867 parameters."""
    settings = Config.preset("paper", evolution={"population": 64}).evolution
    with threadpool_limits(1):
        strategy = make_strategy(initial_parameters(32, 256), settings, {"entropy": 0})
        begin = time.perf_counter()
        for _ in range(generations):
            population = np.array(strategy.ask())
            strategy.tell(population, (population**2).sum(axis=1))
        return 1e3 * (time.perf_counter() - begin) / generations


def project(costs: dict, workers: int, episodes: int = 1024, frames: int = 1000) -> float:
    """Efficiency of so many workers: their speed-up over one, divided by their number.

    Episodes are independent: they are shared out evenly, at most 16 in a batch. What one process
    does for all is added: Dask handles each task, and CMA-ES waits for the last car.
    """

    def seconds(count: int) -> float:
        cars = min(16, episodes // count)  # in a batch
        alone, many = (costs[f"frames a second, a batch of {size}"] for size in (1, 16))
        speed = alone + (many - alone) * (cars - 1) / 15  # between the two that were measured
        serial = costs["milliseconds of Dask for a task"] * episodes / cars
        serial += costs["milliseconds of CMA-ES for a generation of 64"]
        return episodes / count * frames / speed + serial / 1e3

    return seconds(1) / (workers * seconds(workers))


PARTS = {
    "parity": measure_parity,
    "renderer": measure_renderer,
    "loop": measure_loop,
    "training": measure_training,
    "cluster": measure_cluster,
}
