import struct
import zipfile
from io import BytesIO

import numpy as np
import pytest

from skevgp.io.container import Container, write
from skevgp.io.fields import MalformedError

from .corruption import _all_at_one_place, _deflated, _twice, members_of, zipped

ARRAYS = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.array(3.0),
    np.empty((0, 4)),
    np.array([True, False]),
    np.arange(4, dtype=np.int32),
    np.arange(3, dtype=np.float16),
]


def container_of(data):
    return Container(BytesIO(data))


def written(arrays=ARRAYS, content=None):
    file = BytesIO()
    write(file, content, arrays)
    return file.getvalue()


def test_arrays_come_back_with_their_order():
    container = container_of(written())
    assert container.n_arrays == len(ARRAYS)
    for number, values in enumerate(ARRAYS):
        found = container.array(number)
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)
        assert found.flags.f_contiguous == values.flags.f_contiguous
        assert found.flags.writeable
        assert container.array(number) is found


def test_text_comes_back():
    content = {"a": [1, 2.5, None, "é\u2028", True]}
    assert container_of(written([], content)).text() == content


def test_text_that_is_no_json_is_not_written():
    with pytest.raises(ValueError, match="JSON compliant"):
        written([], float("nan"))


def with_header(old, new):
    members = members_of(written(ARRAYS[:1]))
    name, content = members[1]
    members[1] = name, content.replace(old, new, 1)
    return zipped(members)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (with_header(b"(2, 3)", b"(9, 9)"), r"says the shape \(9, 9\), which are not the bytes"),
        (with_header(b"(2, 3), }       ", b"(2000000000, 3)}"), "is not an array of numbers"),
        (with_header(b"(2, 3), }        ", b"(200000000, 3), }"), "which are not the bytes it has"),
        (with_header(b"(2, 3), }      ", b"(9" + b"9" * 8 + b", 0), }"), None),
        (with_header(b"<f8", b"|O8"), "is not an array of numbers"),
        (with_header(b"<f8", b"|b1"), "which are not the bytes it has"),
        (with_header(b"\x93NUMPY\x01", b"\x93NUMPY\x02"), "is not an array of numbers"),
        (with_header(b"{", b"("), "is not an array of numbers"),
    ],
)
def test_an_array_is_not_made_before_its_bytes_are_counted(data, message):
    with pytest.raises(MalformedError, match=message):
        container_of(data).array(0)


def test_truth_values_are_0_or_1():
    members = members_of(written([np.array([True, False])]))
    members[1] = members[1][0], members[1][1][:-1] + b"\x02"
    with pytest.raises(MalformedError, match="truth values"):
        container_of(zipped(members)).array(0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_deflated([("model.json", b"1" * 10_000)]), "is compressed"),
        (_twice([("model.json", b"1")], ("model.json", b"2")), "two members of the name 'model.json'"),
        (_all_at_one_place(written()), "two members|together are longer|is not|differ"),
    ],
    ids=["compressed", "twice", "at one place"],  # bytes as names have the time in them
)
def test_tricks_of_zip_are_refused(data, message):
    with pytest.raises((MalformedError, zipfile.BadZipFile), match=message):
        container_of(data).text()


def test_members_at_the_same_place_are_longer_than_the_file():
    file = BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("0.npy", bytes(10_000))
        info = archive.infolist()[0]
        for number in range(1, 50):
            other = zipfile.ZipInfo(f"{number}.npy")
            for name in ("CRC", "compress_size", "file_size", "header_offset"):
                setattr(other, name, getattr(info, name))
            archive.filelist.append(other)
        archive._didModify = True
    assert len(file.getvalue()) < 20_000
    with pytest.raises(MalformedError, match="together are longer than the file"):
        Container(file)


def test_damage_is_seen_by_the_checksum():
    data = bytearray(written())
    place = data.index(struct.pack("<d", 5.0))
    data[place] ^= 1
    with pytest.raises(zipfile.BadZipFile, match="Bad CRC-32"):
        container_of(bytes(data)).array(0)


@pytest.mark.parametrize("text", [b'{"a": NaN}', b'{"a": 1, "a": 2}', b"[1, Infinity]"])
def test_text_is_strict(text):
    with pytest.raises(MalformedError):
        container_of(zipped([("model.json", text)])).text()


def test_there_must_be_a_text():
    with pytest.raises(MalformedError, match="no member 'model.json'"):
        container_of(zipped([("0.npy", b"")])).text()
