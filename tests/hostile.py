"""Damaged logs, and URDF files that are damaged or made to do harm: each damage (bytes, rng) -> bytes."""

import gzip
import re
import sqlite3
import tempfile
from contextlib import suppress
from pathlib import Path


def cut_out(data, rng):
    first, length = rng.randint(len(data)), rng.choice([1, 2, 7, 100, 5000])
    return data[:first] + data[first + length :]


def flipped_bits(data, rng):
    found = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 8, 64])):
        found[rng.randint(len(found))] ^= 1 << rng.randint(8)
    return bytes(found)


def overwritten(data, rng):
    first, length = rng.randint(len(data)), rng.choice([1, 4, 64, 1000])
    length = min(length, len(data) - first)
    filling = rng.choice(["zeros", "ones", "noise"])
    new = {"zeros": bytes(length), "ones": b"\xff" * length, "noise": rng.bytes(length)}[filling]
    return data[:first] + new + data[first + length :]


def truncated(data, rng):
    return data[: rng.randint(len(data))]


BYTES = [flipped_bits, truncated, cut_out, overwritten]
NUMBERS = ["nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e999", "1e-320", "", " ", "1 2", "x", "0x10", "1,5",
           "9" * 400, "1_0", "٣", "--1", "1e", "+", "\t", "\x00", "\ud800", "1" + "0" * 5000]  # fmt: skip
WORDS = [*NUMBERS, "../../etc/passwd", "package://../../etc/passwd", "file:///dev/zero", "&lt;", "&#0;", "&a;", "\r\n",
         "=cmd|'/C calc'!A0", "__import__('os').system('true')", "x" * 100_000, "%s%s%n", "universe"]  # fmt: skip


def encoded(text):
    return text.encode("utf-8", "surrogatepass")


def chosen(rng, items):
    return items[rng.randint(len(items))]


def replaced(data, match, new):
    return data[: match.start()] + encoded(new) + data[match.end() :]


# --- XML ---------------------------------------------------------------------------------------------------------

_VALUE = re.compile(rb'(?<==")[^"]*(?=")')
_TAG = re.compile(rb"<[^>]*>")
_NAME_OF_LINK = re.compile(rb'(?<=link=")[^"]*(?=")')


def with_another_value(data, rng):
    for _ in range(chosen(rng, [1, 1, 2, 5])):
        data = replaced(data, chosen(rng, list(_VALUE.finditer(data))), chosen(rng, WORDS))
    return data


def with_anothers_value(data, rng):
    values = list(_VALUE.finditer(data))
    one, other = chosen(rng, values), chosen(rng, values)
    return data[: one.start()] + other[0] + data[one.end() :]


def with_other_parents(data, rng):
    for _ in range(chosen(rng, [1, 1, 2, 20])):
        links = list(_NAME_OF_LINK.finditer(data))
        one, other = chosen(rng, links), chosen(rng, links)
        data = data[: one.start()] + other[0] + data[one.end() :]
    return data


def without_a_tag(data, rng):
    tag = chosen(rng, list(_TAG.finditer(data)))
    return data[: tag.start()] + data[tag.end() :]


def with_tags_twice(data, rng):
    tags = list(_TAG.finditer(data))
    first, place = rng.randint(len(tags)), chosen(rng, tags).end()
    part = data[tags[first].start() : tags[min(first + chosen(rng, [0, 1, 5, 30]), len(tags) - 1)].end()]
    return data[:place] + part * chosen(rng, [1, 1, 2, 1000]) + data[place:]


def without_an_element(data, rng):
    """From a tag to the end of one of its name."""
    tag = chosen(rng, list(_TAG.finditer(data)))
    name = re.match(rb"<(\w*)", tag[0])[1]
    end = data.find(b"</" + name + b">", tag.end())
    end = tag.end() if end < 0 or tag[0].endswith(b"/>") else end + len(name) + 3
    return data[: tag.start()] + data[end:]


