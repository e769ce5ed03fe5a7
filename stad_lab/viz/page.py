"""A page of its own: one HTML file with its style and pictures, that asks for nothing else."""

import base64
import html

STYLE = """
:root{color-scheme:light dark;--page:#fbfbf9;--ink:#1c2321;--soft:#5c6663;--line:#d9dedb;
--bar:#0072b2;--card:#fff;--bad:#a33b00}
@media(prefers-color-scheme:dark){:root{--page:#14181a;--ink:#e8ecea;--soft:#a0aaa6;--line:#333b3d;
--bar:#56b4e9;--card:#1c2224;--bad:#ff9d66}}
*{box-sizing:border-box}body{margin:0;background:var(--page);color:var(--ink);
font:16px/1.5 system-ui,sans-serif}main{max-width:62rem;margin:auto;padding:2rem 1rem}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 .5rem}p{max-width:44rem}.soft{color:var(--soft)}
code{overflow-wrap:anywhere;font-size:.85em}.table{overflow-x:auto;border:1px solid var(--line);
border-radius:.6rem;background:var(--card)}table{border-collapse:collapse;width:100%}
th,td{padding:.45rem .7rem;text-align:right;border-bottom:1px solid var(--line);
font-variant-numeric:tabular-nums;white-space:nowrap}tr:last-child>*{border-bottom:0}
th{font-weight:600;color:var(--soft);font-size:.85rem}
details{border:1px solid var(--line);border-radius:.6rem;background:var(--card);margin:.5rem 0;
padding:.6rem .9rem}summary{cursor:pointer;font-weight:600}figure{margin:.7rem 0 0}
figcaption{font-size:.9rem;color:var(--soft)}li{margin:.3rem 0}.bad{color:var(--bad)}
@media(max-width:40rem){.wide{display:none}th,td{padding:.4rem .45rem}main{padding:1.2rem .8rem}}
"""


def document(title: str, body: str, style: str = "") -> str:
    """A whole page; `title` is text, `body` is HTML, `style` are further rules."""
    return f"""<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title><style>{STYLE}{style}</style><main>
<h1>{html.escape(title)}</h1>{body}</main></html>"""


def picture(content: bytes, kind: str, alt: str, style: str = "") -> str:
    """An <img> that holds its file; `kind` is "png", "gif" or "webp", `style` is CSS."""
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    styled = f' style="{style}"' if style else ""
    return f'<img loading=lazy alt="{html.escape(alt)}"{styled} src="{source}">'
