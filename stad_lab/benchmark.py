"""The benchmark: how fast the parts are, side by side, in one run on one machine.

    parity      how far the fast picture is from Gymnasium's, on 20 episodes, and whether the rewards are equal
    renderer    frames a second on one core: Gymnasium, EnvPool if it is installed, and the fast renderer
    loop        frames a second with V + M + C driving, and where the time of a frame goes
    training    V and M trained the plain way and in ours, from the same weights on the same batches
    cluster     a generation by this machine's own processes and by a Dask cluster, and what many workers would give

A speed says more about a machine than about a program, so every part has a contender that does the same work in the
usual way. The contenders take turns, in alternating order, and the median of the rounds counts. It takes about ten
minutes, and they should be quiet ones: whatever else runs is measured too. Everything runs on the CPU.
"""

import dataclasses
import functools
import importlib.metadata
import importlib.util
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import nn
from torch.utils.data import DataLoader, Dataset
from tqdm.auto import tqdm

from stad_lab.agent import PRETRAINED, Agent, drive, load_agent, read_world_model
from stad_lab.config import Settings
from stad_lab.envs.car_racing import BAR_TOP, HULL_COLUMN, HULL_ROW, MAX_FRAMES, make_env, place_car
from stad_lab.envs.frames import OBSERVATION_SHAPE, FrameMemory, to_frame
from stad_lab.io.files import save_json
from stad_lab.io.workers import keep_freed_memory, run_in_order, worker_processes
from stad_lab.models.controller import control, initial_parameters
from stad_lab.models.mdn_rnn import MDNRNN, mdn_loss, save_mdn_rnn
from stad_lab.models.vae import (
    AutoEncoder,
    autoencoder_losses,
    load_autoencoder,
    save_autoencoder,
    to_pictures,
)
from stad_lab.training.dataset import RandomDriver, Rollouts, collect_rollouts, track_seeds
from stad_lab.training.evolution import drive_group, drive_parallel, hand_out, make_strategy
from stad_lab.training.pipeline import provenance
from stad_lab.training.trainer import read_ahead

V_STEPS, M_STEPS, WARM_UP = (
    60,
    12,
    5,
)  # training steps of a round, and how many of them are not timed
VARIANT = "input"  # of the shipped agent that drives
GYMNASIUM, FAST, PHYSICS = "Gymnasium", "stad_lab", "physics alone, no picture"
CAR_WINDOW = (slice(HULL_ROW - 12, HULL_ROW + 12), slice(HULL_COLUMN - 12, HULL_COLUMN + 12))


def benchmark(parts: list[str], rounds: int = 5, file: Path | None = None) -> dict:
    """Run some parts of the benchmark and print their tables.

    Args:
        parts: of "parity", "renderer", "loop", "training", "cluster".
        rounds: how often the contenders take turns; parity has no contenders and is measured once.
        file: where to write the result, after every part; None for nowhere.

    Returns:
        A dict for JSON: what it was made with, and for each part its tables with every single measurement.

    Raises:
        ValueError: an unknown part, or fewer than 1 round.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or rounds < 1:
        raise ValueError(
            f"parts={unknown or list(parts)}, rounds={rounds}: choose from {', '.join(PARTS)}, with 1 round or more"
        )
    command = " ".join(
        [
            "python -m stad_lab benchmark",
            *(f"--part {part}" for part in parts),
            f"--rounds {rounds}",
        ]
    )
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
    """Let contenders take turns: a table of their median speeds, and of the ratios to the first one's.

    Args:
        contenders: name -> function of the round's number that returns a speed.
        rounds: number of rounds.
        label: of the progress bar.

    Returns:
        name -> {"median", "ratio", "rounds": the speed in every round}.
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
            lines.append(f"    {row:<44}{value['median']:>10,.0f}{value['ratio']:>8.2f}x")
        else:
            lines.append(
                f"    {row:<44}{value:>10,.3f}"
                if isinstance(value, float)
                else f"    {row:<44}{value!s:>10}"
            )
    return "\n".join(lines)


# Parity