_JOINT = (
    '<link name="{0}b{1}"/><joint name="{0}j{1}" type="{2}"><parent link="{3}"/><child link="{0}b{1}"/>'
    '<limit effort="1" velocity="1"/></joint>'
)


def with_many_joints(data, rng):
    """One on the other, or all on the same link; sometimes so many that a parser that calls itself has no stack."""
    n, kind = chosen(rng, [10, 50, 600, 3000]), chosen(rng, ["revolute", "fixed", "continuous"])
    first = chosen(rng, list(_NAME_OF_LINK.finditer(data)))[0].decode(errors="replace")
    chain = rng.rand() < 0.7
    more = "".join(_JOINT.format("n", i, kind, f"nb{i - 1}" if chain and i else first) for i in range(n))
    return data.replace(b"</robot>", more.encode() + b"</robot>")


def with_a_declaration(data, rng):
    entities = [f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10)]
    declared = [
        f'<!DOCTYPE r [<!ENTITY a0 "ha">{"".join(entities)}<!ENTITY a "&a9;">]>',
        '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE r [<!ENTITY % p SYSTEM "http://127.0.0.1:9/x"> %p; <!ENTITY a "b">]>',
        '<!DOCTYPE r SYSTEM "/dev/zero">',
        "<?xml-stylesheet href='file:///etc/passwd'?>",
        '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="file:///etc/passwd"/>',
    ]
    place = data.find(b"<robot") if rng.rand() < 0.8 else data.find(b">") + 1
    data = data[:place] + chosen(rng, declared).encode() + data[place:]
    return replaced(data, chosen(rng, list(_VALUE.finditer(data))), "&a;") if rng.rand() < 0.5 else data


def nested(data, rng):
    n, tag = chosen(rng, [50, 1000, 100_000]), chosen(rng, ["x", "link", "joint", "robot"])
    place = data.find(b">", data.find(b"<robot")) + 1
    return data[:place] + f"<{tag}>".encode() * n + data[place:] + f"</{tag}>".encode() * (n * rng.randint(2))


def in_another_encoding(data, rng):
    codec = chosen(rng, ["utf-16", "utf-32", "latin-1", "utf-7", "utf-8-sig", "shift_jis"])
    said = chosen(rng, [codec, "utf-8", "nonsense", "utf-16"])
    text = re.sub(r"^<\?xml.*?\?>", "", data.decode(errors="replace"), flags=re.DOTALL)
    return (f'<?xml version="1.0" encoding="{said}"?>' + text).encode(codec, "replace")


OF_XML = [
    *BYTES,
    with_another_value,
    with_another_value,
    with_another_value,
    with_anothers_value,
    with_other_parents,
    without_a_tag,
    with_tags_twice,
    without_an_element,
    with_many_joints,
    with_a_declaration,
    nested,
    in_another_encoding,
]

# --- tables ------------------------------------------------------------------------------------------------------


def with_other_cells(data, rng):
    lines = data.split(b"\n")
    for _ in range(chosen(rng, [1, 1, 3, 50])):
        row = rng.randint(len(lines))
        cells = lines[row].split(b",")
        cells[rng.randint(len(cells))] = encoded(chosen(rng, WORDS))
        lines[row] = b",".join(cells)
    return b"\n".join(lines)


def with_other_times(data, rng):
    lines = data.split(b"\n")
    first, stop = sorted(rng.randint(1, len(lines), 2))
    by = chosen(rng, [1e-9, 1e-3, 1e3, 1e12, 1e300, -1.0, 0.0])
    for row in range(first, stop):
        time, separator, rest = lines[row].partition(b"," if b"," in lines[row] else b" ")
        lines[row] = (repr(by * float(time)).encode() if time.strip() else time) + separator + rest
    return b"\n".join(lines)


