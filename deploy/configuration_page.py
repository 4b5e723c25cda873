"""`python -m gnd.deploy.configuration_page` writes docs/configuration.md from the code; --check compares them."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import click

from gnd.gnd_map.settings import Described, described

PAGE: Final = Path("docs/configuration.md")
_HEAD: Final = """\
# Configuration

Made from the code: `python -m gnd.deploy.configuration_page`.

Four programs take settings: `gnd agent`, `gnd fleet` (and `gnd lab`), `gnd merger` and `gnd store`. Each has the same
three options:

| option | what it does |
|---|---|
| `--config FILE` | takes settings from a TOML file |
| `--set NAME=VALUE` | replaces one setting, such as `report.longest_s=30`; values as in JSON; repeatable |
| `--dump-config` | prints the effective settings, exactly as `--config` takes them, and ends |

If a setting is given more than once, the later one in this list applies:

1. the defaults of this page,
2. the file,
3. the environment: `GND_AGENT__REPORT__LONGEST_S=30` is `report.longest_s` of the agent (`GND_`, the program, the
   name in capitals; two underscores for each dot),
4. `--set`,
5. the program's own options, such as `--link 4g`.

An unknown name is an error that lists similar names; a value outside its range is an error with value and
range. `gnd config check PROGRAM FILE` checks a file without running anything. The effective settings are written beside
every result: `settings.toml` in the folder of an agent and of a fleet run, and their SHA-256 as `settings_sha256` in
`result.json` and `summary.json`. A file of the fleet contains those of its agents and shards in the tables `[agent]`
and `[merger]` (in the environment: `GND_FLEET__AGENT__REPORT__LONGEST_S`; its agents do not read `GND_AGENT__...`):

```toml
agents = 4

[agent.report]
longest_s = 30.0

[merger]
poll_s = 0.5
```

The studies' `--set` (`gnd reproduce simulation --set detect.new_cells=35`) uses the same names; those of the merge
begin with `merge.`. Values that nobody needs to change are constants in the code.
"""


PROGRAMS: Final = {
    "agent": ("gnd.vehicle_agent.config:AgentConfig", "one vehicle"),
    "fleet": ("gnd.deploy.fleet_config:FleetConfig", "a whole fleet on one machine"),
    "merger": ("gnd.cloud_merger.config:ShardConfig", "one merger shard"),
    "store": ("gnd.tile_store.cli:TileServerConfig", "the tile server"),
}
"""The programs that take settings: the class of the settings, and what the program does."""


def settings_class(program: str) -> type[Any]:
    """The settings of a program; only its own packages are imported, so that it needs only its own extra."""
    module, name = PROGRAMS[program][0].split(":")
    found: type[Any] = getattr(importlib.import_module(module), name)
    return found


def page() -> str:
    """The page as Markdown."""
    parts = [_HEAD]
    for name, (_, what) in PROGRAMS.items():
        rows = list(described(settings_class(name)))
        parts.append(f"## gnd {name}\n\nSettings of {what}: {len(rows)}.\n\n" + "".join(_table(rows)))
    return "\n".join(parts)


def _table(rows: list[Described]) -> Iterator[str]:
    yield "| name | default | unit | range | effect |\n|---|---|---|---|---|\n"
    for row in rows:
        setting = row.setting
        default = f"`{row.default}`" if row.default else ""
        cells = (f"`{row.path}`", default, setting.unit, setting.range or row.kind, setting.effect)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


@click.command()
@click.option("--check", is_flag=True, help="Write nothing; exit code 1 if the page differs from the code.")
@click.option("--out", type=click.Path(path_type=Path), default=PAGE, show_default=True, help="The page.")
def main(check: bool, out: Path) -> None:
    """Write the page of settings from the code."""
    text = page()
    if not check:
        out.write_text(text, encoding="utf-8")
    elif not out.exists() or out.read_text(encoding="utf-8") != text:
        click.echo(f"{out} differs from the code: run python -m gnd.deploy.configuration_page", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
