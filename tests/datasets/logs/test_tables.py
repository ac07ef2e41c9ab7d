import gzip

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from skevgp.datasets import load_log

from .cases import BY_NAME, BY_NUMBER, HEADER, irregular_times, table_of, write_table

TABLE = table_of(irregular_times(1.5))


@pytest.fixture
def file(tmp_path):
    return write_table(tmp_path / "log.csv", TABLE)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return load_log(write_table(tmp_path_factory.mktemp("expected") / "log.csv", TABLE), columns=BY_NUMBER)


def assert_equal(log, expected):
    for name in ("data", "target", "time"):
        assert_array_equal(log[name], expected[name])


@pytest.mark.parametrize(
    "columns",
    [
        BY_NAME,
        {**BY_NAME, "position": ["q_1", 2]},
        {**BY_NAME, "position": np.array([1, 2]), "velocity": "dq_?"},
        {**BY_NAME, "acceleration": None},
    ],
    ids=str,
)
def test_columns_by_name_are_columns_by_number(file, expected, columns):
    assert_equal(load_log(file, columns=columns), expected)


def any_tables():
    """Other names of files with two delimiters. With the rest of them they are for the long tests."""
    for name in ("log.csv", "log.csv.gz", "log.TXT"):
        for delimiter in (",", ";", "\t", " "):
            for header in (HEADER, None):
                quick = name == "log.csv" or (delimiter, header) in ((",", HEADER), (" ", None))
                yield pytest.param(name, delimiter, header, marks=[] if quick else pytest.mark.long)


@pytest.mark.parametrize(("name", "delimiter", "header"), list(any_tables()))
def test_any_table_is_read(tmp_path, expected, delimiter, header, name):
    file = write_table(tmp_path / name, TABLE, header, delimiter)
    assert_equal(load_log(file, columns=BY_NUMBER), expected)


@pytest.mark.parametrize(
    "beginning",
    [
        "# robot: UR10\n# t,q_1,q_2,mode,dq_1,dq_2,i_1,i_2\n",
        "\ufeff" + ",".join(HEADER) + "\n",
        '"t", "q_1", "q_2","mode","dq_1","dq_2","i_1","i_2"\n\n',
    ],
    ids=["comment", "signature", "quotes"],
)
def test_headers_are_found(tmp_path, expected, beginning):
    body = write_table(tmp_path / "body.csv", TABLE, None).read_text()
    file = tmp_path / "log.csv"
    file.write_text(beginning + body, encoding="utf-8")
    assert_equal(load_log(file, columns=BY_NAME), expected)


@pytest.mark.parametrize(("unit", "seconds"), [("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)])
def test_times_have_a_unit(tmp_path, expected, unit, seconds):
    table = TABLE.copy()
    table[:, 0] /= seconds
    log = load_log(write_table(tmp_path / "log.csv", table), columns=BY_NUMBER, time_unit=unit)
    np.testing.assert_allclose(log.data, expected.data, atol=1e-8)
    assert log.recordings[0].start == pytest.approx(expected.recordings[0].start)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({**BY_NUMBER, "time": 8}, r"columns\['time'\] asks for column 8, but there are 0 to 7 only"),
        (
            {**BY_NUMBER, "position": "p_*"},
            r"columns\['position'\] asks for 'p_\*', which is not among the columns \['t'",
        ),
        ({**BY_NUMBER, "position": ["q_1"]}, "there are 1 columns of position, and 2 of velocity"),
        ({**BY_NUMBER, "current": [6, 6]}, r"columns\['current'\] has a column twice: \[6, 6\]"),
    ],
)
def test_missing_columns_are_named_with_the_file(file, columns, message):
    with pytest.raises(ValueError, match=f"log.csv: {message}"):
        load_log(file, columns=columns)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"time": 0, "position": 1}, "columns must name 'time', 'position', one of 'effort' and 'current'"),
        ({"time": 0, "effort": 1}, "columns must name 'time', 'position'"),
        ({**BY_NUMBER, "effort": 1}, "one of 'effort' and 'current'"),
        ({**BY_NUMBER, "speed": 1}, "columns must name .* got .*'speed'\\]. Leave other columns out"),
        ({**BY_NUMBER, "time": [0, 1]}, r"columns\['time'\] must be one column; got \[0, 1\]"),
        ({**BY_NUMBER, "position": []}, r"columns\['position'\] must be at least one column"),
        ({**BY_NUMBER, "position": -1}, r"columns\['position'\] must be at least 0; got -1"),
    ],
)
def test_invalid_column_maps_raise(file, columns, message):
    with pytest.raises(ValueError, match=message):
        load_log(file, columns=columns)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["t", "q"], "columns must be a dict .* got \\['t', 'q'\\]"),
        ({**BY_NUMBER, "time": 0.0}, r"columns\['time'\] must be an integer; got 0.0"),
    ],
)
def test_column_maps_of_wrong_types_raise(file, columns, message):
    with pytest.raises(TypeError, match=message):
        load_log(file, columns=columns)


def test_names_need_a_header(tmp_path):
    with pytest.raises(ValueError, match=r"asks for 't', but there is no header: give numbers, from 0"):
        load_log(write_table(tmp_path / "log.csv", TABLE, None), columns=BY_NAME)


