"""Faults of a built site: broken links, images without alternative text, parts from the network."""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ADDRESSES = {
    "a": "href",
    "img": "src",
    "script": "src",
    "link": "href",
    "source": "src",
    "iframe": "src",
}


class Page(HTMLParser):
    """The links and the anchors of one page, and its images without alternative text."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors, self.links, self.undescribed = {"", "top"}, set(), []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the tag's id, its address, and an image without alternative text."""
        values = dict(attrs)
        self.anchors.add(values.get("id") or "")
        if values.get(ADDRESSES.get(tag, "")):
            self.links.add((tag, values[ADDRESSES[tag]]))
        if tag == "img" and not (values.get("alt") or "").strip():
            self.undescribed.append(str(values)[:100])


def faults(site: Path) -> list[str]:
    """All faults of a built site, one line each. External links are not followed.

    Args:
        site: folder of the site's HTML files.
    """
    site = site.resolve()
    pages = {file: Page(file.read_text(encoding="utf-8")) for file in sorted(site.rglob("*.html"))}
    found = []
    for file, page in pages.items():
        name = file.relative_to(site).as_posix()
        found += [
            f"{name}: an image without alternative text: {picture}" for picture in page.undescribed
        ]
        for tag, address in sorted(page.links):
            link = urlsplit(address)
            if link.scheme == "data" or (tag == "a" and link.scheme):
                continue
            target = (file.parent / unquote(link.path)).resolve() if link.path else file
            if link.scheme or link.netloc:
                found.append(f"{name}: <{tag}> needs the network: {address[:100]}")
            elif not target.is_file():
                found.append(f"{name}: <{tag}> leads to a missing file: {address}")
            elif "=" in link.fragment:  # a state of the page, such as a track of the race
                continue
            elif target in pages and unquote(link.fragment) not in pages[target].anchors:
                found.append(f"{name}: <{tag}> leads to a missing anchor: {address}")
    return found
