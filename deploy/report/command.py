"""`gnd report`: a finished run as one page, and as PDF."""

import json
from pathlib import Path

import click

from gnd.deploy.html_page import check_writable

PATH = click.Path(path_type=Path)


@click.command()
@click.argument("run", type=PATH)
@click.option("--out", "-o", type=PATH, help="The page to write.  [default: report.html in the run]")
@click.option("--pdf", type=PATH, help="Print it as PDF, too; needs Chromium or Chrome on this machine.")
@click.option("--truth", type=PATH, help="Truth of the world, where it does not lie in the run (gnd fleet --worlds).")
@click.option(
    "--pictures",
    type=click.IntRange(0, 500),
    default=24,
    show_default=True,
    help="So many of the largest changes get a picture.",
)
@click.option("--json", "as_json", is_flag=True, help="Print what was written as JSON.")
def report(run: Path, out: Path | None, pdf: Path | None, truth: Path | None, pictures: int, as_json: bool) -> None:
    """Tell a finished RUN (a folder, or a name below runs/) as one HTML file that one can send to somebody.

    It holds the map before and after (and the truth of a simulated street), the changes as a list with pictures,
    figures, localisation, health, traffic against 3G, 4G and 5G, versions, settings, and the commands to do it again.
    Drives without truth are reported, too. Nothing in the file comes from elsewhere.
    """
    from gnd.deploy.report.finished_run import read_finished_run  # heavy: only when there is something to tell
    from gnd.deploy.report.page import write_report
    from gnd.deploy.report.printing import print_pdf

    found = read_finished_run(run, truth)
    page = out or found.folder.root / "report.html"
    for path in (page, *((pdf,) if pdf else ())):
        check_writable(path)
    write_report(page, found, pictures)
    if pdf is not None:
        print_pdf(page, pdf)
    if as_json:
        written = {"page": str(page), "bytes": page.stat().st_size, "pdf": str(pdf) if pdf else None}
        click.echo(json.dumps(written | {"missing": list(found.missing)}, indent=1))
        return
    click.echo(f"report written: {page} ({page.stat().st_size / 1e6:.1f} MB){f', {pdf}' if pdf else ''}")
    for line in found.missing:
        click.echo(f"  missing: {line}")
    click.echo("next: open it in a browser, or send it: it is one file and takes nothing from elsewhere")
