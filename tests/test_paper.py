"""The article about study 1: what it says is computed, and short."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "paper"))
import build  # noqa: E402


def test_every_number_and_table_of_the_article_is_computed_from_the_records(tmp_path):
    build.write(tmp_path)
    text = (tmp_path / "content.tex").read_text(encoding="utf-8")
    assert not re.search(r"\\(val|interval|tabular)\{(?!l+\})", text)
    assert text.count(r"\begin{tabular}") == len(build.TABLES)
    for name in re.findall(r"\\includegraphics\[[^]]*\]\{(.*?)\}", text):
        assert (tmp_path / name).read_bytes().startswith(b"%PDF")


def test_the_article_has_at_most_2000_words():
    parts = [(build.HERE / name).read_text("utf-8") for name in ("content.tex", "abstract.tex")]
    assert len(" ".join(parts).split()) <= 2000
