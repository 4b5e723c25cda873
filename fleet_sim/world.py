"""A simulated street in two states, `before` and `after` its changes, and its file.

Two frames. *map*: ENU at the anchor of the world (x east, y north, z up, metres). *street*: x along the street, y to
the left, z above the street's sloping reference plane, same origin. The step between them is affine, not rigid:
`p_street = A_street_map @ p_map` turns about the vertical and then shears the slope away, so that walls stay upright,
kerbs follow the slope, and straight rays stay straight.
"""

import json
from collections import Counter
from dataclasses import asdict, dataclass
from functools import cached_property
from math import cos, isfinite, pi, sin
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SimShapeError, WorldError
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.strict_json import arguments, items, mapping, parsed
from gnd.gnd_map.geodesy import LocalFrame

State = Literal["before", "after"]
Edit = Literal["kept", "added", "removed", "moved", "reshaped", "seasonal"]
"""What happened to a thing between the states; "seasonal": leaves and snow, which come and go and change no map."""
STATES: Final = get_args(State)
EDITS: Final = get_args(Edit)

_FORMAT: Final = "gnd.world"
_VERSION: Final = 1
MAX_HALF_LENGTH_M: Final = 1000.0
SURROUNDINGS_M: Final = 500.0
"""Everything lies so near to the stretch that is driven."""
_MAX_FILE_BYTES: Final = 64 * 1024 * 1024
_LISTS: Final = ("relief", "bays", "kerb_parking")
_NO_NUMBERS: Final = ("objects", "seed", "family", *_LISTS)
_TYPES: Final[dict[str, type[Block] | type[Post] | type[Ball]]] = {"block": Block, "post": Post, "ball": Ball}


@dataclass(frozen=True, slots=True)
class WorldObject:
    """One thing on the street: a building, a kerb, a sign.

    Attributes:
        name: unique within its state; a moved or reshaped thing has the same name in both.
        kind: what it is ("building", "kerb", "pole", ...).
        states: the states in which it stands like this.
        edit: what happened to it between the states.
        shapes: its primitives, street frame.
    """

    name: str
    kind: str
    states: tuple[State, ...]
    edit: Edit
    shapes: tuple[Shape, ...]

    def __post_init__(self) -> None:
        if not self.states or any(state not in STATES for state in self.states):
            raise WorldError(f"object {self.name!r}: states must be some of {STATES}, got {self.states}")
        if len(set(self.states)) != len(self.states):
            raise WorldError(f"object {self.name!r}: states are named twice: {self.states}")
        if self.edit not in EDITS:
            raise WorldError(f"object {self.name!r}: edit must be one of {EDITS}, got {self.edit!r}")
        if not self.shapes:
            raise WorldError(f"object {self.name!r} has no shapes")
        stands = {"kept": set(STATES), "added": {"after"}, "removed": {"before"}}.get(self.edit)
        if set(self.states) != (stands or {self.states[0]}):
            raise WorldError(f"object {self.name!r} is {self.edit}, but stands in the states {self.states}")


