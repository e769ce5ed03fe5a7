"""The seat without a browser: keys, buttons and the loop do what they say."""

import threading
import time

import pytest

from stad_lab import load_agent
from stad_lab.play.session import Session
from stad_lab.play.widget import FRAME_LISTENING, Loop, Seat


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


def key(kind, code, **more):
    """An event as ipyevents sends it."""
    return {"type": kind, "code": code, **more}


def loops():
    """How many cars drive in this process."""
    return sum(
        isinstance(thread, Loop) and not thread.stopped.is_set() for thread in threading.enumerate()
    )


def test_keys_go_down_and_come_up_and_all_come_up_when_the_pointer_leaves(make_seat):
    seat = make_seat()
    seat.on_event({"type": "mouseenter"})
    assert seat.picture.layout.border_top == FRAME_LISTENING
    seat.on_event(key("keydown", "KeyW"))
    seat.on_event(key("keydown", "ArrowLeft"))
    assert seat.session.hand.held == {"gas", "left"}
    seat.on_event(key("keyup", "KeyW"))
    assert seat.session.hand.held == {"left"}
    seat.on_event({"type": "mouseleave"})
    assert seat.session.hand.held == set() and seat.picture.layout.border_top != FRAME_LISTENING


def test_the_loop_drives_and_pauses_with_keys_held_and_says_who_drives(make_seat):
    seat = make_seat()
    before = seat.picture.value
    seat.on_event(key("keydown", "KeyP"))
    seat.on_event(key("keydown", "KeyP", repeat=True))  # a held key is pressed once
    seat.on_event(key("keydown", "ArrowUp"))
    wait_for(lambda: len(seat.session.rows) > 5)
    assert seat.picture.value != before and "You drive on track 3" in seat.status.value
    seat.on_event(key("keydown", "KeyP"))
    wait_for(lambda: not loops() and "paused" in seat.status.value)
    driven = len(seat.session.rows)
    seat.on_event(key("keyup", "ArrowUp"))
    time.sleep(0.1)
    assert len(seat.session.rows) == driven and seat.session.hand.held == set()
    for _ in range(9):  # pause and drive on at once, while the old loop is still in a step
        seat.go.value = not seat.go.value
    driven = len(seat.session.rows)
    wait_for(lambda: len(seat.session.rows) > driven + 3)
    assert seat.go.value and loops() == 1
    seat.on_event(key("keydown", "KeyT"))
    assert (
        seat.session.driver == seat.driver.value == "agent"
        and "The agent drives" in seat.status.value
    )


def test_the_key_changes_drivers_after_another_cell_has_given_the_wheel(make_seat):
    seat = make_seat()
    seat.session.give("agent")
    seat.on_event(key("keydown", "KeyT"))
    assert seat.session.driver == seat.driver.value == "hand"
    seat.on_event(key("keydown", "KeyT"))
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
    assert seat.go.value and seat.error == "" and seat.session.earlier[-1][0] == 3


def test_a_second_seat_stops_the_first_and_the_last_that_starts_drives(make_seat):
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
