"""When the certificate in use ends: for Prometheus, and for the health page."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from gnd.fleet_bus.health import Check

if TYPE_CHECKING:  # a process without an identity loads nothing of it
    from gnd.fleet_bus.identity.renewal import CertificateWatch


class _CertificateCollector(Collector):
    def __init__(self, certificate: "CertificateWatch") -> None:
        self._certificate = certificate

    def collect(self) -> Iterator[GaugeMetricFamily]:
        help_text = "How long the certificate in use still holds, s."
        yield GaugeMetricFamily("gnd_certificate_left_seconds", help_text, value=self._certificate.left_s())


def register_certificate(registry: CollectorRegistry, certificate: "CertificateWatch | None") -> None:
    """Adds gnd_certificate_left_seconds; nothing for a process without a certificate."""
    if certificate is not None:
        registry.register(_CertificateCollector(certificate))


def certificate_checks(certificate: "CertificateWatch | None") -> dict[str, Check]:
    """The check that fails shortly before the certificate ends; none for a process without one."""
    return {} if certificate is None else {"certificate": certificate.check}
