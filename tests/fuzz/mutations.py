"""Wrong inputs made of right ones: bytes, numbers, lines and structure are changed at random."""

import json
import random
import re
import struct
import zlib

_NUMBERS = (
    "nan",
    "-inf",
    "inf",
    "-1",
    "0",
    "1e30",
    "-1e308",
    "1e-30",
    "",
    "9" * 30,
    "9" * 5000,
    "0x" + "f" * 40,
    "true",
)
_TEXTS = (
    "",
    "x" * 300,
    "x" * 5000,
    "/dev/zero",
    "../../../../etc/passwd",
    "[red]x[/]",
    "\x1b[2J",
    "\u202e",
    "{index:1999999999d}",
    "{frame.__class__}",
    "{",
    "/**/*.png",
    "a\\u0000b",
    "=1+1",
    "<script>",
)
_WORDS = (b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", struct.pack("<f", float("nan")))


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """A file with a few of its bytes changed, left out, repeated or cut off."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        if not result:
            break
        start = rng.randrange(len(result))
        length = rng.choice((1, 4, 16, 100, max(1, len(result) // 4)))
        match rng.choice((0, 0, 0, 1, 2, 3, 4, 5, 5, 6, 6)):
            case 0:
                result[start] ^= 1 << rng.randrange(8)
            case 1:
                del result[start:]
            case 2:
                del result[start : start + length]
            case 3:
                result[start:start] = result[start : start + length]
            case 4:
                result[start:start] = rng.randbytes(min(length, 100))
            case 5:
                word = rng.choice(_WORDS)
                result[start : start + 4] = word
            case 6:
                # Sizes and counts are in the first bytes.
                start = rng.randrange(min(200, len(result)))
                result[start] = rng.randrange(256)
    return bytes(result)


def mutated_text(data: bytes, rng: random.Random) -> bytes:
    """A text file with tokens, lines or nesting changed."""
    if rng.random() < 0.1:
        return mutated_bytes(data, rng)
    text = data.decode("utf-8", "replace")
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        text = _changed(text, rng)
    return text.encode("utf-8", "surrogatepass")


def _changed(text: str, rng: random.Random) -> str:
    lines = text.split("\n")
    row = rng.randrange(len(lines))
    match rng.randrange(8):
        case 0 | 1 | 2:
            return _replaced(text, r"-?\d+\.?\d*(?:e-?\d+)?", rng.choice(_NUMBERS), rng)
        case 3:
            return _replaced(text, r"[A-Za-z_][\w./-]*", rng.choice((*_TEXTS, *_NUMBERS)), rng)
        case 4:
            del lines[row]
        case 5:
            lines.insert(rng.randrange(len(lines)), lines[row])
        case 6:
            other = rng.randrange(len(lines))
            lines[row], lines[other] = lines[other], lines[row]
        case 7:
            opening, closing = rng.choice((("[", "]"), ("{a=", "}"), ('{"a":', "}"), ("<a>", "</a>"), ("a.", "")))
            depth = rng.choice((1, 40, 3000, 50000))
            lines[row] += opening * depth + rng.choice(("", "1")) + closing * rng.choice((0, depth))
    return "\n".join(lines)


def _replaced(text: str, pattern: str, new: str, rng: random.Random) -> str:
    places = [match.span() for match in re.finditer(pattern, text)]
    if not places:
        return text + new
    start, end = rng.choice(places)
    return text[:start] + new + text[end:]


def mutated_png(data: bytes, rng: random.Random) -> bytes:
    """As `mutated_bytes`, mostly with right checksums, so that the decoder sees the change."""
    changed = bytearray(mutated_bytes(data, rng))
    if rng.random() < 0.7:
        position = 8
        while position + 12 <= len(changed):
            length = int.from_bytes(changed[position : position + 4], "big")
            end = position + 12 + length
            if end > len(changed):
                break
            changed[end - 4 : end] = zlib.crc32(changed[position + 4 : end - 4]).to_bytes(4, "big")
            position = end
    return bytes(changed)


def mutated_safetensors(data: bytes, rng: random.Random) -> bytes:
    """As `mutated_bytes`, or with another header of the right length."""
    if rng.random() < 0.3:
        return mutated_bytes(data, rng)
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    metadata = header["__metadata__"]
    if rng.random() < 0.6:
        key = rng.choice(sorted(metadata))
        metadata[key] = mutated_text(metadata[key].encode(), rng).decode("utf-8", "replace")
        text = json.dumps(header).encode()
    else:
        text = mutated_text(data[8 : 8 + length], rng)
    return len(text).to_bytes(8, "little") + text + data[8 + length :]
