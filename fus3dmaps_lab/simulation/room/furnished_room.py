"""A recording of a furnished room in which real photographs hang on the walls and stand on the furniture.

The room is rendered geometry. Encoders are asked to recognise the photographs, whose pixels are real.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_lab.simulation.camera_path import CameraPath, Viewpoint
from fus3dmaps_lab.simulation.depth_noise import DepthSensor
from fus3dmaps_lab.simulation.room import furniture, textures
from fus3dmaps_lab.simulation.room.photographs import photograph
from fus3dmaps_lab.simulation.room.rendering import Rendering, SceneRenderer
from fus3dmaps_lab.simulation.room.scene import Material, Placement, Scene, SceneBuilder, SceneObject

CAMERA = Intrinsics(fx=550.0, fy=550.0, cx=319.5, cy=239.5, width=640, height=480)
EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_NS = 250_000_000

_HALF_X_M, _HALF_Y_M, _HEIGHT_M = 2.6, 2.3, 2.6
_EYE_M = 1.25
_NORTH, _WEST, _SOUTH, _EAST = 0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi  # Yaw of a thing with its back to each wall.


class FurnishedRoom:
    """A recording of the room: an iterable of posed frames, with ground truth.

    Attributes:
        intrinsics: Camera model of every frame.
        photographs: Names of the objects that are photographs.
    """

    def __init__(self, seed: int = 0, frames: int = 60) -> None:
        """Build the room and the camera path.

        Args:
            seed: Seed of textures, books and depth noise; layout and path are always the same.
            frames: Number of frames along the path; the first and the last are at the same place.

        Raises:
            ValueError: Fewer than 2 frames are asked for.
            RecordingError: The package that holds the photographs is missing.
        """
        if frames < 2:
            raise ValueError(f"frames must be at least 2, got {frames}")
        self._seed = seed
        self._frames = frames
        self._scene = _furnish(np.random.default_rng(seed))
        self._renderer = SceneRenderer(self._scene)
        self._sensor = DepthSensor()
        self._path = CameraPath(_viewpoints(self._scene))
        self.intrinsics = CAMERA
        self.photographs = tuple(name for name, _, _ in _STOPS)

    @property
    def objects(self) -> list[SceneObject]:
        """Ground truth of everything that stands or hangs in the room, photographs and furniture."""
        return list(self._scene.objects)

    def __len__(self) -> int:
        """Count the frames."""
        return self._frames

    def __iter__(self) -> Iterator[PosedFrame]:
        """Yield the frames in order of time."""
        return (self.frame(index) for index in range(self._frames))

    def pose(self, index: int) -> NDArray[np.float64]:
        """Return the (4, 4) pose of the optical frame at a frame."""
        return self._path.pose(index / (self._frames - 1))

    def rendering(self, index: int) -> Rendering:
        """Render a frame without sensor noise, with a label per pixel (1 + index into :attr:`objects`)."""
        return self._renderer.render(self.intrinsics, self.pose(index))

    def frame(self, index: int) -> PosedFrame:
        """Make a frame as the sensor sees it. It does not depend on the frames made before."""
        view = self.rendering(index)
        depth_m = self._sensor.measure(view.depth_m, view.incidence_cos, np.random.default_rng((self._seed, index)))
        return PosedFrame(EPOCH_NS + index * PERIOD_NS, view.rgb, depth_m, self.intrinsics, self.pose(index))


# Each photograph with the two places from which it is seen, (x, y) in metres, in order of the path.
_STOPS: tuple[tuple[str, tuple[float, float], tuple[float, float]], ...] = (
    ("cat", (-0.95, 0.2), (-0.45, 0.3)),
    ("rocket", (0.2, 0.35), (0.65, 0.2)),
    ("motorcycle", (0.6, 0.3), (0.55, -0.25)),
    ("cameraman", (0.6, -0.3), (0.2, -0.4)),
    ("coffee", (-0.3, -0.35), (-0.75, -0.15)),
    ("astronaut", (-0.7, -0.2), (-0.75, 0.2)),
)


def _furnish(rng: np.random.Generator) -> Scene:
    builder, palette = SceneBuilder(), furniture.Palette.seeded(rng)
    _shell(builder, palette, rng)
    # With black frames, photographs would look like screens.
    gilt = Material(textures.wood((150, 116, 60), rng), 0.6)
    walnut = Material(textures.wood((104, 72, 50), rng), 0.6)

    def on(x: float, y: float, z: float, yaw: float) -> Placement:
        return Placement((x, y, z), yaw)

    with builder.thing("sofa"):
        furniture.sofa(builder, palette, on(-1.2, _HALF_Y_M, 0, _NORTH))
    with builder.thing("cat"):
        furniture.picture(builder, photograph("cat"), 0.95, gilt, on(-1.2, _HALF_Y_M, 0.96, _NORTH))
    with builder.thing("lamp"):
        furniture.floor_lamp(builder, palette, on(0.15, _HALF_Y_M, 0, _NORTH))
    with builder.thing("rocket"):
        furniture.picture(builder, photograph("rocket"), 0.75, walnut, on(1.25, _HALF_Y_M, 0.95, _NORTH))
    with builder.thing("armchair"):
        furniture.armchair(builder, palette, on(1.25, _HALF_Y_M - 0.1, 0, _NORTH))
    with builder.thing("cabinet"):
        furniture.cabinet(builder, palette, on(_HALF_X_M, 0.0, 0, _EAST))
    with builder.thing("motorcycle"):
        furniture.picture(builder, photograph("motorcycle"), 1.0, walnut, on(_HALF_X_M - 0.12, 0.0, 0.745, _EAST))
    with builder.thing("bookshelf"):
        furniture.bookshelf(builder, palette, on(1.25, -_HALF_Y_M, 0, _SOUTH), rng)
    with builder.thing("cameraman"):
        furniture.picture(builder, photograph("cameraman"), 0.72, gilt, on(1.25, 0.08 - _HALF_Y_M, 0.95, _SOUTH))
    with builder.thing("table"):
        furniture.table(builder, palette, on(-1.1, 0.02 - _HALF_Y_M, 0, _SOUTH))
    with builder.thing("coffee"):
        furniture.picture(builder, photograph("coffee"), 0.95, gilt, on(-1.1, 0.2 - _HALF_Y_M, 0.74, _SOUTH))
    with builder.thing("door"):
        furniture.door(builder, palette, on(-_HALF_X_M, -1.05, 0, _WEST))
    with builder.thing("astronaut"):
        furniture.picture(builder, photograph("astronaut"), 0.75, walnut, on(-_HALF_X_M, 0.35, 0.95, _WEST))
    return builder.build()


def _shell(builder: SceneBuilder, palette: furniture.Palette, rng: np.random.Generator) -> None:
    """Add floor, walls, ceiling with a lamp, skirting boards and rug."""
    x, y, height = _HALF_X_M, _HALF_Y_M, _HEIGHT_M
    wall = Material(textures.plaster((224, 219, 208), rng), 1.2)
    builder.panel((0, 0, 0), (0, 0, 1), (2 * x, 2 * y), Material(textures.planks((176, 146, 112), rng), 0.9))
    builder.panel((0, 0, height), (0, 0, -1), (2 * x, 2 * y), Material(textures.plaster((232, 230, 224), rng), 1.2))
    for sign in (-1.0, 1.0):
        builder.panel((0, sign * y, 0.5 * height), (0, -sign, 0), (2 * x, height), wall)
        builder.panel((sign * x, 0, 0.5 * height), (-sign, 0, 0), (2 * y, height), wall)
        skirting = sorted((sign * y, sign * (y - 0.015)))
        builder.box((-x, skirting[0], 0), (x, skirting[1], 0.08), palette.white)
        skirting = sorted((sign * x, sign * (x - 0.015)))
        builder.box((skirting[0], -y, 0), (skirting[1], y, 0.08), palette.white)
    lamp = Material(textures.plain((255, 250, 238)), lit=False, emission=3.6)
    builder.panel((0, 0, height - 0.03), (0, 0, -1), (1.2, 1.2), lamp)
    rug = Material(textures.rug((168, 156, 140), (126, 112, 100), rng))
    builder.box((-1.2, -0.85, 0), (1.2, 0.85, 0.008), rug)


def _viewpoints(scene: Scene) -> list[Viewpoint]:
    """List two views of each photograph, clockwise. The camera aims a little below it to see what it stands on."""
    views = []
    for name, *places in _STOPS:
        x, y, z = scene.named(name).center_m.tolist()
        views += [Viewpoint((*place, _EYE_M), (x, y, z - 0.24)) for place in places]
    return views
