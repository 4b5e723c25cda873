"""A plain LZF compressor, to test the decompressor against."""


def lzf_compress(data: bytes) -> bytes:
    """Literals of at most 32 bytes, and the longest earlier match at each place (slow and simple)."""
    out, literals, at = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            part = literals[start : start + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literals.clear()

    while at < len(data):
        length, distance = _longest_match(data, at)
        if length < 3:
            literals.append(data[at])
            at += 1
            continue
        flush()
        code, offset = length - 2, distance - 1
        out.append((min(code, 7) << 5) | (offset >> 8))
        if code >= 7:
            out.append(code - 7)
        out.append(offset & 255)
        at += length
    flush()
    return bytes(out)


def _longest_match(data: bytes, at: int) -> tuple[int, int]:
    best = (0, 0)
    for distance in range(1, min(at, 8192) + 1):
        length = 0
        while length < 264 and at + length < len(data) and data[at + length] == data[at + length - distance]:
            length += 1
        best = max(best, (length, distance), key=lambda found: found[0])
    return best
