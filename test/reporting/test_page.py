"""Pages keep what they are given as text, load nothing, and draw lines faithfully."""

from __future__ import annotations

import html.parser
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctr_dynamics.reporting.figures import Panel, figure_svg, thinned
from ctr_dynamics.reporting.page import Markup, Page

NASTY = "</script><script>document.title='owned'</script><img src=x onerror=alert(1)>\"'&"


class Seen(html.parser.HTMLParser):
    """Tags, attributes and visible text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_data(self, data):
        self.words.append(data)


def nasty_page(text: str) -> Page:
    page = Page(text)
    page.heading(text)
    page.paragraph(text, "note")
    page.preformatted(text)
    page.table([(text, text), (text, 1.5)], header=(text, text))
    page.figure(figure_svg([Panel(text).line(np.arange(3.0), np.arange(3.0), text, "fused")]), text)
    page.data("numbers", {"text": text})
    return page


def test_text_stays_text():
    seen = Seen(nasty_page(NASTY).text())
    assert seen.tags.count("script") == 1  # the data block
    assert "img" not in seen.tags
    assert not any(name.startswith("on") for name, _ in seen.attributes)
    assert sum(NASTY in word for word in seen.words) >= 8


@settings(max_examples=40, deadline=None)
@given(st.text(max_size=40))
def test_any_text_stays_text(text):
    page = nasty_page("x")
    page.paragraph(text)
    page.data("more", text)
    seen = Seen(page.text())
    assert sorted(set(seen.tags) - {"x"}) == sorted(set(Seen(nasty_page("x").text()).tags))
    assert seen.tags.count("script") == 2


def test_data_blocks_come_back():
    page = Page("x")
    value = {"a": [1.5, -2.0], "b": NASTY, "c": "\u2028"}
    page.data("d", value)
    block = page.text().split('id="d">')[1].split("</script>")[0]
    assert json.loads(block) == value
    with pytest.raises(ValueError, match="already"):
        page.data("d", 1)
    with pytest.raises(ValueError):
        page.data("e", math.nan)


def test_a_script_of_somebody_else_does_not_run(browser, tmp_path):
    page = Page("mine")
    page.script("document.title = 'ran'; document.documentElement.dataset.mine = 'yes';")
    file = tmp_path / "page.html"
    file.write_text(
        page.text().replace("</body>", "<script>document.documentElement.dataset.other='yes'</script></body>")
    )
    shown = browser.show(file)
    assert 'data-mine="yes"' in shown.document
    assert "data-other" not in shown.document.split("<body")[0]
    assert "Content Security Policy" in shown.console


def test_nothing_is_loaded_from_elsewhere():
    page = nasty_page("x")
    page.figure(Markup('<img alt="a picture" src="data:image/png;base64,iVBORw0K">'), "p")
    for name, value in Seen(page.text()).attributes:
        if name in ("src", "href", "xlink:href", "data", "action"):
            assert value.startswith(("#", "data:"))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=5000), st.integers(10, 200))
def test_thinned_lines_keep_their_peaks(values, points):
    t, y = np.arange(len(values), dtype=float), np.array(values)
    tt, yy = thinned(t, y, points)
    assert len(tt) <= max(points, min(len(t), points))
    assert np.all(np.diff(tt) > 0)
    assert (yy.min(), yy.max()) == (y.min(), y.max())
    assert np.array_equal(yy, y[tt.astype(int)])


def test_figures_share_no_identifiers_and_survive_nan():
    t = np.linspace(0, 1, 5000)
    y = np.where(t > 0.5, np.nan, t)
    first, second = (figure_svg([Panel("y").line(t, y, "l", "fused", band=0.1 + 0 * t)]) for _ in range(2))
    ids = [{value for name, value in Seen(svg).attributes if name == "id"} for svg in (first, second)]
    assert ids[0]
    assert not ids[0] & ids[1]
    assert len(first) < 200_000
