"""Files of features by their names: which format, and how it is read and written."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, Literal, get_args

from gnd.tile_store.feature_io.about import options_about
from gnd.tile_store.feature_io.argoverse import read_argoverse
from gnd.tile_store.feature_io.errors import FeatureFileError, UnknownFormat
from gnd.tile_store.feature_io.geojson_export import write_geojson
from gnd.tile_store.feature_io.geojson_import import read_geojson
from gnd.tile_store.feature_io.json_file import MAX_JSON_BYTES
from gnd.tile_store.feature_io.lane_network import MapLane
from gnd.tile_store.feature_io.lanelet2_export import EMPTY, Changes, write_lanelet2
from gnd.tile_store.feature_io.lanelet2_import import read_lanelet2
from gnd.tile_store.feature_io.opendrive_export import write_opendrive
from gnd.tile_store.feature_io.opendrive_import import FORMAT as OPENDRIVE
from gnd.tile_store.feature_io.opendrive_import import read_opendrive
from gnd.tile_store.feature_io.osm_document import MAX_FILE_BYTES, Progress
from gnd.tile_store.feature_io.sources import FeatureSource
from gnd.tile_store.feature_io.stored import load_features, sources_of
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions, MapFeature
from gnd.tile_store.feature_io.whole_file import write_whole
from gnd.tile_store.feature_io.xml_spans import read_bytes
from gnd.tile_store.sqlite_store import SqlStore

Format = Literal["lanelet2", "opendrive", "geojson", "argoverse2"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)
WRITTEN: Final[tuple[Format, ...]] = ("lanelet2", "opendrive", "geojson")
_OF_SUFFIX: Final[dict[str, Format]] = {".osm": "lanelet2", ".xodr": "opendrive", ".geojson": "geojson"}
_READERS: Final[dict[Format, Callable[..., FeatureFile]]] = {
    "lanelet2": read_lanelet2,
    "opendrive": read_opendrive,
    "geojson": read_geojson,
    "argoverse2": read_argoverse,
}


def format_of(path: Path, said: str | None = None) -> Format:
    """The format of a file, by its name unless it is said.

    Raises:
        UnknownFormat: the name tells none.
    """
    found = said or ("argoverse2" if path.name.startswith("log_map_archive_") else _OF_SUFFIX.get(path.suffix.lower()))
    for format_ in FORMATS:
        if found == format_:
            return format_
    known = ", ".join((*_OF_SUFFIX, "log_map_archive_*.json"))
    raise UnknownFormat(f"{path}: its name tells no format (known are {known}); say one of {', '.join(FORMATS)}")


def read_features(
    path: Path,
    source: str,
    options: ImportOptions,
    format: str | None = None,  # noqa: A002
    city: str | None = None,
    progress: Progress | None = None,
) -> FeatureFile:
    """The features of a file.

    Args:
        path: the file.
        source: what its features are known by in a store.
        options: how it is understood.
        format: one of `FORMATS`; None: by its name.
        city: of an Argoverse 2 map; None: by its name.
        progress: called now and then.

    Raises:
        FeatureFileError: one of its family says what is wrong and where.
    """
    found = format_of(path, format)
    data = read_bytes(path, MAX_JSON_BYTES if found in ("geojson", "argoverse2") else MAX_FILE_BYTES)
    reader = partial(_READERS[found], city=city) if found == "argoverse2" else _READERS[found]
    return reader(data, path.name, source, options, progress)


@dataclass(frozen=True, slots=True)
class FeaturesExported:
    """What was written; changes: to the file that the features came from, None for a new one."""

    path: str
    format: str
    features: int
    size_bytes: int
    source: str | None = None
    changes: Changes | None = None


def export_features(
    store: SqlStore,
    path: Path,
    layers: Sequence[str] = (),
    region: str = "",
    format: str | None = None,  # noqa: A002
    source: str | None = None,
) -> FeaturesExported:
    """Write the newest features of a store to a file, which appears whole or not at all.

    As Lanelet2 or OpenDRIVE they are written into the file that they came from, when the store has one (`source` says
    which of several; "" means a new file, which OpenDRIVE has none of); then layers and region must not be chosen,
    because what is not chosen would count as gone.

    Raises:
        FeatureFileError: no features, a format that is not written, sources that leave no or several choices.
    """
    found = format_of(path, format)
    if found not in WRITTEN:
        raise UnknownFormat(f"{path}: {found} is read only; written are {', '.join(WRITTEN)}")
    features = load_features(store, layers, region)
    kept = None if found == "geojson" else _source(store, found, source, chosen=bool(layers or region))
    if found == OPENDRIVE and kept is None:
        raise FeatureFileError(
            f"{store.location}: OpenDRIVE is written into the file that the features came from, and no source is one, "
            "or a part was chosen; write .osm (Lanelet2) or .geojson"
        )
    if not features and kept is None:
        raise FeatureFileError(
            f"{store.location}: no features in {', '.join(layers) or 'any layer'}, {region or 'everywhere'}"
        )
    if found == "geojson":
        body, changes, told = write_geojson(features), None, len(features)
    elif found == OPENDRIVE and kept is not None:
        mine = _without_foreign(store, features, kept)
        body, changes = write_opendrive(mine, kept.document, kept.name, options_about(kept.options))
        told = len(mine)
    else:
        body, changes, told = _lanelet2(store, features, kept)
    write_whole(path, body)
    return FeaturesExported(str(path), found, told, len(body), kept.name if kept else None, changes)


def _all_lanes(store: SqlStore) -> list[MapLane]:
    """The lanes of all sources; their keys are made different, because two files may use one."""
    found = []
    for name, source in sources_of(store).items():
        known = {lane.key for lane in source.lanes}
        for lane in source.lanes:
            following = tuple(f"{name} {key}" for key in lane.successors if key in known)
            found.append(replace(lane, key=f"{name} {lane.key}", successors=following))
    return found


def _source(store: SqlStore, format_: str, said: str | None, *, chosen: bool) -> FeatureSource | None:
    known = {name: one for name, one in sources_of(store).items() if one.format == format_}
    if said == "" or (said is None and (not known or chosen)):
        return None
    if said is None and len(known) > 1:
        raise FeatureFileError(f"{store.location}: features come from {', '.join(known)}; say which with --source")
    name = said if said is not None else next(iter(known))
    if name not in known:
        raise FeatureFileError(f"{store.location}: no {format_} file {name!r:.80}; it has {', '.join(known) or 'none'}")
    if chosen:
        raise FeatureFileError(
            f"{name}: with --source all layers and regions are written; choose a new file: --source ''"
        )
    return known[name]


def _lanelet2(
    store: SqlStore, features: list[MapFeature], kept: FeatureSource | None
) -> tuple[bytes, Changes | None, int]:
    """The file with its own features and new ones; those of other files stay out."""
    if kept is None:
        body, changes = write_lanelet2(features, EMPTY, lanes=_all_lanes(store))
        return body, changes, len(features)
    mine = _without_foreign(store, features, kept)
    body, changes = write_lanelet2(mine, kept.document, kept.name, options_about(kept.options))
    return body, changes, len(mine)


def _without_foreign(store: SqlStore, features: list[MapFeature], kept: FeatureSource) -> list[MapFeature]:
    """The features that are a source's own or no source's."""
    others = (one for name, one in sources_of(store).items() if name != kept.name)
    foreign = {id_ for other in others for ids in other.ids.values() for id_ in ids}
    return [feature for feature in features if feature.feature_id not in foreign]
