"""An independent reader of ``.nsvq`` files: the Python of docs/nsvq_format.md, block by block, in plain NumPy.

It shares no code with the package and is slow. Tests compare its numbers with those of the package, and its text with
the page, so that another reader can be written from the page alone.
"""

import hashlib
import json
import math
import struct

import numpy as np


def refuse(what):
    raise AssertionError(what)


def unframe(data):
    assert data[:8] == b"\x89NSVQ\r\n\x1a"
    assert len(data) >= 32
    assert hashlib.blake2b(data[24:], digest_size=16).digest() == data[8:24]
    version, length = struct.unpack_from("<II", data, 24)
    assert version in (2, 3, 4)
    assert 32 + length <= len(data)
    header = json.loads(data[32 : 32 + length].decode("utf-8"), parse_constant=refuse)
    header["version"] = version
    streams, at = {}, 32 + length
    for name, size, _ in header["streams"]:
        streams[name] = data[at : at + size]
        at += size
    assert at == len(data)
    assert len(streams) == len(header["streams"])
    return header, streams


def attribute_table(header):
    keys = ("name", "dim", "storage", "codes", "step")
    return {row[0]: dict(zip(keys, row, strict=True)) for row in header["attributes"]}


DIMS = {"means": 3, "opacities": 1, "quats": 4, "scales": 3, "sh0": 3}
ORDERS = {
    "paper": ["means", "opacities", "quats", "scales", "sh0", "shN"],
    "compact": ["opacities", "scales", "means", "quats", "sh0", "shN"],
}
FEW_SPLATS, FEW_ROWS = 2**18, 2**16


def natural(value):
    return type(value) is int and value >= 0


def number(value):
    return type(value) in (int, float)


