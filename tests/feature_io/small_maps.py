"""Small maps written by hand, and how tests put them into stores."""

from pathlib import Path

import numpy as np

from gnd.tile_store.feature_io.about import about_options
from gnd.tile_store.feature_io.formats import export_features, read_features
from gnd.tile_store.feature_io.stored import ImportResult, import_features
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature
from gnd.tile_store.sqlite_store import SqliteStore

STREET = b"""<?xml version='1.0' encoding='UTF-8'?>
<!-- drawn by hand; kept -->
<osm version='0.6' generator='hand' upload="never">
  <MetaInfo format_version="1" map_version="7"/>
  <bounds minlat='49.0' minlon='8.4' maxlat='49.1' maxlon='8.5' origin='&lt;none&gt;'/>
  <node id='1' visible='true' version='3' lat='49.0000000' lon='8.4000000'><tag k='ele' v='110.5'/></node>
  <node id='2' lat='49.0000000' lon='8.4010000'><tag k='ele' v='110.75'/></node>
  <node id='3' lat='49.0000300' lon='8.4000000'><tag k='ele' v='110.5'/></node>
  <node   id='4'   lat='49.0000300'   lon='8.4010000'  ><tag k='ele' v='110.75'/></node>
  <!-- the sign is drawn by its edges, the pole as a node -->
  <node id='5' lat='49.00005' lon='8.4005'><tag k='ele' v='113'/></node>
  <node id='6' lat='49.000056' lon='8.4005'><tag k='ele' v='113'/></node>
  <node id="7" lat="49.00006" lon="8.4007">
    <tag k="ele" v="111.0"/>
    <tag k="type" v="pole"/>
    <tag k="height" v='6 &amp; "a half"'/>
    <mystery deep="1"><inside/>text</mystery>
  </node>
  <node id='-8' lat='49.00007' lon='8.4008' />
  <way id='10' timestamp='2024-01-01T00:00:00Z'><nd ref='1'/><nd ref='2'/>
    <tag k='type' v='line_thin'/><tag k='subtype' v='dashed'/><tag k='my:colour' v='\xc3\xbc'/></way>
  <way id='11'>
    <nd ref='3'/>
    <nd ref='4'/>
    <tag k='type' v='line_thin'/>
    <tag k='subtype' v='solid'/>
  </way>
  <way id='12'><nd ref='5'/><nd ref='6'/><tag k='type' v='traffic_sign'/><tag k='subtype' v='de274'/></way>
  <way id='13'><nd ref='1'/><nd ref='3'/><tag k='barrier' v='hedge'/></way>
  <relation id='20'>
    <member type='way' ref='11' role='left'/>
    <member type='way' ref='10' role='right'/>
    <member type='relation' ref='21' role='regulatory_element'/>
    <tag k='type' v='lanelet'/><tag k='subtype' v='road'/><tag k='speed_limit' v='50'/>
  </relation>
  <relation id='21'><member type='way' ref='12' role='refers'/><tag k='type' v='regulatory_element'/></relation>
  <relation id='22'><member type='way' ref='99999' role='elsewhere'/><tag k='type' v='nobody_knows'/></relation>
  <unknown_element kept="yes"/>
</osm>
<!-- the end -->
"""
STREET_IDS = {"lanes": 2, "poles": 1, "signs": 1}


def write(folder: Path, name: str, body: bytes | str) -> Path:
    """A file of these contents."""
    at = folder / name
    at.write_bytes(body if isinstance(body, bytes) else body.encode())
    return at


def put(
    store: SqliteStore, file: Path, options: ImportOptions | None = None, source: str | None = None
) -> ImportResult:
    """Import a file as `gnd features import` does."""
    options, name = options or ImportOptions(), source or file.name
    return import_features(store, read_features(file, name, options), name, about_options(options))


def exported(store: SqliteStore, at: Path, source: str | None = None) -> bytes:
    """What an export writes."""
    export_features(store, at, source=source)
    return at.read_bytes()


def apart_m(a: MapFeature, b: MapFeature) -> float:
    """Largest distance of two features' vertices of equal number."""
    return float(np.linalg.norm(a.enu_m() - b.enu_m(_frame(a)), axis=1).max())


def _frame(feature: MapFeature):  # type: ignore[no-untyped-def]
    from gnd.gnd_map.geodesy import LocalFrame

    return LocalFrame(float(feature.lat_rad[0]), float(feature.lon_rad[0]), float(feature.height_m[0]))
