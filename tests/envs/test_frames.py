"""From an observation to a frame and a difference image."""

import cv2
import numpy as np
import pytest

from stad_lab.envs.frames import (
    BAR_TOP,
    FrameMemory,
    difference_image,
    earlier_frames,
    earlier_index,
    episode_differences,
    to_frame,
    to_pictures,
)


def random_frames(count, seed=0):
    """Frames of noise, uint8 (count, 64, 64, 3)."""
    return np.random.default_rng(seed).integers(0, 256, (count, 64, 64, 3), np.uint8)


def test_a_frame_is_64_by_64_and_leaves_the_bar_out(observations):
    frame = to_frame(observations[40])
    assert (frame.shape, frame.dtype) == ((64, 64, 3), np.uint8)
    other_bar = observations[40].copy()
    other_bar[BAR_TOP:] = 255
    assert np.array_equal(to_frame(other_bar), frame)
    with_bar = [to_frame(picture, crop_bar=False) for picture in (other_bar, observations[40])]
    assert not np.array_equal(*with_bar)


def test_a_frame_shows_all_that_is_above_the_bar(observations):
    frame = to_frame(observations[40])
    whole = cv2.resize(observations[40][:84], (64, 64), interpolation=cv2.INTER_AREA)
    assert np.array_equal(frame, whole)
    for row, column in [(0, 0), (0, 95), (BAR_TOP - 1, 0), (BAR_TOP - 1, 95)]:
        changed = observations[40].copy()
        changed[row, column] ^= 255
        assert not np.array_equal(to_frame(changed), frame)


@pytest.mark.parametrize("crop_bar", [True, False])
def test_a_plain_colour_stays_that_colour(crop_bar):
    plain = np.full((96, 96, 3), (10, 200, 30), np.uint8)
    assert (to_frame(plain, crop_bar) == (10, 200, 30)).all()


def test_a_difference_image_is_the_change_between_minus_one_and_one():
    earlier, frame = random_frames(2)
    earlier[0, 0], frame[0, 0] = (0, 255, 7), (255, 0, 7)
    difference = difference_image(frame, earlier)
    assert difference.dtype == np.float32
    assert difference[0, 0].tolist() == [1, -1, 0]
    assert np.abs(difference).max() == 1
    assert np.allclose(difference, frame / 255 - earlier / 255, atol=1e-6)
    assert np.array_equal(difference_image(earlier, frame), -difference)


def test_one_frame_a_batch_and_an_episode_have_bit_equal_difference_images():
    every_value = np.arange(256, dtype=np.uint8)
    frames = np.stack(np.meshgrid(every_value, every_value)).reshape(2, 256, 256, 1)
    whole = difference_image(*frames)
    assert np.array_equal(to_pictures(*frames)[1], whole)
    rows = [difference_image(*pair) for pair in zip(*frames, strict=True)]
    assert np.array_equal(rows, whole)
    assert np.array_equal(episode_differences(frames[::-1], 1)[1], whole)


@pytest.mark.parametrize("stride", [1, 4])
def test_differences_are_zero_until_stride_frames_exist(stride):
    frames = random_frames(8)
    differences = episode_differences(frames, stride)
    assert not differences[:stride].any()
    for t in range(stride, 8):
        assert np.array_equal(differences[t], difference_image(frames[t], frames[t - stride]))
    memory = FrameMemory(stride)
    seen = [difference_image(frame, memory.push(frame)) for frame in frames]
    assert np.array_equal(seen, differences)


@pytest.mark.parametrize("stride", [0, -1])
@pytest.mark.parametrize("use", [FrameMemory, lambda stride: earlier_frames(np.zeros(9), stride)])
def test_a_stride_below_one_is_refused(use, stride):
    with pytest.raises(ValueError, match=f"stride={stride}: expected at least 1 frame"):
        use(stride)


def test_an_episode_of_1000_frames_has_996_difference_images():
    assert (earlier_index(np.arange(1000), 4) < np.arange(1000)).sum() == 996


@pytest.mark.parametrize(
    "observation",
    [
        np.zeros((64, 64, 3), np.uint8),
        np.zeros((1, 96, 96, 3), np.uint8),
        np.zeros((96, 96), np.uint8),
        np.zeros((96, 96, 3), np.float32),
    ],
)
def test_another_observation_is_refused_with_what_was_expected(observation):
    expected = r"expected uint8 and \(96, 96, 3\).*without wrappers"
    with pytest.raises(ValueError, match=expected) as error:
        to_frame(observation)
    assert str(observation.dtype) in str(error.value)
    assert str(observation.shape) in str(error.value)


@pytest.mark.parametrize("observation", [None, [[0]]])
def test_what_is_no_array_is_refused(observation):
    with pytest.raises(ValueError, match=f"{type(observation).__name__}.*expected uint8"):
        to_frame(observation)


def test_frames_that_are_no_bytes_or_of_two_shapes_are_refused_and_stay_as_they_are():
    frames = random_frames(2)
    shapes = r"\(64, 64, 3\).*\(32, 64, 3\).*two uint8 arrays of one shape"
    with pytest.raises(ValueError, match=shapes):
        difference_image(frames[0], frames[1][:32])
    numbers = np.full((2, 64, 64, 3), 255, np.float32)
    with pytest.raises(ValueError, match=r"float32.*two uint8 arrays"):
        to_pictures(numbers, numbers)
    assert (numbers == 255).all()
