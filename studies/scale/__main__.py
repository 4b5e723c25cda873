"""`python -m studies.scale [--out docs/scale.md] [--check]`: what cities, countries and the world would take."""

import sys
from pathlib import Path

import click

from studies.scale.page import page

PAGE = Path("docs/scale.md")


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the page here.")
@click.option("--check", is_flag=True, help=f"Fail if {PAGE} is not what would be written.")
def main(out: Path | None, *, check: bool) -> None:
    """Make the page of the committed measurements, and print, write or check it."""
    text = page()
    if check:
        if PAGE.read_text(encoding="utf-8") != text:
            click.echo(f"{PAGE} is not what `python -m studies.scale --out {PAGE}` writes", err=True)
            sys.exit(1)
    elif out is None:
        click.echo(text)
    else:
        out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(prog_name="python -m studies.scale")