def check(header, streams):
    level, count, degree, origin, metrics = (header[k] for k in ("level", "splats", "sh_degree", "origin", "metrics"))
    assert level in ("compact", "paper")
    assert natural(count)
    assert natural(degree)
    assert degree <= 3
    assert type(origin) is list
    assert len(origin) == 3
    assert all(number(value) and math.isfinite(value) for value in origin)
    cameras = header.get("cameras", [])
    assert type(cameras) is list
    assert len(cameras) <= 64
    for camera in cameras:
        assert type(camera) is list
        assert len(camera) == 4
        assert all(number(value) and math.isfinite(value) for value in camera)
        assert camera[3] > 0
    assert type(header["config"]) is dict
    assert type(metrics) is dict
    assert all(value is None or number(value) for value in metrics.values())
    table, compact = attribute_table(header), level == "compact"
    assert [*table] == ORDERS[level]
    assert len(table) == len(header["attributes"])
    for name, entry in table.items():
        dim, storage, codes, step = (entry[key] for key in ("dim", "storage", "codes", "step"))
        assert natural(dim)
        assert dim == DIMS.get(name, 3 * ((degree + 1) ** 2 - 1))
        own = {"means": "cells", "opacities": "levels"}.get(name, "steps") if compact else "raw"
        coded = storage == "codes" and name not in ("means", "opacities")
        components = compact and storage == "components" and name == "shN"
        assert storage == own or ((coded or components) and dim > 0)
        most = {"codes": 2**32, "levels": 2**20, "components": dim}.get(storage, 0)
        assert natural(codes)
        assert min(most, 1) <= codes <= most
        assert number(step)
        assert 0 <= step < math.inf
        assert (step > 0) == (compact and storage != "levels")
        assert not components or step in [2.0**-power for power in range(150)]
    expected = expected_streams(table.values(), count, compact)
    for row, (name, encoding, length) in zip(header["streams"], expected, strict=True):
        assert row == [name, row[1], encoding]
        assert natural(row[1])
        assert length in (row[1], None)
    if compact:
        assert len(streams["means.far"]) % 12 == 0
        assert len(streams["means.far"]) <= 12 * count
        assert count <= max(FEW_SPLATS, sum(map(len, streams.values())) // 2)
        for name, entry in table.items():
            assert entry["storage"] != "codes" or entry["codes"] <= max(FEW_ROWS, len(streams[f"{name}.codebook"]))


def expected_streams(rows, count, compact):
    """Name, encoding and length of each stream; the length is None where the header alone says it."""
    coded = [row for row in rows if row["storage"] == "codes"]
    if not compact:
        bits = sum((row["codes"] - 1).bit_length() for row in coded)
        return [
            *((row["name"], "float32", 4 * count * row["dim"]) for row in rows if row["storage"] == "raw"),
            *([("codes", "bits", -(-count * bits // 8))] if coded else []),
            *((f"{row['name']}.codebook", "float32", 4 * row["codes"] * row["dim"]) for row in coded),
        ]
    found = []
    for row in rows:
        name, storage = row["name"], row["storage"]
        if name == "means":
            found += [("means.grid", "grid", 32), ("means", "keys", None), ("means.far", "float32", None)]
        elif storage == "codes":
            found += [(f"{name}.codebook", "integers", None), (name, "paths", None)]
        elif storage == "components":
            found += [(f"{name}.basis", "integers", None), (name, "integers", None)]
        else:
            found.append((name, "paths" if storage == "levels" else "integers", None))
    return found


def float_rows(data, dim):
    return np.frombuffer(data, "<f4").reshape(-1, dim) if dim else None


def decode_paper(header, streams):
    table, count = attribute_table(header), header["splats"]
    rows = {}
    coded = [entry for entry in table.values() if entry["storage"] == "codes"]
    record = sum((entry["codes"] - 1).bit_length() for entry in coded)
    stream, at = int.from_bytes(streams["codes"] if coded else b"", "little"), 0
    for name, entry in table.items():
        if entry["storage"] == "raw":
            rows[name] = float_rows(streams[name], entry["dim"])
            continue
        bits = (entry["codes"] - 1).bit_length()
        codes = [(stream >> (i * record + at)) & ((1 << bits) - 1) for i in range(count)]
        at += bits
        assert all(code < entry["codes"] for code in codes)
        rows[name] = float_rows(streams[f"{name}.codebook"], entry["dim"])[np.array(codes, int)]
    return rows


RATES = [(1310720 + 10 * n + 16) // (20 * n + 32) for n in range(127)]


def state_of(states, context, contexts):
    return states.get(context, (32768, 0 if len(contexts) == 1 else 2))


def probability(states, contexts):
    """Of a 1, in units of 1/65536, by one context or two."""
    return sum(state_of(states, context, contexts)[0] for context in contexts) // len(contexts)


def learn(states, contexts, bit):
    for context, limit in zip(contexts, (126,) if len(contexts) == 1 else (60, 6), strict=True):
        p, n = state_of(states, context, contexts)
        target = 65488 if bit else 48
        states[context] = p + (((target - p) * RATES[n]) >> 16), min(n + 1, limit)


class RangeDecoder:
    def __init__(self, data):
        assert len(data) % 4 == 0
        self.words = [int(word) for word in np.frombuffer(data, "<u4")]
        self.used = 0
        self.code = self.word() << 32
        self.code |= self.word()
        self.width = 2**64 - 1
        self.states = {}

    def word(self):
        self.used += 1
        return self.words[self.used - 1] if self.used <= len(self.words) else 0

    def refill(self):
        if self.width < 2**32:
            self.width <<= 32
            self.code = ((self.code << 32) | self.word()) & (2**64 - 1)

    def bit(self, *contexts):
        part = (self.width >> 16) * probability(self.states, contexts)
        if self.code < part:
            bit, self.width = 1, part
        else:
            bit, self.code, self.width = 0, self.code - part, self.width - part
        learn(self.states, contexts, bit)
        self.refill()
        return bit

    def plain(self, bits):
        """A number of this many bits, without a model; 0 for bits <= 0."""
        value = 0
        while bits > 0:
            now = min(bits, 16)
            bits -= now
            self.width >>= now
            digit = min(self.code // self.width, (1 << now) - 1)
            self.code -= digit * self.width
            value = (value << now) | digit
            self.refill()
        return value

    def end(self):
        assert self.used == len(self.words) + 1


def leaf_paths(count):
    """Path of each leaf."""
    bits, paths = (count - 1).bit_length(), []
    for leaf in range(count):
        low, high, path = 0, count, 0
        for _ in range(bits):
            cut = low + (high - low + 1) // 2
            right = high - low > 1 and leaf >= cut
            path = 2 * path + right
            if high - low > 1:
                low, high = (cut, high) if right else (low, cut)
        paths.append(path)
    return paths


def decode_paths(data, count, neighbours, two=True):
    """Leaf of each row; count is K, neighbours [N] holds pairs of rows, -1 for none; two from version 4 on."""
    decoder, bits = RangeDecoder(data), (count - 1).bit_length()
    plain, paths = max(0, bits - 16), []
    for first, second in neighbours:
        others = [paths[row] if row >= 0 else -1 for row in (first, second)]
        path = 0
        for left in range(bits - 1, plain - 1, -1):  # how many decisions come after this one
            said = [1 + ((other >> left) & 1) if other >> (left + 1) == path else 0 for other in others]
            node = (1 << (bits - 1 - left)) + path
            contexts = [(node, *said), node] if two else [(node, *said)]
            path = 2 * path + decoder.bit(*contexts)
        paths.append((path << plain) + decoder.plain(plain))
    decoder.end()
    leaf_of = {path: leaf for leaf, path in enumerate(leaf_paths(count))}
    return np.array([leaf_of[path] for path in paths], np.int64)


def read_length(decoder, context):
    """A number below 64; the context of a decision is how the decisions before it went."""
    node = 1
    for _ in range(6):
        node = 2 * node + decoder.bit((context, node))
    return node - 64


def decode_integers(data, rows, columns):
    assert len(data) >= columns
    assert all(mode < 4 for mode in data[:columns])
    decoder = RangeDecoder(data[columns:])
    values = np.zeros((rows, columns), np.int64)
    for i in range(rows):
        for j in range(columns):
            length = read_length(decoder, ("length", j))
            assert length <= 53
            negative = decoder.plain(1) if length > 0 else 0
            size = min(length, 1)
            if length > 1:
                size = 2 + decoder.bit(("second", j, length))
                size = (size << (length - 2)) + decoder.plain(length - 2)
            value, by_rows, by_columns = -size if negative else size, data[j] & 1 and i > 0, data[j] & 2 and j > 0
            if by_columns:
                value += int(values[i, j - 1])
            if by_rows:
                value += int(values[i - 1, j]) - (int(values[i - 1, j - 1]) if by_columns else 0)
            assert abs(value) < 2**52
            values[i, j] = value
    decoder.end()
    return values


def rows_before(count):
    return [(i - 1, max(i - 2, -1)) for i in range(count)]


def near_rows(points, count):
    """points: of the splats inside the grid, as tuples of integers; count: N."""
    neighbours = rows_before(count)
    for i, point in enumerate(points):
        window = range(max(0, i - 16), i)
        ranked = sorted((sum((a - b) ** 2 for a, b in zip(point, points[j], strict=True)), j) for j in window)
        first, second = [j for _, j in ranked[:2]] + [-1] * (2 - len(ranked[:2]))
        neighbours[i] = first, second
    return neighbours


LN2 = float.fromhex("0x1.62e42fefa39efp-1")


def depths_of(scales, scale_step, doublings, levels, level_count):
    """scales: int64 [N, 3]; levels: int64 [N]."""
    factor = (scale_step / 3.0) / LN2
    x = scales.sum(axis=1).astype(np.float64) * factor + doublings
    mantissas, exponents = np.frexp((np.arange(level_count) + 0.5) / level_count)
    x = x - 0.5 * ((2.0 * mantissas - 2.0) + exponents)[levels]
    return [21 - math.floor(min(max(value, 0.0), 21.0)) for value in x.tolist()]


def decode_keys(data, depths):
    """Keys of the splats inside the grid, of which depths has one entry each."""
    decoder, keys, last, before = RangeDecoder(data), [], 0, 0
    for depth in depths:
        shift = 63 - 3 * depth
        length = read_length(decoder, (depth, before // 6))
        assert length <= 3 * depth
        step = (1 << (length - 1)) + decoder.plain(length - 1) if length else 0
        last = ((last >> shift) + step) << shift
        assert last < 1 << 63
        before = length + shift if length else 0
        keys.append(last)
    decoder.end()
    return keys


def decode_positions(keys, depths, base, step):
    """Positions [N - F, 3], and the points for near rows."""
    means, points = [], []
    for key, depth in zip(keys, depths, strict=True):
        width = 1 << (21 - depth)
        corner = [sum(((key >> (3 * bit + 2 - axis)) & 1) << bit for bit in range(21)) for axis in range(3)]
        means.append([((float(corner[a]) + 0.5 * width) + float(base[a])) * step for a in range(3)])
        points.append(tuple(c + (width >> 1) for c in corner))
    with np.errstate(over="ignore"):
        return np.array(means, np.float64).reshape(-1, 3).astype(np.float32), points


def opacity_table(count):
    shares = (np.arange(count) + 0.5) / count
    return (np.log(shares) - np.log1p(-shares)).astype(np.float32)


def values_of(integers, step):
    with np.errstate(over="ignore"):
        return (integers.astype(np.float64) * step).astype(np.float32)


def decode_compact(header, streams):
    table, count, two = attribute_table(header), header["splats"], header["version"] > 3
    leaves, integers, rows = {}, {}, {}

    def decode(name, neighbours):
        entry = table[name]
        if entry["storage"] == "steps":
            integers[name] = decode_integers(streams[name], count, entry["dim"])
            return
        if entry["storage"] == "components":
            basis = decode_integers(streams[f"{name}.basis"], entry["codes"], entry["dim"])
            coefficients = decode_integers(streams[name], count, entry["codes"])
            assert all((np.abs(values) < 2**23).all() for values in (basis, coefficients))
            integers[name] = coefficients @ basis
            return
        leaves[name] = decode_paths(streams[name], entry["codes"], neighbours, two)
        if entry["storage"] == "codes":
            codebook = decode_integers(streams[f"{name}.codebook"], entry["codes"], entry["dim"])
            integers[name] = codebook[leaves[name]]

    for name in ("opacities", "scales"):
        decode(name, rows_before(count))
    *base, doublings = struct.unpack("<qqqd", streams["means.grid"])
    assert math.isfinite(doublings)
    far = float_rows(streams["means.far"], 3)
    levels, level_count = leaves["opacities"], table["opacities"]["codes"]
    depths = depths_of(integers["scales"], table["scales"]["step"], doublings, levels, level_count)
    depths = depths[: count - len(far)]
    keys = decode_keys(streams["means"], depths)
    means, points = decode_positions(keys, depths, base, table["means"]["step"])
    rows["means"] = np.concatenate([means, far])
    near = near_rows(points, count)
    for name in ("quats", "sh0", "shN"):
        decode(name, near)
    rows["opacities"] = opacity_table(level_count)[levels]
    for name, values in integers.items():
        rows[name] = values_of(values, table[name]["step"])
    return rows


def read_nsvq(path):
    with open(path, "rb") as file:
        header, streams = unframe(file.read())
    check(header, streams)
    rows = (decode_compact if header["level"] == "compact" else decode_paper)(header, streams)
    count, higher = header["splats"], (header["sh_degree"] + 1) ** 2 - 1
    if higher == 0:
        rows["shN"] = np.zeros((count, 0), np.float32)
    return {
        "means": rows["means"],
        "quats": rows["quats"],
        "scales": rows["scales"],
        "opacities": rows["opacities"].reshape(count),
        "sh0": rows["sh0"].reshape(count, 1, 3),
        "shN": rows["shN"].reshape(count, higher, 3),
    }


class RangeEncoder:
    def __init__(self):
        self.words, self.low, self.width, self.states = [], 0, 2**64 - 1, {}

    def carry(self):
        if self.low >= 2**64:
            self.low -= 2**64
            at = len(self.words) - 1
            while self.words[at] == 2**32 - 1:
                self.words[at] = 0
                at -= 1
            self.words[at] += 1

    def flush(self):
        self.carry()
        if self.width < 2**32:
            self.words.append(self.low >> 32)
            self.low = (self.low << 32) & (2**64 - 1)
            self.width <<= 32

    def bit(self, bit, *contexts):
        part = (self.width >> 16) * probability(self.states, contexts)
        if bit:
            self.width = part
        else:
            self.low, self.width = self.low + part, self.width - part
        learn(self.states, contexts, bit)
        self.flush()

    def plain(self, value, bits):
        while bits > 0:
            now = min(bits, 16)
            bits -= now
            self.width >>= now
            self.low += self.width * ((value >> bits) & ((1 << now) - 1))
            self.flush()

    def end(self):
        self.low += 2**32 - 1
        self.carry()
        return np.array([*self.words, self.low >> 32], "<u4").tobytes()