def measure_parity(rounds: int) -> dict:
    """Drive 20 whole episodes in both environments, on and off the road."""
    with worker_processes(2) as executor:
        episodes = run_in_order(
            executor, compare_pictures, [(number,) for number in range(20)], "parity"
        )
    names = ("whole picture", "window of 24 x 24 around the car", "indicator bar")
    errors = np.concatenate([errors for errors, _ in episodes])
    table = {
        f"{name}, mean": float(mean) for name, mean in zip(names, errors.mean(axis=0), strict=True)
    }
    table |= {
        f"{name}, worst frame": float(worst)
        for name, worst in zip(names, errors.max(axis=0), strict=True)
    }
    table |= {
        "frames compared": len(errors),
        "rewards and endings equal": all(equal for _, equal in episodes),
    }
    return {"mean absolute difference between the pictures, of 255": table}


def compare_pictures(number: int, frames: int = MAX_FRAMES) -> tuple[np.ndarray, bool]:
    """One random episode in both environments, the odd ones from a random tile: are they the same?

    Returns:
        Mean absolute differences (pictures, 3) of the whole picture, the window around the car and the indicator bar,
        and whether all rewards, terminations and truncations were equal to the last bit.
    """
    rng = np.random.default_rng([5, number])
    driver, envs = RandomDriver(rng), [make_env(fast) for fast in (True, False)]
    pictures = [[env.reset(seed=track_seeds("test", 20, 5)[number])[0]] for env in envs]
    if number % 2:
        start = {
            "tile": int(rng.integers(10_000)),
            "speed": rng.uniform(0, 90),
            "turn": 0.15 * rng.standard_normal(),
        }
        pictures = [[place_car(env, **start)] for env in envs]
    equal = True
    for _ in range(frames):
        action = driver.act()
        steps = [env.step(action) for env in envs]
        equal &= steps[0][1:] == steps[1][1:]
        for seen, step in zip(pictures, steps, strict=True):
            seen.append(step[0])
        if any(steps[0][2:4]) or any(steps[1][2:4]):
            break
    difference = np.abs(np.array(pictures[0], np.int16) - np.array(pictures[1], np.int16))
    areas = [difference, difference[:, *CAR_WINDOW], difference[:, BAR_TOP:]]
    return np.stack([area.mean(axis=(1, 2, 3)) for area in areas], axis=1), equal


# The renderer


def measure_renderer(rounds: int) -> dict:
    """Frames a second on one core, whole random episodes, resets included.

    EnvPool has its own tracks and its own picture, which it shrinks in a simpler way: it does about the same work.
    """
    cv2.setNumThreads(1)
    envs = {GYMNASIUM: make_env(fast=False), FAST: make_env(), PHYSICS: make_blind_env()}
    contenders = {
        name: lambda number, env=env: random_episodes(env, number) for name, env in envs.items()
    }
    if importlib.util.find_spec("envpool"):
        import envpool  # optional: pip install envpool

        pool = envpool.make_gymnasium("CarRacing-v3", num_envs=1, num_threads=1, seed=0)
        pool.reset()
        contenders[f"EnvPool {importlib.metadata.version('envpool')}"] = lambda number: (
            pool_episode(pool, number)
        )
    else:
        print("EnvPool is not installed and takes no part; to have it in: pip install envpool")
    for contender in contenders.values():  # a warm-up: caches fill, memory is taken
        contender(rounds)
    return {"frames a second on one core": take_turns(contenders, rounds, "renderer")}


def make_blind_env() -> gym.Env:
    """The environment with its physics and rewards, but without a picture: a black one is handed out."""
    env = make_env()
    env.unwrapped._render = lambda mode: np.zeros(OBSERVATION_SHAPE, np.uint8)
    return env


def random_actions(number: int) -> np.ndarray:
    """The random driver's actions for one episode, float32 (1000, 3): it soon leaves the road."""
    driver = RandomDriver(np.random.default_rng(number))
    return np.array([driver.act() for _ in range(MAX_FRAMES)])


def random_episodes(env: gym.Env, number: int, seconds: float = 1.0) -> float:
    """Frames a second of whole episodes, driven until so many seconds have passed."""
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
    """Frames a second of EnvPool, which resets itself: as many frames as an episode has, one reset among them."""
    actions, begin = random_actions(number)[:, None], time.perf_counter()
    for action in actions:
        pool.step(action)
    return len(actions) / (time.perf_counter() - begin)


# The loop


