"""Beyond which figures an operator is alerted: one file for `gnd status` and for the rules of Prometheus."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.fleet_bus.settings_file import read_toml
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.settings import check_settings, from_settings, setting

HOURS_A_DAY: Final = 24.0


@dataclass(frozen=True, slots=True)
class AlertThresholds:
    """What is still well. Beyond it `gnd status` and Prometheus alert, Prometheus only when it lasts."""

    queue_overdue_s: float = setting(60.0, "Longest wait of a ready tile for its merge.", unit="s", above=0)
    report_waiting_s: float = setting(600.0, "Longest wait of a report for a merge that reads it.", unit="s", above=0)
    merge_lag_s: float = setting(120.0, "Longest time from receipt to version, of 95 % of reports.", unit="s", above=0)
    tiles_set_aside: int = setting(0, "Most tiles that cannot be merged.", least=0)
    merges_failed_share: float = setting(0.05, "Largest share of merges that fail (rules alone).", above=0, most=1)
    store_failures: float = setting(5.0, "Most failed calls of the store in 5 min (rules alone).", least=0)
    quarantine_mb: float = setting(
        48.0, "Most refused messages that are kept; the oldest go at 64.", unit="MB", above=0
    )
    disk_low_gb: float = setting(5.0, "Room on the store's disk below which a warning is raised.", unit="GB", above=0)
    disk_full_gb: float = setting(0.5, "Room below which it is critical.", unit="GB", above=0)
    certificate_days: float = setting(7.0, "A certificate that holds less is a warning.", unit="days", above=0)
    certificate_hours: float = setting(36.0, "A certificate that holds less is critical.", unit="h", above=0)
    refusals_per_s: float = setting(1.0, "Most refusals of one kind and reason (rules alone).", unit="1/s", above=0)
    vehicles_held_back: int = setting(0, "Most vehicles that send more than their share (rules alone).", least=0)
    descriptors_share: float = setting(
        0.8, "Largest share of open files of those allowed (rules alone).", above=0, most=1
    )

    def __post_init__(self) -> None:
        check_settings(self, ConfigError)
        if self.disk_full_gb > self.disk_low_gb:
            raise ConfigError(f"disk_full_gb = {self.disk_full_gb} lies above disk_low_gb = {self.disk_low_gb}")
        if self.certificate_hours > HOURS_A_DAY * self.certificate_days:
            raise ConfigError(
                f"certificate_hours = {self.certificate_hours} lies above certificate_days = {self.certificate_days}"
            )


def load_thresholds(file: Path | None) -> AlertThresholds:
    """The thresholds of a TOML file; None: the defaults.

    Raises:
        ConfigError: the file cannot be read, has an unknown name, or a value out of range.
    """
    return AlertThresholds() if file is None else from_settings(AlertThresholds, read_toml(file), where=str(file))
