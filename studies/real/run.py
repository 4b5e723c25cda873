"""A run from options to the result."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

from gnd.vehicle_agent.importer import AUTO, open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording
from studies.real.options import RealOptions
from studies.real.pictures import draw_round
from studies.real.rounds import Round, run_round
from studies.real.scene import load
from studies.real.scores import summary_of

Progress = Callable[[str, int, int], None]


def reproduce_real(options: RealOptions, out: Path | None, progress: Progress) -> dict[str, Any]:
    """Measure detection on a recording; give the result as plain values.

    Args:
        options: what to do.
        out: folder for pictures of the first round, None for none.
        progress: called with a step's name, how much is done, and of how much.

    Raises:
        RealDataError: too few scans, or options that do not fit the recording.
        ImportDriveError, DriveError: the recording cannot be read.
    """
    begin_s, method = perf_counter(), options.method()
    recording = _opened(options)
    options.halves(min(len(recording), options.at_most))  # wrong rules are told before the long work
    recorded = load(recording, options.at_most, progress)
    halves = options.halves(len(recorded.scans))
    rounds: list[Round] = []
    for number in range(options.rounds):
        rounds.append(run_round(recorded, halves, number, options.objects, options.seed, method))
        progress("rounds", number + 1, options.rounds)
    pictures = draw_round(rounds[0], out) if out is not None else []
    return {
        "recording": recorded.name,
        "scans": len(recorded.scans),
        "left_out": list(recorded.left_out),
        "pictures": [path.name for path in pictures],
        **summary_of(rounds),
        "options": options.as_dict(),
        "parameters": {"detect": asdict(method.detect), "segment": asdict(method.segment)},
        "runtime_s": round(perf_counter() - begin_s, 1),
    }


def _opened(options: RealOptions) -> Recording:
    """The recording; where its format does not tell the place, it lies at a nominal one, which does not matter here."""
    kind = format_of(options.scans) if options.kind == AUTO else options.kind
    return open_recording(kind, options.scans, NOMINAL if kind == "pcd" else None, options.topic)
