"""Numbers with their nouns, for lines that people read."""


def many(number: int, noun: str, plural: str = "") -> str:
    """A number and what it counts: 1 tile, 2 tiles, 0 tiles; `plural` where an s is not enough."""
    return f"{number} {noun}" if number == 1 else f"{number} {plural or noun + 's'}"
