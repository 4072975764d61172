"""Tables in documents agree with the result files."""

from __future__ import annotations

import json

import pytest

from benchmarks.tables import COLUMNS, DOCUMENTS, Result, Row, filled, markdown, read_results, write_result
from neilfpp_method.errors import UserError

BALL = Result(
    "t", "abc1234", "make ball", "a CPU", (Row("one", {"seconds": 12.34, "volume_psnr": 20.126}, "env"),)
)
CUBE = Result(
    "t", "abc1235", "make ball", "a GPU", (Row("two", {"seconds": 1234.0}, "env"), Row("three", {}, "mix"))
)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_the_documents_are_up_to_date(path):
    """`python -m benchmarks.tables` updates them."""
    document = path.read_text("utf-8")
    assert "<!-- table: " in document
    assert filled(document, read_results()) == document


def test_every_result_file_has_a_table():
    documents = "".join(path.read_text("utf-8") for path in DOCUMENTS)
    for result in read_results():
        assert f"<!-- table: {result.table}" in documents
        assert result.commit in documents


def test_a_table():
    assert markdown([BALL, CUBE]).splitlines() == [
        "| capture |  | version | R | seconds |",
        "|---|---|---|---|---|",
        "| env | one | abc1234 | 20.13 | 12.3 |",
        "|  | two | abc1235 | – | 1234 |",
        "| mix | three | abc1235 | – | – |",
        "",
        "- `make ball`: abc1234 on a CPU; abc1235 on a GPU.",
    ]


def test_a_marker_selects_figures_and_other_text_is_unchanged():
    document = "before\n<!-- table: t seconds -->\nold\n<!-- end -->\nafter"
    head, *_, end, after = filled(document, [BALL]).splitlines()
    assert (head, end, after) == ("before", "<!-- end -->", "after")
    assert "20.13" not in filled(document, [BALL])
    assert "old" not in filled(document, [BALL])
    assert filled(filled(document, [BALL]), [BALL]) == filled(document, [BALL])


def test_a_written_result_is_read_back(tmp_path):
    write_result(tmp_path / "b.json", CUBE)
    write_result(tmp_path / "a.json", BALL)
    assert read_results(tmp_path) == [BALL, CUBE]


def test_figures_without_a_column_are_left_out(tmp_path):
    row = Row("one", {"seconds": 1.0, "temperature": 20.0})
    write_result(tmp_path / "a.json", Result("t", "abc1234", "make ball", "a CPU", (row,)))
    assert read_results(tmp_path)[0].rows[0].figures == {"seconds": 1.0}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rows": 3}, "not a result file"),
        ({"format": 2}, "format 2"),
        (
            {"rows": [{"name": "one", "figures": {"temperature": 20.0}}]},
            "figures without a column: temperature",
        ),
    ],
)
def test_an_invalid_result_file_is_refused(tmp_path, change, words):
    write_result(tmp_path / "a.json", BALL)
    content = json.loads((tmp_path / "a.json").read_text())
    (tmp_path / "a.json").write_text(json.dumps({**content, **change}))
    with pytest.raises(UserError, match=words):
        read_results(tmp_path)


@pytest.mark.parametrize(
    ("marker", "words"),
    [
        ("<!-- table: other -->", "'other' has no result file"),
        ("<!-- table: t colour -->", "no figure 'colour'"),
    ],
)
def test_an_invalid_marker_is_refused(marker, words):
    with pytest.raises(UserError, match=words):
        filled(f"{marker}\n<!-- end -->", [BALL])


def test_column_titles_are_unique():
    """Among the figures that can appear in one table."""
    titles = [column.title for name, column in COLUMNS.items() if not name.startswith("confidence_")]
    assert len(set(titles)) == len(titles)
