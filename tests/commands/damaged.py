"""Damaged copies of a good recording, by a generator with a fixed seed."""

import numpy as np
from commands import quirks

GOOD = "t,x\n" + quirks.table(quirks.T, quirks.swing())


def damages():
    """Name and function ``(random, bytes) -> bytes`` of each kind of damage."""
    return {
        "truncated": lambda random, raw: raw[: random.integers(1, len(raw))],
        "shuffled cells": shuffled_cells,
        "wrong separators": wrong_separators,
        "binary tail": lambda random, raw: raw + random.integers(0, 256, 400, dtype=np.uint8).tobytes(),
        "one bad cell": one_bad_cell,
        "many columns": lambda random, raw: raw + b",".join([b"1"] * int(10 ** random.uniform(3, 6))) + b"\n",
        "long line": lambda random, raw: raw + b"9" * int(10 ** random.uniform(4, 7)) + b",1\n",
        "nulls": nulls,
        "lines shuffled": lines_shuffled,
        "quotes": lambda random, raw: insert(random, raw, b'"'),
        "a byte changed": lambda random, raw: changed(random, raw),
        "lines lost": lines_lost,
        "header lost": lambda random, raw: raw.split(b"\n", 1)[1],
        "twice": lambda random, raw: raw + raw,
    }


def insert(random, raw, what):
    place = random.integers(0, len(raw))
    return raw[:place] + what + raw[place:]


def changed(random, raw):
    place = random.integers(0, len(raw))
    return raw[:place] + bytes([random.integers(0, 256)]) + raw[place + 1 :]


def nulls(random, raw):
    place = random.integers(0, len(raw))
    return raw[:place] + b"\0" * int(random.integers(1, 50)) + raw[place:]


def lines_shuffled(random, raw):
    head, *lines = raw.decode().splitlines(keepends=True)
    return (head + "".join(np.array(lines)[random.permutation(len(lines))])).encode()


def lines_lost(random, raw):
    head, *lines = raw.decode().splitlines(keepends=True)
    return (head + "".join(line for line in lines if random.uniform() > 0.3)).encode()


def shuffled_cells(random, raw):
    rows = [line.split(",") for line in raw.decode().splitlines()]
    for _ in range(int(random.integers(1, 30))):
        i, j = random.integers(1, len(rows), 2)
        a, b = random.integers(0, 2, 2)
        rows[i][a], rows[j][b] = rows[j][b], rows[i][a]
    return "\n".join(",".join(row) for row in rows).encode()


def wrong_separators(random, raw):
    lines = raw.decode().splitlines()
    for _ in range(int(random.integers(1, 200))):
        k = random.integers(0, len(lines))
        lines[k] = lines[k].replace(",", random.choice([";", "\t", " ", ",,", ""]))
    return "\n".join(lines).encode()


def one_bad_cell(random, raw):
    rows = [line.split(",") for line in raw.decode().splitlines()]
    bad = ["high", "1e999", "inf", "0x1F", "1_000", "1,5", "=A1", "12:61", "٣", "1.2.3", "--5", "1e", "+-1", "1 2", "#"]
    rows[random.integers(1, len(rows))][random.integers(0, 2)] = str(random.choice(bad))
    return "\n".join(",".join(row) for row in rows).encode()


def files(count, seed=17):
    """``count`` damaged files: name and bytes."""
    random = np.random.default_rng(seed)
    kinds = damages()
    for k in range(count):
        kind = list(kinds)[k % len(kinds)]
        yield kind, kinds[kind](random, GOOD.encode())
