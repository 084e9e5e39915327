"""The documentation is plain: short sentences, and the project's vocabulary in the code and on every page."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import prose, words

ROOT = Path(__file__).parents[1]
PAGES = prose.pages(ROOT)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_sentences_of_a_page_are_short(page):
    found = prose.lengths(page.read_text(encoding="utf-8"))
    assert found.mean <= prose.MEAN_LIMIT
    assert [sentence.text for sentence in found.long] == []


def test_no_replaced_word_is_used():
    assert words.uses(ROOT) == []


def test_sentences_are_counted_without_headings_code_and_generated_blocks():
    text = """# A heading is no sentence

One two three. Four `code is one word` six; seven [eight nine](link.md#anchor).

    y = equation of many words

- An item (see Till et al. 2020, Fig. 3). Another sentence

```sh
no words
```

<!-- table: generated -->
Nothing here counts.
<!-- table: end -->

| head | cell |
| --- | --- |
| a | b c |
"""
    found = list(prose.sentences(text))
    assert [s.words for s in found if not s.in_table] == [3, 6, 9, 2]
    assert [s.words for s in found if s.in_table] == [1, 1, 1, 2]
    assert prose.lengths(text).mean == pytest.approx(5.0)


def test_a_long_sentence_fails_its_page_also_in_a_table():
    long = " ".join(["word"] * (prose.LONGEST_LIMIT + 1))
    assert not prose.lengths(f"Short. {long}.").passes
    assert not prose.lengths(f"Short.\n\n| a | {long} |\n| --- | --- |\n").passes
    assert not prose.lengths(" ".join(["word"] * 21) + ".").passes
    assert prose.lengths(" ".join(["word"] * 20) + ".").passes


@pytest.mark.parametrize(
    ("path", "source", "found"),
    [
        ("ctr_dynamics/model/a.py", "class FarProbe: ...", ["FarProbe"]),
        ("ctr_dynamics/model/a.py", "def f(imbalance): ...", ["imbalance"]),
        ("ctr_dynamics/model/probes.py", "", ["probes"]),
        ("ctr_dynamics/model/a.py", "def f(): raise ValueError('the value was refused')", ["refused"]),
        ("ctr_dynamics/model/a.py", "import inspect\ninspect.signature(len)", []),
        ("ctr_dynamics/model/a.py", "bending = 1\nwall_s = 2.0", []),
    ],
)
def test_replaced_words_are_found_in_names_and_texts(tmp_path, path, source, found):
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(source)
    assert [use.word for use in words.uses(tmp_path)] == found


def test_replaced_words_are_found_in_pages(tmp_path):
    (tmp_path / "README.md").write_text("The node hears joints; of course `anew` is code. It begins anew.")
    assert [(use.word, use.term) for use in words.uses(tmp_path)] == [
        ("anew", "reinitialise"),
        ("hears", "subscribe"),
    ]
