"""The vectorized environment does what Gymnasium's SyncVectorEnv does with single ones."""

import gymnasium as gym
import numpy as np
import psutil
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from stad_lab.envs.car_racing import make_env
from stad_lab.envs.frames import BAR_TOP
from stad_lab.envs.vector import CarRacingVector

CARS, LIMIT = 3, 20  # frames of an episode
OUTSIDE = (400.0, 0.0)  # world units, beyond the field: the episode ends


def make_both(mode, **kwargs):
    ours = CarRacingVector(CARS, LIMIT, mode, **kwargs)
    makers = [lambda: make_env(max_episode_steps=LIMIT, **kwargs)] * CARS
    return ours, SyncVectorEnv(makers, autoreset_mode=mode)


def leave_field(envs, car):
    """Put a car beyond the field."""
    single = isinstance(envs, SyncVectorEnv)
    cars = envs.envs[car].unwrapped.cars if single else envs.cars
    state = cars.cars[0 if single else car]
    state["position"] += OUTSIDE
    state["center"] += OUTSIDE


def assert_equal(one, other):
    """What `step` or `reset` returned, with everything in its dicts."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            assert_equal(one[name], other[name])
    elif isinstance(one, tuple):
        for part, same in zip(one, other, strict=True):
            assert_equal(part, same)
    elif np.asarray(one).dtype.hasobject:
        for part, same in zip(one, other, strict=True):
            assert (part is None) == (same is None)
            assert part is None or np.array_equal(part, same)
    else:
        assert np.array_equal(one, other)
        assert one.dtype == other.dtype


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("continuous", [True, False])
def test_it_equals_sync_vector_env_over_ends_of_both_kinds(mode, continuous):
    both = make_both(mode, continuous=continuous)
    assert_equal(*(envs.reset(seed=5) for envs in both))
    both[0].action_space.seed(1)
    ends = np.zeros(2, int)
    for step in range(3 * LIMIT):
        if step in (7, 30):
            for envs in both:
                leave_field(envs, step % CARS)
        actions = both[0].action_space.sample()
        found = [envs.step(actions) for envs in both]
        assert_equal(*found)
        ends += found[0][2].sum(), found[0][3].sum()
    assert ends[0] == 2 and ends[1] >= 4


def test_with_autoreset_off_the_mask_says_who_begins_anew():
    both = make_both(AutoresetMode.DISABLED)
    assert_equal(*(envs.reset(seed=6) for envs in both))
    for _ in range(5):
        found = [envs.step(np.full((CARS, 3), 0.3, np.float32)) for envs in both]
    for envs in both:
        leave_field(envs, 1)
    found = [envs.step(np.zeros((CARS, 3), np.float32)) for envs in both]
    assert_equal(*found)
    assert found[0][2].tolist() == [False, True, False]
    with pytest.raises(RuntimeError, match=r"cars \[1\]: their episodes have ended, call reset"):
        both[0].step(np.zeros((CARS, 3), np.float32))
    mask = np.array([False, True, False])
    options = [{"reset_mask": mask.copy()} for _ in both]
    found = [
        envs.reset(seed=[None, 9, None], options=one)
        for envs, one in zip(both, options, strict=True)
    ]
    assert_equal(found[0][0], found[1][0])


@pytest.mark.parametrize("mask", [[False] * CARS, [True], [2] + [0] * (CARS - 1)])
def test_a_mask_of_no_car_of_another_shape_or_of_numbers_is_refused(mask):
    envs = CarRacingVector(CARS, autoreset_mode="Disabled")
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array(mask)})


def test_the_first_reset_is_of_all_cars():
    envs = CarRacingVector(CARS)
    with pytest.raises(ValueError, match="the first reset is of all, leave it out"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(ResetNeeded):
        envs.step(np.zeros((CARS, 3), np.float32))


def test_seeds_count_up_from_one_number_or_are_given_for_each_car():
    envs = CarRacingVector(CARS)
    one, several = envs.reset(seed=4)[0], envs.reset(seed=[4, 5, 6])[0]
    assert np.array_equal(one, several)
    assert np.array_equal(one[2], make_env().reset(seed=6)[0])
    assert not np.array_equal(envs.reset()[0], one)
    assert envs.reset(seed=[7, None, 9]) and envs.np_random_seed[::2] == (7, 9)
    before = [state.bit_generator.state for state in envs.np_random], envs.cars.cars.copy()
    for seeds in ([1, 2], "abc", [1, 2, "3"], [1, 2, -1], -1):
        with pytest.raises(ValueError, match=r"expected (3 seeds|one for|a whole number)"):
            envs.reset(seed=seeds)
    assert before[0] == [state.bit_generator.state for state in envs.np_random]
    assert np.array_equal(before[1], envs.cars.cars)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_step_before_the_first_reset_is_refused(mode):
    with pytest.raises(ResetNeeded, match="call reset"):
        CarRacingVector(CARS, autoreset_mode=mode).step(np.zeros((CARS, 3), np.float32))


@pytest.mark.parametrize(
    "arguments", [{"num_envs": 0}, {"max_episode_steps": 0}, {"render_mode": "rgb_array"}]
)
def test_impossible_settings_are_refused(arguments):
    with pytest.raises(ValueError, match=r"expected a whole number from 1|choose one of None"):
        CarRacingVector(**arguments)


def test_an_action_that_is_not_finite_is_refused():
    envs = CarRacingVector(CARS)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="expected finite numbers"):
        envs.step(np.full((CARS, 3), np.nan))


@pytest.mark.parametrize("continuous", [True, False])
def test_actions_for_more_or_fewer_cars_are_refused_also_after_an_end(continuous):
    envs = CarRacingVector(CARS, continuous=continuous, max_episode_steps=1)
    envs.reset(seed=0)
    for _ in range(2):  # driving, then about to begin anew
        for wrong in (np.zeros((CARS + 1, 3)), np.zeros(CARS - 1, int), None, "abc"):
            with pytest.raises(ValueError, match=r"actions( of shape|=)"):
                envs.step(wrong)
        envs.step(envs.action_space.sample())


def test_close_gives_the_tracks_back_and_may_come_twice():
    envs = CarRacingVector(CARS)
    envs.reset(seed=0)
    envs.close()
    envs.close()
    assert envs.cars is None and envs.closed
    for call in (envs.reset, lambda: envs.step(np.zeros((CARS, 3)))):
        with pytest.raises(ClosedEnvironmentError, match="make another one"):
            call()


def test_without_the_bar_only_the_bar_is_missing():
    whole, cropped = (CarRacingVector(2, bar=bar).reset(seed=0)[0] for bar in (True, False))
    assert np.array_equal(whole[:, :BAR_TOP], cropped[:, :BAR_TOP])
    assert whole[:, BAR_TOP:].any() and not cropped[:, BAR_TOP:].any()


def test_vector_wrappers_of_gymnasium_work_on_it():
    envs = gym.wrappers.vector.RecordEpisodeStatistics(CarRacingVector(2, LIMIT))
    envs.reset(seed=0)
    for _ in range(LIMIT):
        info = envs.step(envs.action_space.sample())[-1]
    assert info["episode"]["l"].tolist() == [LIMIT] * 2


@pytest.mark.long
def test_a_million_steps_take_no_more_memory_than_the_first_thousands():
    cars = gym.make_vec("stad_lab:StadLab/CarRacing-v3", num_envs=16)
    cars.reset(seed=0)
    actions, used = np.full((16, 3), (0.1, 0.3, 0.0), np.float32), []
    for _ in range(5):
        for _ in range(1_000_000 // 16 // 5):
            cars.step(actions)
        used.append(psutil.Process().memory_info().rss / 2**20)
    cars.close()
    assert used[-1] - used[0] < 5  # MiB