@pytest.mark.parametrize(
    ("quote", "message"),
    [
        ("", r"row 1 lacks the position .*'a{79} in column 1 \(q\) is no number"),
        ('"', "it is not a text file, .*field limit"),
    ],
)
def test_cell_of_a_million_letters_raises(tmp_path, quote, message):
    file = tmp_path / "log.csv"
    file.write_text(f"t,q,u\n0,1,2\n1,{quote}{'a' * 10**6}{quote},2\n2,3,4\n")
    with pytest.raises(ValueError, match=f"log.csv: {message}"):
        load_log(file, columns={"time": 0, "position": 1, "effort": 2})


def test_name_of_two_columns_raises(tmp_path):
    file = write_table(tmp_path / "log.csv", TABLE, ["t", "t", *HEADER[2:]])
    with pytest.raises(ValueError, match="asks for 't', but several columns have this name"):
        load_log(file, columns={**BY_NUMBER, "time": "t"})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it is empty"),
        (b"# only a comment\n", "it is empty"),
        (b"t,q,u\n", "it has no rows"),
        (b"t,q,u\n0,1,2\n1,,2\n2,3,4\n", "row 1 lacks the position of joint 'q1'. Leave it out by keep"),
        (b"t,q,u\n0,1,2\n1,word,2\n2,3,4\n", r"row 1 lacks the position .*'word' in column 1 \(q\) is no number"),
        (b"t,q,u\n0,1,2\n1,2\n2,3,4\n", "row 1 lacks the effort .*it has 2 cells, and column 2 is read"),
        (b"t,q,u\n0,1,2\n1,nan,2\n2,3,4\n", "row 1 lacks the position"),
        (b"t,q,u\n0,,2\n1,,2\n2,,4\n", "none of its 3 rows is complete: row 0 lacks the position"),
        (b"t,q,u\n0,,2\n1,,2\n2,3,4\n", "2 of its 3 rows are incomplete: row 0 lacks the position"),
        (b"t;q;u\n0,1;1;2\n", r"row 0 has '0,1' in column 0 \(t\), and decimal='.'. Pass decimal=\",\""),
        (b"t;q;u\n0;1.234,5;2\n", r"row 0 has '1.234,5' in column 1 \(q\).* without separators of thousands"),
        (b"\xff\xfe\x00\x80", "it is not a text file, or its compression is broken"),
    ],
)
def test_invalid_table_raises(tmp_path, content, message):
    file = tmp_path / "bad.csv"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=f"bad.csv: {message}"):
        load_log(file, columns={"time": 0, "position": 1, "effort": 2})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t;q;u\n0,5;1.5;2\n", r"row 0 has '1.5' in column 1 \(q\), and decimal=','. Pass decimal=\"\.\""),
        ("t;q;u\n0,5;1.234,5;2\n", r"row 0 has '1.234,5' .* without separators of thousands"),
    ],
)
def test_points_among_decimal_commas_raise(tmp_path, text, message):
    file = tmp_path / "log.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_log(file, columns={"time": 0, "position": 1, "effort": 2}, decimal=",")


@pytest.mark.parametrize("decimal", ["", ";", ".,", None, 0])
def test_decimal_must_be_a_point_or_a_comma(file, decimal):
    with pytest.raises(ValueError, match=r"decimal must be '\.' or ','; got"):
        load_log(file, columns=BY_NUMBER, decimal=decimal)


@pytest.mark.parametrize("delimiter", [";", "\t", " ", '","'])
@pytest.mark.parametrize("header", [True, False])
def test_decimal_commas_are_read(tmp_path, expected, delimiter, header):
    lines = write_table(tmp_path / "body.csv", TABLE, HEADER if header else None).read_text().splitlines()
    lines = [line.replace(",", ";").replace(".", ",").replace(";", delimiter) for line in lines]
    quote = '"' if '"' in delimiter else ""
    file = tmp_path / "log.csv"
    file.write_text("".join(f"{quote}{line}{quote}\r\n" for line in lines))
    assert_equal(load_log(file, columns=BY_NUMBER, decimal=","), expected)


UNITS, CUT_OFF = "s,rad,rad,,rad/s,rad/s,A,A\n", "3.1,0.5"


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "NA", "n/a", "null", "None", "-"])
def test_incomplete_rows_at_the_ends_are_left_out_and_counted(tmp_path, expected, missing):
    """A line of units, motors that do not answer yet, and a last line that is cut off."""
    header, *rows = write_table(tmp_path / "body.csv", TABLE).read_text().splitlines(keepends=True)
    first = f"{TABLE[0, 0] - 0.01},0.1,0.1,0,0.1,0.1,{missing},{missing}\n"
    file = tmp_path / "log.csv"
    file.write_text(header + UNITS + first + "".join(rows) + CUT_OFF)
    log = load_log(file, columns=BY_NAME)
    assert log.recordings[0].n_incomplete == 3
    assert "3 incomplete at the ends" in log.DESCR
    np.testing.assert_allclose(log.data, expected.data, atol=1e-9)
    np.testing.assert_allclose(log.target, expected.target, atol=1e-9)
    assert expected.recordings[0].n_incomplete == 0
    assert "incomplete at the ends" not in expected.DESCR


@pytest.mark.parametrize("spoil", [lambda data: b"no gzip", lambda data: data[: len(data) // 2]], ids=["no", "half"])
def test_broken_compression_raises(tmp_path, spoil):
    file = tmp_path / "bad.csv.gz"
    file.write_bytes(spoil(gzip.compress(b"0,1,2\n" * 1000)))
    with pytest.raises(ValueError, match="bad.csv.gz: it is not a text file, or its compression is broken"):
        load_log(file, columns={"time": 0, "position": 1, "effort": 2})
