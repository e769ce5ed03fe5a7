"""While a car drives, keys belong to the game wherever the pointer is: none edits the notebook."""

import pytest
from test_browser import SLOW, lab, run, sees_another_picture, wait_for  # noqa: F401

SEAT = """
from stad_lab import load_agent
from stad_lab.play.session import Session
from stad_lab.play.widget import drive_yourself
session = Session(load_agent("input"), track=1)
for _ in range(frames):
    session.step()
drive_yourself(session)
"""


@pytest.fixture(params=[0])
def seat(run, request):  # noqa: F811
    """A page in JupyterLab's command mode, the pointer in a corner: (page, reads, cells).

    The parameter is the number of frames that were driven before.
    """
    page = run(f"frames = {request.param}\n{SEAT}", "1 + 1")
    status = page.locator(".widget-html", has_text="frame")

    def reads(text):
        wait_for(lambda: text in status.first.inner_text(), text)

    reads("You drive on track 1")
    page.locator(".jp-InputPrompt").first.click()  # selects the first cell, in command mode
    page.mouse.move(5, 5)
    return page, reads, lambda: page.locator(".jp-CodeCell").count()


def press_drive(page):
    """Press the button and move the pointer off everything that is ours."""
    picture = page.locator(".stad-lab-pixels")
    sees_another_picture(picture, lambda: page.get_by_role("button", name="drive").click())
    page.mouse.move(5, 5)
    wait_for(lambda: listening(page), "the orange frame")


def listening(page):
    """Whether the picture's frame says that keys drive."""
    return "stad-lab-listening" in page.locator(".stad-lab-pixels").get_attribute("class")


def test_buttons_and_keys_drive_with_the_pointer_elsewhere_and_no_cell_is_deleted_or_inserted(seat):
    page, reads, cells = seat
    press_drive(page)
    page.locator(".stad-lab-gas").hover()
    page.mouse.down()
    reads("keys held: gas")
    page.keyboard.down("a")
    reads("keys held: gas, left")
    page.mouse.up()
    reads("keys held: left")
    page.mouse.down()
    page.mouse.move(5, 5)  # the pointer leaves the button
    reads("keys held: left")
    page.keyboard.up("a")
    for key, pedal in (("d", "right"), ("d", "right"), ("a", "left"), ("ArrowUp", "gas")):
        page.keyboard.down(key)
        reads(f"keys held: {pedal}")
        page.keyboard.up(key)
        reads("keys held: none")
    page.keyboard.down("w")
    page.keyboard.down("a")
    reads("keys held: gas, left")
    page.keyboard.up("w")
    reads("keys held: left")
    page.keyboard.up("a")
    for key in "ddaabbxxmy":  # commands of JupyterLab, some of them also keys of the game
        page.keyboard.press(key)
    page.keyboard.press("t")
    reads("The agent drives on track 1")
    page.keyboard.press("p")
    reads("paused")
    wait_for(lambda: not listening(page), "the end of the orange frame")
    assert cells() == 2
    page.keyboard.press("b")  # paused: the keys are JupyterLab's again
    wait_for(lambda: cells() == 3, "a new cell")


def test_the_notebook_has_the_keys_while_text_is_typed_and_after_escape(seat):
    page, reads, cells = seat
    press_drive(page)
    editor = page.locator(".jp-CodeCell .cm-content").nth(1)
    editor.click()
    page.keyboard.press("End")
    page.keyboard.type("000 # wasd")
    assert "1 + 1000 # wasd" in editor.inner_text() and not listening(page)
    page.keyboard.press("Control+Enter")  # the notebook is in command mode now
    page.get_by_text("1001", exact=True).wait_for(timeout=1000 * SLOW)
    wait_for(lambda: listening(page), "the orange frame")
    page.keyboard.press("d")
    page.keyboard.press("d")
    prompt = page.locator(".jp-InputPrompt").nth(1)
    before = prompt.inner_text()
    page.keyboard.press("Shift+Enter")
    wait_for(lambda: prompt.inner_text() not in (before, "[*]:"), "a second run of the cell")
    count = cells()  # Shift+Enter may have added one below the last, for text
    page.locator(".jp-InputPrompt").first.click()
    wait_for(lambda: listening(page), "the orange frame")
    page.keyboard.down("w")
    reads("keys held: gas")
    page.keyboard.press("Escape")
    reads("keys held: none")
    assert not listening(page)
    page.locator(".jp-InputPrompt").first.click()
    page.keyboard.press("b")
    wait_for(lambda: cells() == count + 1, "a new cell")
    reads("pictures a second")
    page.locator(".stad-lab-pixels").hover()  # the pointer on the picture takes them again
    wait_for(lambda: listening(page), "the orange frame")
    page.keyboard.press("b")
    assert cells() == count + 1


@pytest.mark.parametrize("seat", [850], indirect=True)
def test_keys_that_are_held_when_an_episode_ends_do_not_edit_the_notebook(seat):
    page, reads, cells = seat
    press_drive(page)
    page.keyboard.down("w")
    page.keyboard.down("d")
    reads("keys held: gas, right")
    reads("the episode has ended")
    for _ in range(6):
        page.keyboard.down("d")  # a held key repeats
    assert cells() == 2
    page.keyboard.up("d")
    page.keyboard.press("p")
    wait_for(lambda: not listening(page), "the end of the orange frame")