def measure_loop(rounds: int) -> dict:
    """A generation of 8 agents at `paper` settings against Gymnasium alone, the cost of more cars, and of one frame.

    Gymnasium's two processes drive at random and never wait for each other; the agents drive on the road, and their
    generation ends when its last car has.
    """
    settings = Settings.preset("paper")
    folder, agent = PRETRAINED / VARIANT, load_agent(VARIANT)
    rng = np.random.default_rng(0)
    population = agent.parameters + 0.01 * rng.standard_normal(
        (settings.population, agent.parameters.size)
    )
    with (
        tempfile.TemporaryDirectory() as large,
        worker_processes(1) as one,
        worker_processes(2) as two,
    ):
        make_world_models_sizes(Path(large))
        speed = functools.partial(generation_speed, population, settings)
        contenders = {
            "Gymnasium alone, no agent, 2 processes": lambda number: gymnasium_speed(two, number),
            "8 agents, shipped V + M + C, 2 processes": functools.partial(speed, two, folder),
            "8 agents, shipped V + M + C, 1 process": functools.partial(speed, one, folder),
            "8 agents, World Models' sizes, 2 processes": functools.partial(
                speed, two, Path(large)
            ),
        }
        for contender in contenders.values():
            contender(rounds)
        tables = {"frames a second, a generation": take_turns(contenders, rounds, "loop")}
        short = dataclasses.replace(settings, max_frames=250)
        crowds = {
            f"{cars} in step": lambda number, cars=cars: crowd_speed(
                one, agent.parameters, cars, short
            )
            for cars in (1, 2, 4, 8, 16, 32)
        }
        tables["frames a second, cars in one process"] = take_turns(crowds, rounds, "cars")
        for cars in (4, 16):
            budgets = [one.submit(frame_budget, cars).result() for _ in range(rounds)]
            tables[f"microseconds of a frame, {cars} cars in one process"] = {
                part: float(np.median([budget[part] for budget in budgets])) for part in budgets[0]
            }
    return tables


def make_world_models_sizes(folder: Path) -> None:
    """A V of World Models' width, untrained, beside the shipped M: it has as much to compute as a trained one."""
    torch.manual_seed(0)
    settings = Settings.preset("paper")
    autoencoder = AutoEncoder(VARIANT, settings.latent_size, settings.width)
    save_pair(
        folder, autoencoder, read_world_model(PRETRAINED / VARIANT, VARIANT).mdn_rnn, settings
    )


def save_pair(folder: Path, autoencoder: AutoEncoder, mdn_rnn: MDNRNN, settings: Settings) -> None:
    """Write a V and an M that were not trained together as if they were, so that agents can drive with both."""
    save_autoencoder(folder / "autoencoder.safetensors", autoencoder, settings, [])
    identity = load_autoencoder(folder / "autoencoder.safetensors")[1]["identity"]
    save_mdn_rnn(
        folder / "mdn_rnn.safetensors", mdn_rnn, autoencoder.variant, settings, [], identity
    )


def generation_speed(
    population: np.ndarray, settings: Settings, executor: Executor, source: Any, number: int
) -> float:
    """Frames a second of all agents together, each on the tracks of the generation of this number."""
    tracks = track_seeds("evolve", settings.tracks, 9, number)
    agents = np.repeat(population, len(tracks), axis=0)
    begin = time.perf_counter()
    _, lengths = drive_parallel(
        executor, source, VARIANT, agents, tracks * len(population), settings
    )
    return lengths.sum() / (time.perf_counter() - begin)


def crowd_speed(executor: Executor, parameters: np.ndarray, cars: int, settings: Settings) -> float:
    """Frames a second of one process in which so many cars drive in step."""
    agents, tracks, begin = (
        np.repeat(parameters[None], cars, axis=0),
        list(range(cars)),
        time.perf_counter(),
    )
    _, lengths = executor.submit(
        drive_group, PRETRAINED / VARIANT, VARIANT, agents, tracks, True, settings
    ).result()
    return lengths.sum() / (time.perf_counter() - begin)


def gymnasium_speed(executor: Executor, number: int) -> float:
    """Frames a second of Gymnasium's own environment in two processes together, random driving, no agent."""
    futures = [executor.submit(gymnasium_episode, 2 * number + process) for process in range(2)]
    return sum(future.result() for future in futures)


def gymnasium_episode(number: int) -> float:
    """Frames a second of one random episode in Gymnasium's own environment. Runs in a worker process."""
    return random_episodes(make_env(fast=False), number)