def with_other_lines(data, rng):
    lines = data.split(b"\n")
    kind = rng.randint(6)
    row = rng.randint(len(lines))
    if kind == 0:
        lines[row] += b"," * chosen(rng, [1, 10_000])
    elif kind == 1:
        del lines[row : row + chosen(rng, [1, 10, 10_000])]
    elif kind == 2:
        rng.shuffle(lines)
    elif kind == 3:
        lines[row] = b'"' + lines[row]
    elif kind == 4:
        lines[row:row] = [chosen(rng, [b"", b"#", b"\x00", b",,,,,,,", b"a" * 10**6, lines[0], lines[-1]])] * 3
    else:
        return chosen(rng, [b"\r", b"\r\n", b"\n\n", b" ", b"\x0b", b"\xe2\x80\xa8"]).join(lines)
    return b"\n".join(lines)


def with_another_separator(data, rng):
    return data.replace(b",", chosen(rng, [b";", b"\t", b" ", b",,", b";,", b"|", b", ", b"\xff"]))


def in_another_codec(data, rng):
    return data.decode(errors="replace").encode(chosen(rng, ["utf-16", "utf-8-sig", "utf-32", "cp037"]), "replace")


def packed(data, rng):
    """As .gz, and damaged afterwards or before."""
    whole = gzip.compress(data)
    damaged = chosen(rng, BYTES)
    return chosen(rng, [whole, damaged(whole, rng), whole + gzip.compress(damaged(data, rng))])


OF_TABLES = [
    *BYTES,
    with_other_cells,
    with_other_cells,
    with_other_times,
    with_other_lines,
    with_other_lines,
    with_another_separator,
    in_another_codec,
    packed,
]

# --- recordings --------------------------------------------------------------------------------------------------


def with_a_huge_number(data, rng):
    """Where there may be a size, an offset or a count."""
    found, width = bytearray(data), chosen(rng, [1, 2, 4, 8])
    number = chosen(rng, [2**63 - 1, 2**64 - 1, 2**40, 2**32 - 1, 2**31, 10**6, 0])
    place = rng.randint(len(found) - width) if rng.rand() < 0.5 else rng.randint(min(400, len(found) - width))
    found[place : place + width] = (number % 256**width).to_bytes(width, chosen(rng, ["little", "big"]))
    return bytes(found)


def with_parts_exchanged(data, rng):
    found, length = bytearray(data), chosen(rng, [8, 64, 1000])
    one, other = rng.randint(max(1, len(found) - length), size=2)
    found[one : one + length], found[other : other + length] = data[other : other + length], data[one : one + length]
    return bytes(found)


def with_parts_again(data, rng):
    """Records of MCAP, pages of SQLite: read many times, they are more than the file."""
    length, place = chosen(rng, [9, 100, 4096]), rng.randint(len(data))
    return data[:place] + data[place : place + length] * chosen(rng, [2, 100]) + data[place:]


_SCRIPTS = [
    "UPDATE messages SET data = zeroblob(200000)",
    "UPDATE messages SET data = NULL",
    "UPDATE messages SET data = 'text', timestamp = 'x'",
    "UPDATE messages SET data = substr(data, 1, 30)",
    "UPDATE messages SET data = data || data",
    "UPDATE messages SET data = x'00010000ffffffffffffffffffffffffffffffff'",
    "UPDATE messages SET timestamp = -timestamp",
    "UPDATE messages SET timestamp = 9223372036854775807",
    "UPDATE messages SET topic_id = 999",
    "UPDATE topics SET type = 'std_msgs/msg/String'",
    "UPDATE topics SET type = '__import__(\"os\")', name = '../x'",
    "UPDATE topics SET serialization_format = 'pickle'",
    "DELETE FROM messages",
    "DELETE FROM topics",
]


def by_sql(data, rng):
    """A database that SQLite itself has written; of what is none, another number."""
    if not data.startswith(b"SQLite"):
        return with_a_huge_number(data, rng)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log.db3")
        path.write_bytes(data)
        database = sqlite3.connect(path)
        with suppress(sqlite3.Error):
            database.executescript(chosen(rng, _SCRIPTS))
        database.commit()
        database.close()
        return path.read_bytes()


OF_RECORDINGS = [
    *BYTES,
    with_a_huge_number,
    with_a_huge_number,
    with_a_huge_number,
    with_parts_exchanged,
    with_parts_again,
    by_sql,
]
