"""Files of skevgp.io.save that somebody has damaged, or made so that they do harm."""

import json
import zipfile
from copy import deepcopy
from io import BytesIO

import numpy as np

from skevgp.io.of_maps import RECORDS as MAPS
from skevgp.io.of_models import RECORDS as MODELS

CLASSES = [record.name for record in (*MODELS, *MAPS)] + ["pinocchio.Model", "os.system", "builtins.eval", ""]
JUNK = [
    None,
    True,
    0,
    -1,
    3,
    10**9,
    2**62,
    10**30,
    1.5,
    -2.0,
    1e308,
    -1e308,
    5e-324,
    "",
    "x",
    "../../etc/passwd",
    "\x00\ud800",
    [],
    [[]],
    {},
    [None] * 50,
    {"float": "nan"},
    {"float": "-inf"},
    {"float": "1_0"},
    {"number": ["int64", -5]},
    {"number": ["float32", 1e300]},
    {"tuple": []},
    {"tuple": [1, 2, 3]},
    {"dict": [["a", 1], ["a", 2]]},
    {"dict": [[[], 1]]},
    {"slice": [0, 10**9, -1]},
    {"slice": [{}, 1, 2]},
    {"type": "float64"},
    {"type": "eval"},
    {"dtype": "|O"},
    {"dtype": "<U999999"},
    {"words": [[2], "O", ["a", "b"]]},
    {"words": [[10**9, 0], "U", []]},
    {"words": [[3], "U", ["a"]]},
    {"frame": ["os", []]},
    {"frame": ["pandas", [["a", {"words": [[1], "O", ["a"]]}]]]},
    {"object": -1},
    {"object": 10**9},
    {"array": 10**9},
    {"object": True},
    {"_known": 1},
]


