"""The driving widget without a browser: buttons, held pedals and the loop.

How keys reach it is tested in test_browser.py.
"""

import functools
import threading
import time

import numpy as np
import pytest

from stad_course.play.dashboard import SIZE, end_lines, to_screen
from stad_course.play.race import drive_ghost
from stad_course.play.session import Session, pose_of
from stad_course.play.widget import Loop, Seat
from stad_lab import load_agent


@pytest.fixture(scope="module", autouse=True)
def driven_once():
    """The agent's lap of a track, which is the same for every seat, takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        lap = functools.cache(lambda track: drive_ghost(load_agent("input"), track))
        patch.setattr("stad_course.play.widget.drive_ghost", lambda _, track: lap(track))
        yield


@pytest.fixture
def make_seat():
    """A function that makes a seat; all loops are stopped at the end."""
    seats = []

    def make(session=None):
        seats.append(Seat(session or Session(load_agent("input"), track=3)))
        return seats[-1]

    yield make
    for seat in seats:
        seat.go.value = False


def wait_for(fact):
    """Wait until fact() holds, half a minute at most."""
    end = time.monotonic() + 30
    while not fact():
        assert time.monotonic() < end
        time.sleep(0.01)


def loops():
    """How many cars drive in this process."""
    return sum(
        isinstance(thread, Loop) and not thread.stopped.is_set() for thread in threading.enumerate()
    )


def test_the_pedals_that_the_page_sends_are_held_and_others_are_refused(make_seat):
    seat = make_seat()
    seat.wire.value = "gas left"
    assert seat.session.hand.held == {"gas", "left"}
    seat.wire.value = "left"
    assert seat.session.hand.held == {"left"}
    seat.wire.value = ""
    assert seat.session.hand.held == set()
    with pytest.raises(ValueError, match="pedal='clutch'"):
        seat.wire.value = "clutch"


def test_the_game_has_the_keys_from_drive_to_pause_and_keeps_them_when_an_episode_ends(make_seat):
    seat = make_seat()

    def has_keys():
        return "stad-lab-driving" in seat.view._dom_classes

    assert not has_keys()
    seat.go.value = True
    assert has_keys()
    seat.go.value = False
    assert not has_keys()
    seat = make_seat()
    step = seat.session.env.step
    seat.session.env.step = lambda action: (*step(action)[:2], True, False, {})
    seat.go.value = True
    wait_for(lambda: not seat.go.value)
    assert has_keys()  # a key that is still held must not become a command of JupyterLab


def test_the_loop_drives_and_pauses_with_pedals_held_and_says_who_drives(make_seat):
    seat = make_seat()
    before = seat.picture.value
    seat.go.value, seat.wire.value = True, "gas"
    wait_for(lambda: len(seat.session.rows) > 5 and "keys held: gas" in seat.status.value)
    assert seat.picture.value != before and "You drive on track 3" in seat.status.value
    seat.go.value = False
    wait_for(lambda: not loops() and "paused" in seat.status.value)
    driven = len(seat.session.rows)
    seat.wire.value = ""
    time.sleep(0.1)
    assert len(seat.session.rows) == driven and seat.session.hand.held == set()
    for _ in range(9):  # pause and continue at once, while the old loop is still in a step
        seat.go.value = not seat.go.value
    driven = len(seat.session.rows)
    wait_for(lambda: len(seat.session.rows) > driven + 3)
    assert seat.go.value and loops() == 1
    seat.swap.click()
    assert seat.session.driver == seat.driver.value == "agent"
    assert "The agent drives" in seat.status.value


def test_the_drivers_change_after_another_cell_has_changed_them(make_seat):
    seat = make_seat()
    seat.session.give("agent")
    seat.swap.click()
    assert seat.session.driver == seat.driver.value == "hand"
    seat.swap.click()
    assert seat.session.driver == seat.driver.value == "agent"


def test_worlds_change_while_the_agent_drives_and_the_temperature_reaches_the_dream(make_seat):
    seat = make_seat()
    seat.driver.value, seat.go.value = "agent", True
    wait_for(lambda: len(seat.session.rows) > 3)
    seat.world.value, seat.temperature.value = "dream", 0.3
    wait_for(lambda: len(seat.session.dream_rows) > 3)
    assert seat.session.dream.temperature == 0.3
    seat.world.value, driven = "real", len(seat.session.rows)
    wait_for(lambda: len(seat.session.rows) > driven)
    seat.track.value = 8
    seat.begin.click()
    wait_for(lambda: "track 8" in seat.status.value and seat.session.rows)
    assert seat.go.value and seat.error == ""


def test_a_second_seat_stops_the_first_and_the_last_to_start_drives(make_seat):
    first = make_seat()
    first.go.value = True
    wait_for(lambda: first.session.rows)
    second = make_seat(first.session)  # as when the cell is run again
    wait_for(lambda: not first.go.value and not loops())
    other = make_seat()
    second.go.value = True
    other.go.value = True
    wait_for(lambda: other.session.rows)
    assert loops() == 1 and not second.go.value


def test_the_loop_ends_with_the_episode_and_shows_an_error(make_seat):
    seat = make_seat()
    seat.session.real_ended = True
    seat.go.value = True
    wait_for(lambda: not seat.go.value and "the episode has ended" in seat.status.value)
    seat.begin.click()
    seat.session.step = lambda: 1 / 0
    wait_for(
        lambda: not seat.go.value and "ZeroDivisionError: division by zero" in seat.status.value
    )


def test_the_car_waits_for_a_slow_browser_and_for_none_that_is_not_there(make_seat):
    seat = make_seat()
    assert not seat.browser_is_behind()
    for _ in range(40):
        seat.show()
    assert seat.sent.value == 40 and not seat.browser_is_behind()  # nobody has ever answered
    seat.seen.value = 20
    assert seat.browser_is_behind()
    seat.seen.value = 30
    assert not seat.browser_is_behind()


def test_the_agents_lap_is_driven_beside_and_drawn_where_the_camera_would_see_it(make_seat):
    seat = make_seat()
    session = seat.session
    alone = drive_ghost(session.agent, session.track)
    assert np.array_equal(seat.ghost.poses, alone.poses) and alone.score > 900
    session.give("agent")
    for _ in range(60):
        session.step()
    assert np.allclose(session.path(), alone.poses[:60, :2])
    pose = pose_of(session.car)
    own = to_screen(np.array([pose[:2]]), pose, 1.2)[0]
    assert own == pytest.approx([SIZE / 2, SIZE * 3 / 4])  # where the observation shows the car
    seat.show()
    assert seat.moment.value.count("<polygon") == 1 and "ahead by" in seat.moment.value
    assert alone.behind(int(session.car["tiles_visited"]), len(session.rows)) < 0.5


def test_an_episode_by_hand_counts_and_one_with_help_does_not_and_restart_keeps_the_track(
    make_seat,
):
    seat = make_seat()
    session = seat.session
    step = session.env.step
    session.env.step = lambda action: (*step(action)[:2], len(session.rows) > 8, False, {})
    for driver in ("hand", "agent"):
        session.give(driver)
        while not session.ended:
            session.step()
        card = ". ".join(end_lines(session, seat.ghost))
        assert f"{session.score:.0f} points" in card and f"{seat.ghost.score:.0f} points" in card
        assert ("does not count" in card) == (driver == "agent")
        seat.show()
        assert "once more" in seat.moment.value
        best = session.best[session.track]
        session.begin(session.track)
    assert best == session.best[session.track]
    seat.again.click()
    assert seat.go.value and session.track == 3 and not session.real_ended