def frame_budget(cars: int, frames: int = 400) -> dict[str, float]:
    """Microseconds that each part takes for one frame of one car, of `cars` in step. Runs in a worker process.

    Parts are timed one by one, on what the shipped agent sees; "all else" is what a real drive takes beyond their sum.
    """
    agent = load_agent(VARIANT)
    autoencoder, mdn_rnn = agent.autoencoder, agent.mdn_rnn
    parameters = np.repeat(agent.parameters[None], cars, axis=0)
    crowd = Agent(autoencoder, mdn_rnn, parameters, agent.stride, agent.crop_bar)
    drive(crowd, list(range(cars)), max_frames=50)
    begin = time.perf_counter()
    _, lengths = drive(crowd, list(range(cars)), max_frames=frames)
    whole = (time.perf_counter() - begin) / lengths.sum()

    env, blind = make_env(bar=not agent.crop_bar), make_blind_env()
    observation = env.reset(seed=0)[0]
    actions = []
    for _ in range(frames):
        actions.append(agent.act(observation))
        observation = env.step(actions[-1])[0]
    seconds = {"reset": seconds_of(lambda: env.reset(seed=0), 10) / frames}
    for environment in (env, blind):
        environment.reset(seed=0)
    with_picture, without = (iter(actions) for _ in range(2))
    seconds["physics"] = seconds_of(lambda: blind.step(next(without)), frames)
    seconds["picture"] = (
        seconds_of(lambda: env.step(next(with_picture)), frames) - seconds["physics"]
    )
    memory, observations = FrameMemory(agent.stride), [observation] * cars

    def prepare():
        seen = np.stack([to_frame(observation, agent.crop_bar) for observation in observations])
        return to_pictures(seen, memory.push(seen))

    with torch.inference_mode():
        seconds["preparation"] = seconds_of(prepare, frames // 4) / cars
        pictures = prepare()
        seconds["V"] = seconds_of(lambda: autoencoder.encode(*pictures), frames // 4) / cars
        latents, chosen = torch.zeros(cars, 1, mdn_rnn.latent_size), torch.zeros(cars, 1, 3)
        state = tuple(torch.zeros(1, cars, mdn_rnn.hidden_size) for _ in range(2))
        seconds["M"] = (
            seconds_of(lambda: mdn_rnn.remember(latents, chosen, state), frames // 4) / cars
        )
    features = np.zeros((cars, mdn_rnn.latent_size + mdn_rnn.hidden_size), np.float32)
    seconds["C"] = seconds_of(lambda: control(parameters, features), frames // 4) / cars
    seconds["all else"] = whole - sum(seconds.values())
    return {name: 1e6 * value for name, value in {**seconds, "together": whole}.items()}


def seconds_of(call: Callable, count: int) -> float:
    """Mean seconds of one of `count` calls."""
    begin = time.perf_counter()
    for _ in range(count):
        call()
    return (time.perf_counter() - begin) / count


# Training


def measure_training(rounds: int) -> dict:
    """V and M trained the plain way and in ours, each in a fresh process with all cores."""
    tables = {}
    with tempfile.TemporaryDirectory() as folder:
        collect_rollouts(Settings.preset("laptop", episodes=100), Path(folder))
        for width in (16, 32):
            losses = {"plain": [], FAST: []}

            def train(name: str, number: int, width: int = width, losses: dict = losses) -> float:
                speed, loss = in_fresh_process(
                    train_v, name == "plain", width, Path(folder), number
                )
                losses[name].append(loss)
                return speed

            contenders = {name: functools.partial(train, name) for name in losses}
            tables[f"images a second, V of width {width}"] = take_turns(
                contenders, rounds, f"V of width {width}"
            )
            tables[f"held-out loss after {V_STEPS} steps, V of width {width}"] = {
                name: float(np.mean(values)) for name, values in losses.items()
            }
    contenders = {
        name: functools.partial(in_fresh_process, train_m, name == "plain")
        for name in ("plain", FAST)
    }
    return tables | {"frames a second, M at paper settings": take_turns(contenders, rounds, "M")}


def in_fresh_process(function: Callable, *arguments) -> Any:
    """What `function` returns in a new Python process: memory that one contender keeps must not help the next one."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as executor:
        return executor.submit(function, *arguments).result()


class Pictures(Dataset):
    """The rollouts as the plain way reads them: one frame with its difference image at a time."""

    def __init__(self, rollouts: Rollouts, stride: int):
        self.rollouts, self.stride = rollouts, stride

    def __len__(self) -> int:
        return len(self.rollouts)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        frame, difference = to_pictures(*self.rollouts.pairs(np.array([index]), self.stride))
        return frame[0].contiguous(), difference[0].contiguous()


def train_v(
    plain: bool, width: int, folder: Path, seed: int, steps: int = V_STEPS
) -> tuple[float, float]:
    """Train V for a few steps: (images a second, held-out loss after them).

    Plain is what a tutorial would write: a Dataset of single pictures, a DataLoader, PyTorch's layers, memory order and
    Adam as they come. Ours does as `train_autoencoder` and `training.fit` do, but for the falling rate, the clipping
    and the history, which neither has. Weights, batches and noise are the same.
    """
    settings = Settings.preset("laptop", width=width)
    rollouts = Rollouts(folder)
    training, heldout = rollouts.split()
    torch.manual_seed(seed)
    autoencoder = AutoEncoder(VARIANT, settings.latent_size, width)
    rng = np.random.default_rng(seed)
    batches = [np.sort(rng.choice(training, settings.v_batch)) for _ in range(steps)]
    noise = torch.from_numpy(
        rng.standard_normal((steps, settings.v_batch, settings.latent_size), np.float32)
    )
    if plain:
        for place, stride in ((2, 1), (-1, 2)):
            ours = autoencoder.decoder[place]
            layer = nn.ConvTranspose2d(
                ours.in_channels, ours.out_channels, ours.kernel_size, stride
            )
            layer.load_state_dict(ours.state_dict())
            autoencoder.decoder[place] = layer
        pictures = DataLoader(Pictures(rollouts, settings.stride), batch_sampler=batches)
    else:
        keep_freed_memory()
        autoencoder.to(memory_format=torch.channels_last)
        pairs = read_ahead(
            lambda step: rollouts.pairs(batches[step], settings.stride), range(steps)
        )
        pictures = (to_pictures(*pair) for _, pair in pairs)
    optimizer = torch.optim.Adam(
        autoencoder.parameters(), lr=settings.v_learning_rate, fused=not plain
    )
    for step, (frame, difference) in enumerate(pictures):
        if step == WARM_UP:
            begin = time.perf_counter()
        loss = autoencoder_losses(autoencoder, frame, difference, noise[step], settings)["total"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    speed = (steps - WARM_UP) * settings.v_batch / (time.perf_counter() - begin)
    with torch.no_grad():
        frame, difference = to_pictures(*rollouts.pairs(heldout[:500], settings.stride))
        zero = torch.zeros(len(frame), settings.latent_size)
        return speed, autoencoder_losses(autoencoder, frame, difference, zero, settings)[
            "total"
        ].item()


def train_m(plain: bool, seed: int, steps: int = M_STEPS, batch: int | None = None) -> float:
    """Frames a second of M in training; ours keeps freed memory and has the fused Adam. Its data are noise."""
    if not plain:
        keep_freed_memory()
    settings = Settings.preset("paper")
    batch = batch or settings.m_batch
    torch.manual_seed(seed)
    mdn_rnn = MDNRNN(settings.latent_size, settings.hidden_size, settings.mixtures)
    latents = torch.randn(batch, settings.m_sequence + 1, settings.latent_size)
    actions = torch.randn(batch, settings.m_sequence, 3)
    optimizer = torch.optim.Adam(mdn_rnn.parameters(), lr=settings.m_learning_rate, fused=not plain)
    for step in range(steps):
        if step == WARM_UP:
            begin = time.perf_counter()
        mixture, _ = mdn_rnn(latents[:, :-1], actions)
        optimizer.zero_grad()
        mdn_loss(mixture, latents[:, 1:]).backward()
        optimizer.step()
    return (steps - WARM_UP) * batch * settings.m_sequence / (time.perf_counter() - begin)


# Cluster


def measure_cluster(rounds: int) -> dict:
    """A generation of 16 agents on 4 tracks, 100 frames each, by own processes and by Dask workers on this machine.

    A second table holds what the arithmetic of `project` needs, a third what it gives.
    """
    from distributed import LocalCluster  # Dask takes a second to import, and few need it
    from distributed.protocol.pickle import dumps

    from stad_lab.io.dask_cluster import cluster

    settings = Settings.preset("laptop", population=16, tracks=4, max_frames=100, patience=0)
    agent = load_agent(VARIANT)
    population = np.repeat(agent.parameters[None], settings.population, axis=0)
    address = {"threads_per_worker": 1, "dashboard_address": None}
    with (
        worker_processes(1) as one,
        worker_processes(2) as two,
        LocalCluster(1, **address) as small,
        LocalCluster(2, **address) as large,
        cluster(small.scheduler_address) as dask_one,
        cluster(large.scheduler_address) as dask_two,
    ):
        speed = functools.partial(generation_speed, population, settings)
        executors = {"own processes, 1": one, "own processes, 2": two}
        executors |= {"Dask, 1 worker": dask_one, "Dask, 2 workers": dask_two}
        contenders = {
            name: functools.partial(
                speed, executor, hand_out(executor, PRETRAINED / VARIANT, VARIANT)
            )
            for name, executor in executors.items()
        }
        for contender in contenders.values():
            contender(rounds)
        tables = {"frames a second, a generation": take_turns(contenders, rounds, "cluster")}
        costs = {
            "frames a second, 1 car in a process": np.median(
                [crowd_speed(one, agent.parameters, 1, settings) for _ in range(rounds)]
            ),
            "frames a second, 16 in step": np.median(
                [crowd_speed(one, agent.parameters, 16, settings) for _ in range(rounds)]
            ),
            "milliseconds of Dask for a task": np.median(
                [task_cost(dask_two) for _ in range(rounds)]
            ),
            "milliseconds of CMA-ES for a generation of 64": np.median(
                [cma_cost() for _ in range(rounds)]
            ),
            "kilobytes of a task with one car": len(dumps(agent.parameters)) / 1e3,
            "kilobytes of V and M, once for each worker": len(
                dumps(read_world_model(PRETRAINED / VARIANT, VARIANT))
            )
            / 1e3,
        }
    tables["costs"] = {name: float(value) for name, value in costs.items()}
    tables["projected efficiency, 1,024 episodes of 1,000 frames"] = {
        f"{workers:,} workers": project(tables["costs"], workers) for workers in (1, 2, 64, 1024)
    }
    return tables


def task_cost(executor: Executor, count: int = 400) -> float:
    """Milliseconds that the executor takes for a task that does nothing."""
    begin = time.perf_counter()
    for future in [executor.submit(int, number) for number in range(count)]:
        future.result()
    return 1e3 * (time.perf_counter() - begin) / count


def cma_cost(generations: int = 5) -> float:
    """Milliseconds that CMA-ES takes to ask for 64 agents of 867 parameters and to be told their fitnesses."""
    with threadpool_limits(1):
        strategy = make_strategy(
            initial_parameters(32, 256), Settings.preset("paper", population=64)
        )
        begin = time.perf_counter()
        for _ in range(generations):
            population = np.array(strategy.ask())
            strategy.tell(population, (population**2).sum(axis=1))
        return 1e3 * (time.perf_counter() - begin) / generations


def project(
    costs: dict[str, float], workers: int, episodes: int = 1024, frames: int = 1000
) -> float:
    """Efficiency of so many workers: their speed-up over one, divided by their number.

    Episodes are independent, so they are shared out evenly, at most 16 in step. What one process must do for all comes
    on top: Dask handles every task by itself, and CMA-ES waits for the last car before it asks again.
    """

    def seconds(count: int) -> float:
        cars = min(16, episodes // count)  # that drive in step
        alone, crowd = (
            costs[f"frames a second, {name}"] for name in ("1 car in a process", "16 in step")
        )
        speed = alone + (crowd - alone) * (cars - 1) / 15  # between the two that were measured
        serial = costs["milliseconds of Dask for a task"] * episodes / cars
        return (
            episodes / count * frames / speed
            + (serial + costs["milliseconds of CMA-ES for a generation of 64"]) / 1e3
        )

    return seconds(1) / (workers * seconds(workers))


PARTS = {
    "parity": measure_parity,
    "renderer": measure_renderer,
    "loop": measure_loop,
    "training": measure_training,
    "cluster": measure_cluster,
}
