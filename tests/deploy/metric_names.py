"""The metrics that alert rules, dashboard and autoscaling ask for, by a parser of PromQL."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from manifests import DEPLOY, kustomized, of_kind

Asked = tuple[str, str, set[str]]
"""An expression, a metric in it, and the labels that are named for it or over it."""
MONITORING = DEPLOY / "monitoring"


def rules() -> list[dict[str, Any]]:
    """All alert rules."""
    read = yaml.safe_load((MONITORING / "alerts.yaml").read_text())
    return [rule for group in read["groups"] for rule in group["rules"]]


def panels() -> list[dict[str, Any]]:
    """The panels of the dashboard, with the rows."""
    found: list[dict[str, Any]] = json.loads((MONITORING / "dashboard.json").read_text())["panels"]
    return found


def of_alerts() -> list[Asked]:
    return [one for rule in rules() for one in asked(rule["expr"])]


def of_dashboard() -> list[Asked]:
    return [one for panel in panels() for target in panel.get("targets", []) for one in asked(target["expr"])]


def of_scaling() -> list[Asked]:
    scaled = of_kind(kustomized("production"), "ScaledObject")
    return [
        one for each in scaled for trigger in each["spec"]["triggers"] for one in asked(trigger["metadata"]["query"])
    ]


def asked(expression: str) -> list[Asked]:
    """What an expression asks for; ValueError when it is none."""
    parser = pytest.importorskip("promql_parser", reason="pip install promql-parser")
    return list(_asked(parser, expression, parser.parse(expression), frozenset()))


def _asked(parser: Any, expression: str, node: Any, over: frozenset[str]) -> Iterator[Asked]:
    """Walks down with the labels by which the sums above group."""
    if isinstance(node, parser.AggregateExpr):
        labels = frozenset(node.modifier.labels) if node.modifier is not None else frozenset()
        yield from _asked(parser, expression, node.expr, over | labels)
    elif isinstance(node, parser.BinaryExpr):
        yield from _asked(parser, expression, node.lhs, over)
        yield from _asked(parser, expression, node.rhs, over)
    elif isinstance(node, parser.Call):
        for argument in node.args:
            yield from _asked(parser, expression, argument, over)
    elif isinstance(node, parser.ParenExpr | parser.UnaryExpr | parser.SubqueryExpr):
        yield from _asked(parser, expression, node.expr, over)
    elif isinstance(node, parser.MatrixSelector):
        yield from _asked(parser, expression, node.vector_selector, over)
    elif isinstance(node, parser.VectorSelector):
        yield expression, str(node.name), set(over) | {one.name for one in node.matchers.matchers}
    else:
        assert isinstance(node, parser.NumberLiteral | parser.StringLiteral), f"{expression}: {node}"
