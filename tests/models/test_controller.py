"""C: 867 parameters in one flat vector, actions within bounds, nothing that is not finite."""

import numpy as np
import pytest

from stad_lab.models.controller import (
    check_parameters,
    control,
    initial_parameters,
    parameter_count,
    seen_columns,
    squash,
)


def random_parameters(cars, scale=1.0):
    """Controllers for 32 + 8 features, float64 (cars, parameters)."""
    return scale * np.random.default_rng(0).standard_normal((cars, parameter_count(32, 8)))


def random_features(cars):
    """z and h of some cars, float32 (cars, 40)."""
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


def test_the_first_controller_drives_straight_on_with_gentle_gas():
    action = control(initial_parameters(32, 8, gas=-0.5), random_features(2))
    assert action == pytest.approx(np.array([[0, (np.tanh(-0.5) + 1) / 2, 0]] * 2))
    assert 0.26 < action[0, 1] < 0.28


def test_actions_are_float32_within_bounds():
    actions = control(random_parameters(1, scale=100)[0], random_features(500))
    assert (actions.dtype, actions.shape) == (np.float32, (500, 3))
    assert actions.min(axis=0).tolist() == [-1, 0, 0]
    assert actions.max(axis=0).tolist() == [1, 1, 1]
    assert squash(np.zeros((2, 4, 3))).shape == (2, 4, 3)


def test_a_controller_for_each_car_gives_what_each_gives_alone():
    parameters, features = random_parameters(6, scale=0.1), random_features(6)
    together = control(parameters, features)
    for car in range(6):
        assert np.array_equal(together[car], control(parameters[car], features[car : car + 1])[0])
    assert len(np.unique(together[:, 0])) == 6


@pytest.mark.parametrize(
    ("features", "seen"), [("z, h", [1, 1, 1]), ("z", [1, 1, 0]), ("h", [0, 0, 1])]
)
def test_the_columns_of_z_and_of_h_are_separate(features, seen):
    assert seen_columns(features, 2, 1).tolist() == list(map(bool, seen))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_not_finite_is_refused(bad):
    features = random_features(3)
    features[1, 7] = bad
    parameters = random_parameters(1)[0]
    parameters[:40] = 0
    message = r"action \[.*nan.*\]: expected finite numbers; check z, h and C"
    with pytest.raises(ValueError, match=message):
        control(parameters, features)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_parameters_that_are_not_finite_are_refused(bad):
    parameters = random_parameters(1)[0]
    parameters[5] = bad
    message = r"here.safetensors: parameters that are not finite.*evolve the controller again"
    with pytest.raises(ValueError, match=message):
        check_parameters(parameters, len(parameters), "here.safetensors")


def test_parameters_of_another_size_are_refused():
    message = r"shape \(123,\), expected \(867,\) or \(cars, 867\).*another size"
    with pytest.raises(ValueError, match=message):
        check_parameters(random_parameters(1)[0], 867)


def test_parameters_that_are_whole_numbers_are_refused_because_z_and_h_would_be_cut_to_them():
    with pytest.raises(ValueError, match="expected parameters as an array of floats"):
        check_parameters(np.ones(867, int), 867)
