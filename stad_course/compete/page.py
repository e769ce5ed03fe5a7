"""The leaderboard: one HTML file, with films of the best and the worst lap of the first ten."""

import html

import pandas as pd
from PIL import Image

from stad_course.compete.drive import replay
from stad_lab.viz.page import document, picture
from stad_lab.viz.video import enlarged, save_pages

FILMED, EVERY, SIZE = 10, 8, 192  # submissions; frames; pixels
STYLE = """
td:nth-child(2),th:nth-child(2){text-align:left}.baseline{font-style:italic}
svg{display:block;width:9rem;height:1rem}.films{display:flex;gap:1rem;flex-wrap:wrap}
img{display:block;width:12rem;image-rendering:pixelated;border-radius:.4rem}
@media(max-width:40rem){svg{width:5rem}}
"""


def leaderboard(table: pd.DataFrame, tracks: list[int], commitment: str, facts: dict) -> str:
    """The page of a ranking.

    Args:
        table: of `rank`, with a column `baseline`.
        tracks: seeds, for the films.
        commitment: the hash of the hidden tracks.
        facts: "isolated", whether processes were; "revealed", the seeds and the salt, or None.
    """
    rows = "".join(row_of(one) for one in table.itertuples())
    films = "".join(films_of(one, tracks) for one in table.head(FILMED).itertuples())
    errors = "".join(
        f"<li><b>{html.escape(one.name)}</b>: <span class=bad>{html.escape(line)}</span></li>"
        for one in table.itertuples()
        for line in dict.fromkeys(one.failures)
    )
    headings = ["", "agent", "mean", "<span class=wide>95% interval</span>", "minimum"]
    headings += ["10th percentile", "below 800", "failures"]
    cells = "".join(
        f"<th{' class=wide' * (number in (3, 5, 6))} scope=col>{text}</th>"
        for number, text in enumerate(headings)
    )
    body = f"""<p class=soft>{len(table)} agents on {len(tracks)} hidden tracks. A place with =
is not significantly behind the first (paired t-test over tracks, Holm, p &ge; 0.05). Baselines are
in italics.</p><div class=table tabindex=0 role=region aria-label="Ranking"><table>
<thead><tr>{cells}</tr></thead><tbody>{rows}</tbody></table></div>
<h2>Best and worst lap of the first {min(FILMED, len(table))}</h2>{films}
{"<h2>What went wrong</h2><ul>" + errors + "</ul>" if errors else ""}
<h2>The tracks</h2>{about_tracks(commitment, facts)}"""
    return document(f"{table['name'][0]} leads", body, STYLE)


def row_of(one) -> str:
    """A row of the table."""
    low, high = one.interval
    name = html.escape(one.name)
    name = f"<span class=baseline>{name}</span>" if one.baseline else name
    place = f"{one.place}{' =' * (one.tied and one.Index > 0)}"
    left, width = max(low, 0) / 10, max(high - max(low, 0), 4) / 10
    bar = (
        f'<svg viewBox="0 0 100 10" preserveAspectRatio="none" role=img aria-label="{low:.0f} to'
        f' {high:.0f}"><path d="M0 5H100" stroke="var(--line)"/><rect x="{left:.1f}" y="2"'
        f' width="{width:.1f}" height="6" rx="1" fill="var(--bar)"/></svg>'
    )
    failures = len(one.failures)
    return (
        f"<tr><td>{place}</td><td>{name}</td><td><b>{one.mean:.1f}</b></td><td class=wide>{bar}"
        f"</td><td>{one.minimum:.0f}</td><td class=wide>{one.tenth_percentile:.0f}</td>"
        f"<td class=wide>{one.failed}</td><td>{failures or ''}</td></tr>"
    )


def films_of(one, tracks: list[int]) -> str:
    """The films of a submission, in a closed box, so that nothing moves unasked."""
    laps = sorted(one.laps, key=lambda number: -one.returns[int(number)])
    figures = ""
    kinds = ("best", "worst") if len(laps) > 1 else ("only",)
    for number, kind in zip(laps, kinds, strict=False):  # a submission may have no lap
        film = to_film(replay(tracks[int(number)], one.laps[number], EVERY))
        text = f"{kind} lap: {one.returns[int(number)]:.0f} points, track {int(number) + 1}"
        shown = picture(film, "webp", f"Film of the {text}")
        figures += f"<figure>{shown}<figcaption>{text}</figcaption></figure>"
    if not figures:
        return ""
    name = html.escape(one.name)
    return f"<details><summary>{name}</summary><div class=films>{figures}</div></details>"


def to_film(pictures: list) -> bytes:
    """Pictures as an animated WebP, four times as fast as real."""
    pages: list[Image.Image] = [enlarged(one, SIZE) for one in pictures]
    return save_pages(pages, 200 / EVERY, "webp")


def about_tracks(commitment: str, facts: dict) -> str:
    """What was promised of the tracks, and how processes were shut in."""
    text = f"<p>SHA-256, published before: <code>{commitment}</code></p>"
    if facts["revealed"]:
        file = html.escape(facts["revealed"])
        text += "<details><summary>The seeds, revealed</summary>"
        text += "<p>Save this as tracks.json; <code>python -m stad_course commit tracks.json"
        text += f"</code> prints the hash.</p><pre><code>{file}</code></pre></details>"
    apart = "had no network, and could not see the tracks or each other"
    here = "were not all isolated: the others had the rights of the account that ran them"
    return f"{text}<p class=soft>The agents {apart if facts['isolated'] else here}.</p>"
