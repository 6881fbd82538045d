"""Tables of text: units, escapes, and what fits in a terminal."""

from __future__ import annotations

from pathspace_graph.eval.tables.text_table import TextTable, latex_text


def test_a_table_keeps_its_units_and_escapes_what_latex_would_take_for_commands() -> None:
    table = TextTable("50 % of a_b", ("name", "rmse [m]"), (("x|y", "1.0"), ("z", "–")), groups=(1,))
    assert table.rich().columns[1].header.plain == "rmse [m]"  # type: ignore[union-attr]
    assert "| x\\|y | 1.0 |" in table.markdown()
    latex = table.latex()
    assert "\\caption{50 \\% of a\\_b}" in latex and "z & -- \\\\" in latex
    assert latex.count("\\midrule") == 2 and "{lr}" in latex
    assert latex_text("2σ & 5 % {x}") == "2$\\sigma$ \\& 5 \\% \\{x\\}"


def test_a_table_too_wide_is_cut_into_parts_that_keep_the_names() -> None:
    table = TextTable("", ("metric", "aaaaaaaa", "bbbbbbbb", "cc"), (("rmse", "1", "2", "3"),))
    assert [part.header for part in table.parts(200)] == [table.header]
    parts = table.parts(22)  # 10 for the names and the border, 11 for each wide column
    assert [part.header[1:] for part in parts] == [("aaaaaaaa",), ("bbbbbbbb",), ("cc",)]
    assert [part.rows for part in parts] == [(("rmse", "1"),), (("rmse", "2"),), (("rmse", "3"),)]
    assert [part.header[1:] for part in table.parts(27)] == [("aaaaaaaa",), ("bbbbbbbb", "cc")]
    assert len(table.parts(1)) == 3
