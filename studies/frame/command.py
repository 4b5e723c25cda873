"""The command of a study: its options, its folder, its processes; what it found as tables, JSON, Markdown, pictures.

@study(Options, out="runs/my-study")
def my_study(options: Options, bench: Bench) -> Report:
    \"\"\"What the help says.\"\"\"
    from studies.my_study import ...  # heavy imports wait until the options have been found good
    results = bench.run("drives", [Job("drive 1", drive, (options, kept))])
    return Report(found, sheets)
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.progress import Progress, TaskID

from gnd.deploy.live import progress_bars
from gnd.gnd_map.config import to_mapping
from studies.frame.folder import StudyFolder
from studies.frame.options import PATH, click_options, options_of
from studies.frame.pool import Job, run_jobs
from studies.frame.tables import Sheet, markdown_of, print_sheets

T = TypeVar("T")


@dataclass(slots=True)
class Bench:
    """What a study works with.

    Attributes:
        folder: keeps everything; a second start continues in it.
        processes: how many work at a time.
        progress: gets the bars.
        keep_drives: whether drives are kept as MCAP, too.
        pictures: whether pictures are wanted.
        given: the command line's values by name, as they were given.
        spent_s: seconds by the title of what was done.
    """

    folder: StudyFolder
    processes: int = 1
    progress: Progress = field(default_factory=lambda: Progress(disable=True))
    keep_drives: bool = False
    pictures: bool = True
    given: Mapping[str, Any] = field(default_factory=dict)
    spent_s: dict[str, float] = field(default_factory=dict)
    _steps: dict[str, TaskID] = field(default_factory=dict)

    def run(self, title: str, jobs: Sequence[Job]) -> list[Any]:
        """Do all jobs in the processes and return their results in order; their time counts under the title."""
        with self.timed(title):
            return run_jobs(jobs, self.processes, self.progress, title)

    @contextmanager
    def timed(self, title: str) -> Iterator[None]:
        """Count the seconds that a block takes under a title."""
        begun_s = perf_counter()
        yield
        self.spent_s[title] = self.spent_s.get(title, 0.0) + perf_counter() - begun_s

    def step(self, title: str, done: int, total: int) -> None:
        """Show how far something in this process is."""
        if title not in self._steps:
            self._steps[title] = self.progress.add_task(title, total=total)
        self.progress.update(self._steps[title], completed=done, total=total)


@dataclass(frozen=True, slots=True)
class StudyReport:
    """What a study found: plain values, tables, and what draws the pictures into a folder; the file of the values."""

    found: Mapping[str, Any]
    sheets: Sequence[Sheet]
    draw: Callable[[Path], object] | None = None
    file: str = "result.json"


def study(
    options: type[T], *, out: str, jobs: int | None = None, keeps_drives: bool = False, marked: bool = True
) -> Callable[[Callable[[T, Bench], StudyReport]], click.Command]:
    """Make a function of options and bench the command of a study.

    Args:
        options: a dataclass of `studies.frame.options`.
        out: the usual folder.
        jobs: the usual number of processes; None for one a core.
        keeps_drives: whether it has `--keep-drives`.
        marked: whether the folder is marked as the study's, which another command then refuses.
    """

    def command_of(work: Callable[[T, Bench], StudyReport]) -> click.Command:
        name = work.__name__.replace("_", "-")

        def run(**given: Any) -> None:
            how = {key: given.pop(key, None) for key in ("out", "json_file", "markdown_file", "jobs", "pictures")}
            keep_drives = given.pop("keep_drives", False)
            if how["jobs"] is not None and how["jobs"] < 1:
                raise click.BadParameter(f"at least one process is needed, got {how['jobs']}", param_hint="--jobs")
            if how["json_file"] == how["markdown_file"] == "-":
                raise click.BadParameter("only one of --json and --markdown can be printed", param_hint="--markdown")
            chosen = options_of(options, given)
            folder = StudyFolder.create(how["out"], name, marked=marked)
            if marked:
                folder.write_mark({"options": _plain(chosen)})
            with progress_bars(Console(stderr=True)) as progress:
                processes = how["jobs"] or jobs or os.cpu_count() or 1
                report = work(chosen, Bench(folder, processes, progress, keep_drives, how["pictures"], given))
            _tell(report, folder, how)

        shared = [
            click.Option(["--out"], type=PATH, default=Path(out), show_default=True, help="Folder that keeps all."),
            click.Option(["--json", "json_file"], help="Write the result as JSON; `-` prints it and nothing else."),
            click.Option(["--markdown", "markdown_file"], help="Write the tables as Markdown; `-` prints only them."),
            click.Option(["--jobs", "--processes", "jobs"], type=int,
                         help=f"Worker processes.  [default: {jobs or 'one a core'}]"),
            click.Option(["--pictures/--no-pictures"], default=True, show_default=True, help="Draw the figures."),
        ]  # fmt: skip
        if keeps_drives:
            shared.append(click.Option(["--keep-drives"], is_flag=True, help="Keep every drive as MCAP, too."))
        return click.Command(name, callback=run, params=[*click_options(options), *shared], help=work.__doc__)

    return command_of


def _plain(chosen: Any) -> dict[str, Any]:
    """The options as plain values; poses by their name."""
    plain = to_mapping(chosen)
    return plain | {name: str(getattr(chosen, name)) for name in plain if hasattr(getattr(chosen, name), "parse")}


plain_options = _plain


def _tell(report: StudyReport, folder: StudyFolder, how: Mapping[str, Any]) -> None:
    folder.write_json(report.file, report.found)
    if how["pictures"] and report.draw is not None:
        report.draw(folder.root)
    texts = {"json": lambda: json.dumps(report.found, indent=2) + "\n",
             "markdown": lambda: markdown_of(report.sheets, _command_line())}  # fmt: skip
    printed = [_written(how[f"{kind}_file"], text, f"--{kind}") for kind, text in texts.items()]
    if not any(printed):
        print_sheets(report.sheets)
        click.echo(f"everything else: {folder.root}")


def _written(file: str | None, text: Callable[[], str], option: str) -> bool:
    """Write or print a text; whether it was printed."""
    if file == "-":
        click.echo(text(), nl=False)
        return True
    if file is not None:
        try:
            Path(file).write_text(text(), encoding="utf-8")
        except OSError as error:
            raise click.BadParameter(f"cannot write {file}: {error.strerror}", param_hint=option) from error
    return False


def _command_line() -> str:
    """The command that makes the same numbers."""
    context = click.get_current_context()
    words = [f"gnd reproduce {context.command.name}"]
    for parameter in context.command.params:
        name = parameter.name or ""
        given = context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
        if given and name not in ("out", "json_file", "markdown_file", "jobs", "pictures", "keep_drives"):
            value = context.params[name]
            words += [f"{parameter.opts[0]} {one}" for one in (value if isinstance(value, tuple) else (value,))]
    return " ".join(words)
