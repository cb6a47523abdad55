"""Files that are nearly right: one value in JSON or XML is changed, the rest still parses."""

import json
import random
import re
from typing import Any

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 0.5, -0.0, 2**31, 2**53, 2**63, 10**30, 10**400, 1e308),
    *(-1e-320, float("nan"), float("inf"), [], {}, [0], [1, 2], [1, 2, 2], [[1, 2], [3, 40]]),
    *("", " ", "0", "1", "-1", "nan", "1e999", "1,2", "1,2;3,4", ";", "x", "x" * 300, {"a": []}),
    *("\ud800", "\n\r\u2028", "\x00", "../../etc/passwd", "left/000001.png", "image_3/7.png"),
    *("left_right_1.png", "pole", "rounded sign", "car", "line", "linestrip", "rectangle", "point"),
    *("circle", "peak", "bottom", "true", "false", "00000000-0000-8000-8000-000000000000"),
)
TAGS = ("polyline", "points", "box", "polygon", "tag", "image", "track", "attribute", "skeleton")


def mutated(data: bytes, rng: random.Random) -> bytes:
    """``data`` with one to four changes; some bytes of it where it is neither JSON nor XML."""
    for _ in range(rng.randint(1, 4)):
        if data.lstrip().startswith(b"<"):
            data = _xml(data, rng)
        else:
            try:
                document = json.loads(data)
            except (ValueError, RecursionError):
                return _bytes(data, rng)
            try:
                data = json.dumps(_json(document, rng)).encode()
            except RecursionError:  # nested deeper than Python writes, by several changes
                return _bytes(data, rng)
    return _bytes(data, rng) if rng.random() < 0.05 else data


def _json(document: Any, rng: random.Random) -> Any:
    nodes = [document]
    for node in nodes:
        parts = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        nodes.extend(parts)
    places = [node for node in nodes if isinstance(node, dict | list) and node]
    if not places:
        return rng.choice(VALUES)
    place = rng.choice(places)
    key = rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
    match rng.randrange(5):
        case 0:
            del place[key]
        case 1:
            place[key] = json.loads(json.dumps(rng.choice(nodes)))
        case 2 if isinstance(place, list):
            place.insert(key, json.loads(json.dumps(rng.choice(nodes))))
        case 3:
            for _ in range(rng.choice((1, 3, 50))):
                place[key] = [place[key]]
        case _:
            place[key] = rng.choice(VALUES)
    return document


def _xml(data: bytes, rng: random.Random) -> bytes:
    tokens = re.findall(rb"<[^>]*>|[^<]+", data) or [b"<annotations/>"]
    randrange, other = rng.randrange(len(tokens)), rng.randrange(len(tokens))
    match rng.randrange(6):
        case 0:
            del tokens[randrange]
        case 1:
            tokens.insert(other, tokens[randrange])
        case 2:
            tokens[randrange:randrange] = tokens[randrange : randrange + rng.randint(1, 12)]
        case 3:
            tag = rng.choice(TAGS).encode()
            tokens[randrange] = re.sub(rb"^(</?)\w+", rb"\1" + tag, tokens[randrange])
        case 4:
            tokens[randrange] = re.sub(rb' \w+="[^"]*"', b"", tokens[randrange], count=1)
        case _:
            shapes = [n for n, token in enumerate(tokens) if b'="' in token] or [randrange]
            randrange = rng.choice(shapes)
            value = str(rng.choice(VALUES)).encode("utf-8", "replace").replace(b'"', b"&quot;")
            found = list(re.finditer(rb'"[^"]*"', tokens[randrange])) or [
                re.match(rb"", tokens[randrange])
            ]
            spot = rng.choice(found)
            assert spot is not None
            tokens[randrange] = (
                tokens[randrange][: spot.start()]
                + b'"'
                + value
                + b'"'
                + tokens[randrange][spot.end() :]
            )
    return b"".join(tokens)


def _bytes(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    match rng.randrange(3):
        case 0:
            return data[:place]
        case 1:
            return data[:place] + rng.randbytes(rng.randint(1, 4)) + data[place + 1 :]
        case _:
            return data[:place] + data[place + rng.randint(1, 20) :]
