"""The benchmark of fits to their ends, with few rows."""


def test_every_way_comes_near_the_reference(tmp_path):
    from speed import many_rows

    rows = [many_rows.run(many_rows.Cell(20_000, fit, 20, tmp_path)) for fit in many_rows.FITS]
    assert [row["fit"] for row in rows] == list(many_rows.FITS)
    for row in rows:
        assert row["bound_per_row"] > row["noise_alone_per_row"] + 0.5
    assert rows[-1]["n_iter"] == 20
    title, table, *_ = many_rows.paragraphs([{name: str(value) for name, value in row.items()} for row in rows])
    assert title == "# 20,000 rows"
    assert "| reference | 20 |" in table
    assert "100.00 %" in table


def test_without_a_reference_there_is_no_page():
    from speed import many_rows

    row = {"fit": "default", "bound_per_row": "0.5", "noise_alone_per_row": "-1.0"}
    assert many_rows.paragraphs([row]) == []


def test_the_reference_begins_on_all_rows(tmp_path):
    from internals import watched
    from speed import many_rows

    sizes = {}
    for fit in ("default", "reference"):
        with watched(lambda model, start, ended, fit=fit: sizes.setdefault(fit, start.n_rows)):
            many_rows.run(many_rows.Cell(10_000, fit, 3, tmp_path))
    assert sizes["reference"] is None
    assert sizes["default"] < 10_000
