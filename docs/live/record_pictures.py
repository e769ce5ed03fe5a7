"""The pictures of the index of live pages: `python docs/live/record_pictures.py SITE`.

SITE is the folder of a built site. Needs Playwright and the Chromium of the tests.
"""

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright
from record_tab import launch

PICTURES = Path(__file__).parent / "pictures"
SHOWN = {  # page -> what of it is shown
    "story": "[data-figure=dream] .four",
    "race": "#race",
    "evolve": "#map",
    "dream": ".stage.dreaming",
    "latent": ".small",
    "nat": "#strip",
    "evolution": "#track",
    "speeds": ".stage",
}
SIZE = (400, 220)  # pixels


def record(site: Path) -> None:
    """Write one WebP picture for each page."""
    PICTURES.mkdir(exist_ok=True)
    with sync_playwright() as playwright:
        browser = launch(playwright)
        page = browser.new_page(viewport={"width": 900, "height": 800})
        for name, part in SHOWN.items():
            page.goto((site.resolve() / "docs" / "live" / f"{name}.html").as_uri())
            page.wait_for_selector("#live[data-state=ready]")
            page.add_style_tag(content="#card { display: none }")
            page.locator(part).scroll_into_view_if_needed()
            while name == "evolve" and not page.evaluate("stad.page.log.at(-1)?.laps"):
                page.click("#step")
                page.wait_for_function("!stad.page.busy", timeout=300_000)
            page.wait_for_timeout(3000)  # until something has moved
            picture = Image.open(io.BytesIO(page.locator(part).screenshot())).convert("RGB")
            wide = min(picture.width, picture.height * SIZE[0] // SIZE[1])
            tall = wide * SIZE[1] // SIZE[0]
            left, top = (picture.width - wide) // 2, (picture.height - tall) // 2
            cut = picture.crop((left, top, left + wide, top + tall)).resize(SIZE)
            cut.save(PICTURES / f"{name}.webp", quality=80)
        browser.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/live/record_pictures.py SITE")
    record(Path(sys.argv[1]))
