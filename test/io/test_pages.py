"""The pages in msg_docs/ are those of the topic table, and the table explains every field of every type."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages import topics
from tools import message_pages as pages

FOLDER = Path(__file__).parents[2] / "msg_docs"


@pytest.mark.parametrize("topic", topics.TOPIC.values(), ids=lambda topic: topic.name)
def test_every_field_is_documented(topic):
    assert pages.undocumented(topic) == []


def test_a_missing_or_unknown_field_is_noticed():
    topic = topics.TOPIC[topics.TIP_POSE]
    without = replace(topic, fields=tuple(f for f in topic.fields if f.path != "pose.covariance"))
    assert pages.undocumented(without) == ["pose.covariance[]"]
    wrong = replace(topic, fields=(*topic.fields, topics.Field("pose.cov", "no such field")))
    assert pages.undocumented(wrong) == ["pose.cov (not in geometry_msgs/msg/PoseWithCovarianceStamped)"]


@pytest.mark.parametrize("name", sorted(pages.pages()))
def test_page_is_up_to_date(name):
    hint = "write it with `python -m tools.message_pages msg_docs`"
    assert (FOLDER / name).is_file(), hint
    assert (FOLDER / name).read_text(encoding="utf-8") == pages.pages()[name], hint


def test_no_page_of_a_topic_that_is_gone():
    assert {path.name for path in FOLDER.glob("*.md")} == set(pages.pages())


def test_pages_need_a_folder(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        pages.main(tmp_path / "none")
    pages.main(tmp_path)
    assert len(list(tmp_path.iterdir())) == len(topics.TOPIC) + 1
