"""Tables of text: units, escapes, and what fits in a terminal."""

from __future__ import annotations

from pathspace_graph.eval.experiment.tables import TextTable


def test_a_table_keeps_its_units_and_escapes_what_latex_would_take_for_commands() -> None:
    rows = (("x|y", "2σ < 5 %"), ("z", "–"))
    table = TextTable("50 % of a_b ± 1", ("name", "rmse [m]"), rows, groups=(1,))
    assert table.rich().columns[1].header.plain == "rmse [m]"  # type: ignore[union-attr]
    latex = table.latex()
    assert r"\caption{50 \% of a\_b $\pm$ 1}" in latex and r"2$\sigma$ \ensuremath{<} 5 \%" in latex
    assert latex.count(r"\midrule") == 2 and "{lr}" in latex and latex.isascii()


def test_names_are_aligned_to_the_left_and_numbers_to_the_right() -> None:
    table = TextTable("Title", ("name", "a", ""), (("x|y", "1.0", ""), ("long name", "12.25", "*")))
    assert [line.rstrip() for line in table.text().split("\n")] == [
        "name           a",
        "---------  -----  --",
        "x|y          1.0",
        "long name  12.25   *",
    ]
    lines = table.markdown().split("\n")
    assert lines[:2] == ["Title", ""] and lines[-1] == ""
    assert lines[3] == "|:----------|------:|---:|"
    assert lines[4] == r"| x\|y      |   1.0 |    |"


def test_a_table_too_wide_is_cut_into_parts_that_keep_the_names() -> None:
    table = TextTable("", ("metric", "aaaaaaaa", "bbbbbbbb", "cc"), (("rmse", "1", "2", "3"),))
    assert [part.header for part in table.parts(200)] == [table.header]
    parts = table.parts(22)  # 10 for the names and the border, 11 for each wide column
    assert [part.header[1:] for part in parts] == [("aaaaaaaa",), ("bbbbbbbb",), ("cc",)]
    assert [part.rows for part in parts] == [(("rmse", "1"),), (("rmse", "2"),), (("rmse", "3"),)]
    assert [part.header[1:] for part in table.parts(27)] == [("aaaaaaaa",), ("bbbbbbbb", "cc")]
    assert len(table.parts(1)) == 3