def members_of(data):
    """Names and bytes of the members of a good file."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        return [(info.filename, archive.read(info)) for info in archive.infolist()]


def zipped(members):
    file = BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


def places_in(value, path=()):
    """The paths of all values in some JSON."""
    yield path
    if isinstance(value, dict):
        for key, own in value.items():
            yield from places_in(own, (*path, key))
    elif isinstance(value, list):
        for index, own in enumerate(value):
            yield from places_in(own, (*path, index))


def put(content, path, value):
    for step in path[:-1]:
        content = content[step]
    content[path[-1]] = deepcopy(value)


def at(content, path):
    for step in path:
        content = content[step]
    return content


# --- bytes -------------------------------------------------------------------------------------------------------


def flipped_bits(data, rng):
    found = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 8, 64])):
        found[rng.randint(len(found))] ^= 1 << rng.randint(8)
    return bytes(found)


def truncated(data, rng):
    return data[: rng.randint(len(data))]


def cut_out(data, rng):
    first, length = rng.randint(len(data)), rng.choice([1, 2, 7, 100, 5000])
    return data[:first] + data[first + length :]


def overwritten(data, rng):
    first, length = rng.randint(len(data)), rng.choice([1, 4, 64, 1000])
    length = min(length, len(data) - first)
    filling = rng.choice(["zeros", "ones", "noise"])
    new = {"zeros": bytes(length), "ones": b"\xff" * length, "noise": rng.bytes(length)}[filling]
    return data[:first] + new + data[first + length :]


def flipped_in_the_directory(data, rng):
    found = bytearray(data)
    first = data.rindex(b"PK\x05\x06") if rng.rand() < 0.3 else data.index(b"PK\x01\x02")
    found[rng.randint(first, len(found))] = rng.randint(256)
    return bytes(found)


# --- arrays ------------------------------------------------------------------------------------------------------


def with_another_array(data, rng):
    """The checksums are right, and what an array holds is not."""
    members = members_of(data)
    number = rng.choice([i for i, (name, _) in enumerate(members) if name.endswith(".npy")])
    name, content = members[number]
    values = np.load(BytesIO(content))
    flat = values.reshape(-1)
    kind = rng.randint(9)
    if kind == 0:
        values = values[:-1] if values.ndim else values.reshape(1)
    elif kind == 1:
        values = values.reshape(1, *values.shape)
    elif kind == 2:
        values = values.astype(rng.choice(["f4", "i8", "b1", "u1", "f2"]))
    elif kind == 3:
        values = values.T.copy()
    elif kind == 4:
        values = np.repeat(values, 2, axis=0) if values.ndim else values
    elif kind == 5:
        values = np.empty((0, *values.shape[1:]), values.dtype)
    elif flat.size and values.dtype.kind == "f":
        flat[rng.randint(flat.size)] = rng.choice([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, 1e-300, -1e8])
    elif flat.size:
        flat[rng.randint(flat.size)] = 1 if values.dtype.kind == "b" else rng.choice([10**6, 127])
    buffer = BytesIO()
    np.save(buffer, values)
    members[number] = name, buffer.getvalue()
    return zipped(members)


def with_swapped_arrays(data, rng):
    members = members_of(data)
    arrays = [i for i, (name, _) in enumerate(members) if name.endswith(".npy")]
    first, second = rng.choice(arrays, 2)
    (one, its), (other, others) = members[first], members[second]
    members[first], members[second] = (one, others), (other, its)
    return zipped(members)


def with_another_header(data, rng):
    members = members_of(data)
    number = rng.choice([i for i, (name, _) in enumerate(members) if name.endswith(".npy")])
    name, content = members[number]
    header, rest = content[:128], content[128:]
    changes = [
        (b"(", b"(99999999999, "),
        (b"<f8", b"|O8"),
        (b"<f8", b">f8"),
        (b"False", b"True "),
        (b"True", b"False"),
        (b"{", b"{" * 20),
        (b"'shape'", b"'shapes'"),
        (b"(", b"(-"),
        (b"NUMPY\x01", b"NUMPY\x02"),
        (b"<f8", b"<U8"),
    ]
    old, new = changes[rng.randint(len(changes))]
    members[number] = name, header.replace(old, new, 1)[:128].ljust(128) + rest
    return zipped(members)


# --- JSON --------------------------------------------------------------------------------------------------------


def with_another_text(data, rng):
    members = dict(members_of(data))
    content = json.loads(members["model.json"])
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        places = [path for path in places_in(content) if path]
        path = places[rng.randint(len(places))]
        kind = rng.randint(8)
        if kind == 0 and isinstance(path[-1], str):
            del at(content, path[:-1])[path[-1]]
        elif kind == 1:
            put(content, path, at(content, places[rng.randint(len(places))]))
        elif kind == 2 and "objects" in content:
            classes = [p for p in places if p[-1] == "class"]
            put(content, classes[rng.randint(len(classes))] if classes else path, CLASSES[rng.randint(len(CLASSES))])
        elif kind == 3:
            put(content, path, {rng.choice(["object", "array"]): int(rng.randint(60))})
        elif kind == 4:
            number = at(content, path)
            if type(number) in (int, float):
                put(content, path, [-number, number * 1e9, number + 1, 0, 1e-300][rng.randint(5)])
        elif kind == 5:
            numbers = [p for p in places if type(at(content, p)) in (int, float)]
            put(content, numbers[rng.randint(len(numbers))] if numbers else path, JUNK[rng.randint(len(JUNK))])
        else:
            put(content, path, JUNK[rng.randint(len(JUNK))])
        if not isinstance(content, dict):
            break
    members["model.json"] = json.dumps(content).encode("utf-8", "surrogatepass")
    return zipped(members.items())


def with_another_script(data, rng):
    """What is no JSON, or more than that."""
    members = dict(members_of(data))
    text = members["model.json"]
    texts = [
        b"",
        b"null",
        b"[]",
        b"{}",
        b"[" * 100_000,
        b'{"a":' * 100_000,
        text + text,
        text[:-1],
        text.replace(b"null", b"NaN", 1),
        text.replace(b'"fields"', b'"fields":{},"fields"', 1),
        text.replace(b'"version":1', b'"version":' + b"9" * 5000),
        text.replace(b'"version":1', b'"version":2'),
        text.replace(b'"version":1', b'"version":1.0'),
        text.replace(b'"version":1', b'"version":0'),
        text.replace(b'"format":"skevgp"', b'"format":"other"'),
        text.decode().encode("utf-16"),
        b"\xff\xfe" + text,
        text.replace(b'"', b"'"),
        text.replace(b'"objects":[', b'"objects":[' + b"[" * 60 + b"]" * 60 + b",", 1),
        text.replace(b'"class":', b'"class":"a","class":', 1),
    ]
    members["model.json"] = texts[rng.randint(len(texts))]
    return zipped(members.items())


def with_a_cycle(data, rng):
    members = dict(members_of(data))
    content = json.loads(members["model.json"])
    objects = content["objects"]
    number = rng.randint(len(objects))
    names = list(objects[number]["fields"]) or ["x"]
    later = int(rng.randint(number, len(objects)))
    objects[number]["fields"][names[rng.randint(len(names))]] = {"object": later}
    members["model.json"] = json.dumps(content).encode()
    return zipped(members.items())


def with_many_parts(data, rng):
    """Each object twice in the next one: 2^60 of them for whoever follows all."""
    members = dict(members_of(data))
    content = json.loads(members["model.json"])
    first = len(content["objects"])
    leaf = {"class": "sklearn.DotProduct", "fields": {"sigma_0": 1.0, "sigma_0_bounds": "fixed"}}
    both = [
        {"class": "sklearn.Sum", "fields": {"k1": {"object": first + i}, "k2": {"object": first + i}}}
        for i in range(60)
    ]
    content["objects"] += [leaf, *both]
    members["model.json"] = json.dumps(content).encode()
    return zipped(members.items())


# --- zip ---------------------------------------------------------------------------------------------------------


def with_a_trick(data, rng):
    members = members_of(data)
    kind = rng.randint(10)
    if kind == 0:
        return _deflated(members)
    if kind == 1:
        return _deflated([*members, ("bomb.npy", bytes(10**7))])
    if kind == 2:
        return b"#!/bin/sh\n" * 3 + data
    if kind == 3:
        return data + rng.bytes(50)
    if kind == 4:
        return _twice(members, members[rng.randint(len(members))])
    if kind == 5:
        return zipped(members[rng.randint(1, len(members)) :])
    if kind == 6:
        return zipped([(f"../{name}", content) for name, content in members])
    if kind == 7:
        return data.replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00")
    if kind == 8:
        return _all_at_one_place(data)
    return zipped(members[::-1])


def _deflated(members):
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return file.getvalue()


def _twice(members, again):
    other = again[0][:-1] + "?"
    # A zip program warns of the same name twice: it is put there afterwards.
    return zipped([*members, (other, again[1])]).replace(other.encode(), again[0].encode())


def _all_at_one_place(data):
    """All entries of the directory refer to the largest member."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        largest = max(archive.infolist(), key=lambda info: info.file_size)
    found, place = bytearray(data), data.index(b"PK\x01\x02")
    while found[place : place + 4] == b"PK\x01\x02":
        length = 46 + sum(int.from_bytes(found[place + i : place + i + 2], "little") for i in (28, 30, 32))
        found[place + 16 : place + 28] = largest.CRC.to_bytes(4, "little") + largest.file_size.to_bytes(4, "little") * 2
        found[place + 42 : place + 46] = largest.header_offset.to_bytes(4, "little")
        place += length
    return bytes(found)


CORRUPTIONS = [
    flipped_bits,
    truncated,
    cut_out,
    overwritten,
    flipped_in_the_directory,
    with_another_array,
    with_another_array,
    with_swapped_arrays,
    with_another_header,
    with_another_text,
    with_another_text,
    with_another_text,
    with_another_script,
    with_a_cycle,
    with_many_parts,
    with_a_trick,
]
