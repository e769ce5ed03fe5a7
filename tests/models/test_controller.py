"""C: 867 parameters in one flat vector, actions within bounds, nothing that is not finite."""

import numpy as np
import pytest

from stad_lab.models.controller import (
    check_parameters,
    control,
    initial_parameters,
    parameter_count,
)


def random_parameters(cars, scale=1.0):
    """As many controllers for 32 + 8 features."""
    return scale * np.random.default_rng(0).standard_normal((cars, parameter_count(32, 8)))


def random_features(cars):
    """z and h of as many cars."""
    return np.random.default_rng(1).standard_normal((cars, 40)).astype(np.float32)


def test_world_models_controller_has_867_parameters():
    assert parameter_count(32, 256) == 867
    assert initial_parameters(32, 256).shape == (867,)


def test_the_flat_vector_holds_rows_of_weights_then_biases():
    parameters = random_parameters(1)[0]
    features = random_features(5)
    weights, bias = parameters[:120].reshape(3, 40), parameters[120:]
    for feature, action in zip(features, control(parameters, features), strict=True):
        steering, gas, brake = (np.tanh(weights[row] @ feature + bias[row]) for row in range(3))
        assert action == pytest.approx([steering, (gas + 1) / 2, max(0, brake)], abs=1e-6)


def test_evolution_starts_straight_on_with_gentle_gas():
    action = control(initial_parameters(32, 8, gas=-0.5), random_features(2))
    assert action == pytest.approx(np.array([[0, (np.tanh(-0.5) + 1) / 2, 0]] * 2))
    assert 0.26 < action[0, 1] < 0.28


def test_actions_are_float32_within_bounds():
    actions = control(random_parameters(1, scale=100)[0], random_features(500))
    assert actions.dtype == np.float32
    assert actions.shape == (500, 3)
    assert actions.min(axis=0).tolist() == [-1, 0, 0]
    assert actions.max(axis=0).tolist() == [1, 1, 1]


def test_a_controller_for_each_car_gives_what_each_gives_alone():
    parameters, features = random_parameters(6, scale=0.1), random_features(6)
    together = control(parameters, features)
    for car in range(6):
        assert np.array_equal(together[car], control(parameters[car], features[car : car + 1])[0])
    assert len(np.unique(together[:, 0])) == 6


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_not_finite_is_refused(bad):
    features = random_features(3)
    features[1, 7] = bad
    parameters = random_parameters(1)[0]
    parameters[:40] = 0
    with pytest.raises(
        ValueError,
        match=r"action \[.*nan.*\] before squashing, expected finite numbers: check z, h and C",
    ):
        control(parameters, features)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_parameters_that_are_not_finite_are_refused(bad):
    parameters = random_parameters(1)[0]
    parameters[5] = bad
    with pytest.raises(
        ValueError,
        match=r"here.safetensors: parameters that are not finite.*evolve the controller again",
    ):
        check_parameters(parameters, len(parameters), "here.safetensors")


def test_parameters_of_another_size_are_refused():
    with pytest.raises(
        ValueError, match=r"shape \(123,\), expected \(867,\) or \(cars, 867\).*another size"
    ):
        check_parameters(random_parameters(1)[0], 867)