@dataclass(frozen=True, slots=True)
class Bay:
    """A place away from the kerbs where a car may stand during a drive.

    Attributes:
        x_m, y_m: its middle, street frame.
        yaw_rad: direction in which the car stands, counter-clockwise from the street's x.
        van: whether it is a place for delivery: a van with a high body.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    van: bool = False


@dataclass(frozen=True)
class World:
    """A street with everything on it, in both states.

    Attributes:
        seed: the number that it was made from.
        lat_rad, lon_rad, height_m: anchor of the map frame, WGS-84, ellipsoidal height of the road's middle there.
        heading_rad: direction of the street's x, counter-clockwise from east.
        slope: rise of the street along its x, metres a metre.
        crown: fall of the carriageway from its middle to the kerbs, metres a metre.
        half_length_m: drives stay within this distance of the anchor, along the street.
        lane_offset_m: middle of a lane from the middle of the road (traffic keeps to the right).
        kerb_m: distance of the kerbs from the middle of the road.
        objects: everything, in a fixed order.
        family: what kind of place it is, see `gnd.fleet_sim.families`.
        relief: (x, height) of the ground over the reference plane, rising in x, straight in between; () is level.
        bulge_m: lanes swing out to their right by so much around x = 0 (a roundabout), 0 for straight lanes.
        bulge_half_m: and reach their old place again at this distance along the street.
        kerb_parking: whether cars park along the kerbs.
        bays: where cars stand beside that.
        parking: share of the slots and bays that are taken on a drive where the drive says nothing else.
        cruise_mps: speed of a drive where the drive says nothing else.
    """

    seed: int
    lat_rad: float
    lon_rad: float
    height_m: float
    heading_rad: float
    slope: float
    crown: float
    half_length_m: float
    lane_offset_m: float
    kerb_m: float
    objects: tuple[WorldObject, ...]
    family: str = "street"
    relief: tuple[tuple[float, float], ...] = ()
    bulge_m: float = 0.0
    bulge_half_m: float = 25.0
    kerb_parking: bool = True
    bays: tuple[Bay, ...] = ()
    parking: float = 0.2
    cruise_mps: float = 9.0

    def __post_init__(self) -> None:
        numbers = {name: value for name, value in vars(self).items() if name not in _NO_NUMBERS}
        bad = [name for name, value in numbers.items() if not isinstance(value, (int, float)) or not isfinite(value)]
        if bad:
            raise WorldError(f"world {self.seed}: {', '.join(bad)} must be finite numbers")
        lanes = 0 < self.lane_offset_m < self.kerb_m <= SURROUNDINGS_M
        if not lanes or not 0 < self.half_length_m <= MAX_HALF_LENGTH_M:
            raise WorldError(
                f"need 0 < half_length_m <= {MAX_HALF_LENGTH_M:.0f} and 0 < lane_offset_m < kerb_m <="
                f" {SURROUNDINGS_M:.0f}, got {self.half_length_m}, {self.lane_offset_m}, {self.kerb_m}"
            )
        limits = {"lat_rad": pi / 2, "lon_rad": 2 * pi, "height_m": 1e4, "slope": 1.0, "crown": 1.0}
        for name, limit in limits.items():
            if abs(numbers[name]) > limit:
                raise WorldError(f"world {self.seed}: {name} must be in -{limit:g} … {limit:g}, got {numbers[name]}")
        self._check_way()
        self._check_objects()

    def _check_way(self) -> None:
        """Refuse ground that is no function of x, lanes that turn too sharply, and impossible defaults of drives."""
        x, heights = [at for at, _ in self.relief], [height for _, height in self.relief]
        if x != sorted(set(x)) or any(not isfinite(value) or abs(value) > 1e3 for value in (*x, *heights)):
            raise WorldError(f"world {self.seed}: relief needs finite heights at rising x, got {self.relief[:3]} ...")
        if not 0.0 <= self.bulge_m <= self.bulge_half_m or self.bulge_half_m <= 0.0:
            raise WorldError(
                f"world {self.seed}: need 0 <= bulge_m <= bulge_half_m, got {self.bulge_m} and {self.bulge_half_m}"
            )
        if not 0.0 <= self.parking <= 1.0 or not 1.0 <= self.cruise_mps <= 50.0:
            raise WorldError(
                f"world {self.seed}: parking must be in 0 … 1 and cruise_mps in 1 … 50,"
                f" got {self.parking} and {self.cruise_mps}"
            )

    def _check_objects(self) -> None:
        for state in STATES:
            count = Counter(o.name for o in self.objects if state in o.states)
            twice = [name for name, number in count.items() if number > 1]
            if twice:
                raise WorldError(
                    f"world {self.seed}: object names are not unique in state {state!r}: {', '.join(twice[:3])}"
                )
        changed = {state: {(o.name, o.edit) for o in self.objects if o.states == (state,)} for state in STATES}
        alone = [o for o in changed["before"] ^ changed["after"] if o[1] in ("moved", "reshaped")]
        if alone:
            raise WorldError(f"world {self.seed}: {alone[0][0]!r} is {alone[0][1]}, but stands in one state only")
        for o in self.objects:
            self._check_place(o)

    def _check_place(self, o: WorldObject) -> None:
        """Refuse what lies so far off that a grid around it would not fit into memory."""
        for shape in o.shapes:
            x0, y0, x1, y1, top = shape.bounds()
            out_m = max(-x0 - self.half_length_m, x1 - self.half_length_m, -y0, y1, abs(top))
            if out_m > SURROUNDINGS_M:
                raise WorldError(
                    f"world {self.seed}: object {o.name!r} reaches {out_m:.0f} m beyond the street, at most"
                    f" {SURROUNDINGS_M:.0f} m are allowed"
                )

    @cached_property
    def frame(self) -> LocalFrame:
        """The map frame: ENU at the anchor."""
        return LocalFrame(self.lat_rad, self.lon_rad, self.height_m)

    @cached_property
    def A_street_map(self) -> NDArray[np.float64]:
        """Affine step from the map frame to the street frame, float64 (3, 3): turn about z, then shear along z."""
        c, s = cos(self.heading_rad), sin(self.heading_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        shear = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-self.slope, 0.0, 1.0]])
        return np.asarray(shear @ turn)

    def street_of_map(self, points_map: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return street-frame coordinates (..., 3) of map-frame points (..., 3) [m]."""
        return points_map @ self.A_street_map.T

    def map_of_street(self, points_street: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return map-frame coordinates (..., 3) of street-frame points (..., 3) [m]."""
        return points_street @ np.linalg.inv(self.A_street_map).T

    def road_height_m(
        self, y_street_m: NDArray[np.float64], x_street_m: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the street-frame height of the carriageway at distances y (N,) from its middle [m].

        Where the ground has a relief, x (N,) along the street decides, too.
        """
        height = -self.crown * np.abs(y_street_m)
        return height if x_street_m is None or not self.relief else height + self.relief_m(x_street_m)

    def relief_m(self, x_street_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of the ground over the reference plane at x (N,) [m]; 0 everywhere on level ground."""
        if not self.relief:
            return np.zeros_like(x_street_m)
        return np.asarray(np.interp(x_street_m, *np.array(self.relief).T))

    def grade(self, x_street_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rise a metre at x (N,) as a vehicle feels it: straight between the middles of the pieces."""
        if len(self.relief) < 2:
            return np.zeros_like(x_street_m)
        x, height = np.array(self.relief).T
        return np.asarray(np.interp(x_street_m, 0.5 * (x[1:] + x[:-1]), np.diff(height) / np.diff(x)))

    def lane_m(self, x_street_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how far a lane's middle is from the road's at x (N,) [m], and by how much that grows a metre."""
        offset, slope = np.full_like(x_street_m, self.lane_offset_m), np.zeros_like(x_street_m)
        if not self.bulge_m:
            return offset, slope
        turn = np.clip(pi * x_street_m / self.bulge_half_m, -pi, pi)
        offset = offset + 0.5 * self.bulge_m * (1.0 + np.cos(turn))
        return offset, -0.5 * self.bulge_m * pi / self.bulge_half_m * np.sin(turn)

    def in_state(self, state: State) -> tuple[WorldObject, ...]:
        """Return the objects that stand in `state`.

        Raises:
            WorldError: there is no such state.
        """
        if state not in STATES:
            raise WorldError(f"unknown state {state!r}, use one of {STATES}")
        return tuple(o for o in self.objects if state in o.states)

    def shapes(self, state: State) -> tuple[Shape, ...]:
        """Return the primitives of `state`, street frame."""
        return tuple(shape for o in self.in_state(state) for shape in o.shapes)


def to_json(world: World) -> str:
    """Return the text of the world's file: floats as Python writes them, so that reading gives the same bits."""
    head = {key: value for key, value in vars(world).items() if key in World.__dataclass_fields__ and key != "objects"}
    head = {key: value for key, value in head.items() if value != World.__dataclass_fields__[key].default}
    if world.bays:
        head["bays"] = [asdict(bay) for bay in world.bays]
    objects = ",\n".join(json.dumps(_encode_object(o)) for o in world.objects)
    start = json.dumps({"format": _FORMAT, "version": _VERSION, **head})[:-1]
    return f'{start}, "objects": [\n{objects}\n]}}\n'


def from_json(text: str, where: str = "world") -> World:
    """Read a world from the text of its file.

    Raises:
        WorldError: `where` is no world file, of an unknown version, or says something impossible.
    """
    data = mapping(parsed(text, where), where)
    if data.pop("format", None) != _FORMAT:
        raise WorldError(f'{where} is not a world file: it lacks "format": "{_FORMAT}"')
    version = data.pop("version", None)
    if version != _VERSION:
        raise WorldError(f"{where} has version {version!r}, this program reads version {_VERSION}")
    listed = items(data.pop("objects", None), f"{where}, objects")
    objects = tuple(_decode_object(o, f"{where}, object {index}") for index, o in enumerate(listed))
    more = _decode_place(data, where)
    head = arguments(World, data, where, besides=["objects", *_LISTS])
    try:
        return World(**head, **more, objects=objects)
    except WorldError as error:
        raise WorldError(f"{where} cannot be read: {error}") from error


def _decode_place(data: dict[str, Any], where: str) -> dict[str, Any]:
    """Take the lists of a world's head out of its file: ground, bays, and whether cars park at the kerbs."""
    found: dict[str, Any] = {}
    if "relief" in data:
        knots = items(data.pop("relief"), f"{where}, relief")
        if not all(isinstance(knot, list) and len(knot) == 2 and all(map(_is_number, knot)) for knot in knots):
            raise WorldError(f"{where}, relief must be pairs of numbers")
        found["relief"] = tuple((float(x), float(height)) for x, height in knots)
    if "bays" in data:
        found["bays"] = tuple(
            Bay(**arguments(Bay, mapping(bay, f"{where}, bay {index}"), f"{where}, bay {index}"))
            for index, bay in enumerate(items(data.pop("bays"), f"{where}, bays"))
        )
    if "kerb_parking" in data:
        found["kerb_parking"] = data.pop("kerb_parking")
        if not isinstance(found["kerb_parking"], bool):
            raise WorldError(f"{where}, kerb_parking must be true or false")
    return found


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _encode_object(o: WorldObject) -> dict[str, Any]:
    shapes = [{"type": type(shape).__name__.lower(), **asdict(shape)} for shape in o.shapes]
    return {"name": o.name, "kind": o.kind, "states": list(o.states), "edit": o.edit, "shapes": shapes}


def _decode_object(value: object, where: str) -> WorldObject:
    data = mapping(value, where)
    where += f" ({str(data.get('name'))[:40]!r})"
    states = items(data.pop("states", None), f"{where}, states")
    listed = items(data.pop("shapes", None), f"{where}, shapes")
    head = arguments(WorldObject, data, where, besides=["states", "shapes"])
    shapes = tuple(_decode_shape(shape, f"{where}, shape {index}") for index, shape in enumerate(listed))
    try:
        return WorldObject(**head, states=tuple(states), shapes=shapes)
    except WorldError as error:
        raise WorldError(f"{where}: {error}") from error


def _decode_shape(value: object, where: str) -> Shape:
    data = mapping(value, where)
    name = str(data.pop("type", None))
    if name not in _TYPES:
        raise WorldError(f"{where}: unknown shape type {name[:40]!r}, known are {', '.join(sorted(_TYPES))}")
    cls = _TYPES[name]
    try:
        return cls(**arguments(cls, data, where))
    except SimShapeError as error:
        raise WorldError(f"{where}: {error}") from error


def write_world(world: World, path: Path) -> None:
    """Write the world's file; the file appears complete or not at all.

    Raises:
        WorldError: the file cannot be written.
    """
    partial = path.with_name(path.name + ".part")
    try:
        partial.write_text(to_json(world), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise WorldError(f"cannot write the world file {path}: {error}") from error


def read_world(path: Path) -> World:
    """Read a world's file.

    Raises:
        WorldError: the file is missing, too large, or no world file.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise WorldError(f"world file {path} has {size} bytes, the limit is {_MAX_FILE_BYTES}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise WorldError(f"cannot read the world file {path}: {error}") from error
    return from_json(text, f"world file {path}")
