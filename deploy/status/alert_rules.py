"""The rules of Prometheus with the thresholds of a file in them."""

import string
from dataclasses import fields
from pathlib import Path
from typing import Final

from gnd.deploy.status.thresholds import AlertThresholds

TEMPLATE: Final = Path(__file__).with_name("alert_rules.template.yaml")


class _RuleTemplate(string.Template):
    """Names stand as @{name}: `$` belongs to Prometheus."""

    delimiter = "@"


def alert_rules(thresholds: AlertThresholds) -> str:
    """The rules as YAML, as `deploy/monitoring/alerts.yaml` holds those of the defaults."""
    values = {one.name: f"{getattr(thresholds, one.name):g}" for one in fields(thresholds)}
    values["merges_failed_percent"] = f"{100 * thresholds.merges_failed_share:g}"
    return _RuleTemplate(TEMPLATE.read_text(encoding="utf-8")).substitute(values)
