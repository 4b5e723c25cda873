"""Means, standard deviations and the worst of nested results over seeds."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from gnd.gnd_map.arrays import F64

_DIGITS = 6


def mean_over(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean of each number of results that are built alike; a seed without a value does not count."""
    return _over(results, lambda values: float(np.mean(values)))


def std_over(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the standard deviation (n - 1) of each number; None where there are fewer than two values."""
    return _over(results, lambda values: float(np.std(values, ddof=1)) if len(values) > 1 else None)


def distances_plain(distance_m: F64) -> dict[str, float | int | None]:
    """Return mean, standard deviation, median and 95 % quantile of distances (N,), None of none, and their number."""
    if not len(distance_m):
        return {"mean": None, "std": None, "median": None, "p95": None, "found": 0}
    return {
        "mean": float(distance_m.mean()),
        "std": float(distance_m.std()),
        "median": float(np.median(distance_m)),
        "p95": float(np.quantile(distance_m, 0.95)),
        "found": len(distance_m),
    }


def worst_of(many: Sequence[Mapping[str, Any]], smallest: Collection[str] = ()) -> dict[str, Any]:
    """Return the worst of nested results: numbers at their largest, those named in `smallest` at their smallest; None
    (there is no value at all) is worst.
    """
    return {key: _worst([one[key] for one in many if key in one], key, smallest) for key in many[0]}


def _worst(values: Sequence[Any], key: str, smallest: Collection[str]) -> Any:
    if any(value is None for value in values):
        return None
    if isinstance(values[0], Mapping):
        return worst_of(values, smallest)
    return min(values) if key in smallest else max(values)


def rounded(value: Any) -> Any:
    """Return plain values with their floats rounded."""
    if isinstance(value, Mapping):
        return {str(key): rounded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(one) for one in value]
    return round(float(value), _DIGITS) if isinstance(value, float) else value


def _over(results: Sequence[Mapping[str, Any]], of: Callable[[list[float]], float | None]) -> dict[str, Any]:
    return {key: _value([one[key] for one in results if key in one], of) for key in _keys(results)}


def _keys(results: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(key for one in results for key in one))


def _value(values: list[Any], of: Callable[[list[float]], float | None]) -> Any:
    if any(isinstance(value, Mapping) for value in values):
        return _over([value for value in values if value is not None], of)
    if any(isinstance(value, list | tuple) for value in values):
        return [_value(list(column), of) for column in zip(*values, strict=True)]
    numbers = [float(value) for value in values if value is not None]
    return of(numbers) if numbers else None
