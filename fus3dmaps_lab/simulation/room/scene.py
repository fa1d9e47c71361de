"""A scene made of textured rectangles, and the objects in it.

Frames: world x east, y north, z up, metres. Seen from the front of its rectangle, a texture looks like a picture on a wall:
upright and not mirrored.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fus3dmaps_lab.simulation.camera_path import UP


@dataclass(frozen=True, eq=False)
class Material:
    """The look of a surface.

    Attributes:
        texture: (h, w, 3) uint8.
        tile_m: Edge of one repeat of the texture, metres; None stretches it once over the rectangle.
        lit: Whether light and shadow change its brightness; they do not for prints and lamps.
        emission: Radiance as a lamp, in units of the ambient light; 0 gives none.
    """

    texture: NDArray[np.uint8]
    tile_m: float | None = None
    lit: bool = True
    emission: float = 0.0


@dataclass(frozen=True)
class Panel:
    """A rectangle.

    Attributes:
        origin_m: (3,) the corner where the texture's first row and column are.
        edge_u_m: (3,) from there along the texture's rows, to the right as seen from its front.
        edge_v_m: (3,) from there along the texture's columns, downwards; orthogonal to ``edge_u_m``.
        material: Its look.
        label: 0 for the building itself, else 1 + the index of its object in :attr:`Scene.objects`.
    """

    origin_m: NDArray[np.float64]
    edge_u_m: NDArray[np.float64]
    edge_v_m: NDArray[np.float64]
    material: Material
    label: int

    @property
    def size_m(self) -> tuple[float, float]:
        """Lengths of the two edges, metres."""
        return float(np.linalg.norm(self.edge_u_m)), float(np.linalg.norm(self.edge_v_m))

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal of its front."""
        normal = np.cross(self.edge_v_m, self.edge_u_m)
        return normal / np.linalg.norm(normal)

    def point_m(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Return the (..., 3) points at texture coordinates ``u`` and ``v`` in [0, 1]."""
        return self.origin_m + np.asarray(u)[..., None] * self.edge_u_m + np.asarray(v)[..., None] * self.edge_v_m


@dataclass(frozen=True)
class SceneObject:
    """Ground truth of one object in a scene.

    Attributes:
        name: Unique within the scene.
        center_m: (3,) centre of the box.
        box_min_m: (3,) lower corner of the axis-aligned box.
        box_max_m: (3,) upper corner.
    """

    name: str
    center_m: NDArray[np.float64]
    box_min_m: NDArray[np.float64]
    box_max_m: NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """Rectangles and the objects that they belong to.

    Attributes:
        panels: Every rectangle.
        objects: The objects; ``panels[...].label`` counts them from 1 in this order.
    """

    panels: list[Panel]
    objects: list[SceneObject]

    def named(self, name: str) -> SceneObject:
        """Return the object with a name.

        Raises:
            KeyError: There is none.
        """
        for item in self.objects:
            if item.name == name:
                return item
        raise KeyError(name)


@dataclass(frozen=True)
class Placement:
    """Place of a thing. Its local frame has x to the right, y to its back, z up.

    Attributes:
        position_m: World coordinates of the local origin.
        yaw_rad: Turn about z; at 0 the thing faces south, its back to the north.
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0

    def rotate(self, vector: ArrayLike) -> NDArray[np.float64]:
        """Turn a local direction into world coordinates."""
        cosine, sine = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ np.asarray(vector, np.float64)

    def transform(self, point_m: ArrayLike) -> NDArray[np.float64]:
        """Turn a local point into world coordinates."""
        return np.asarray(self.position_m) + self.rotate(point_m)


WORLD = Placement()


@dataclass
class SceneBuilder:
    """Builds a scene. Rectangles added inside ``with builder.thing(name)`` form one object of the ground truth."""

    _panels: list[Panel] = field(default_factory=list)
    _names: list[str] = field(default_factory=list)
    _label: int = 0

    @contextmanager
    def thing(self, name: str) -> Iterator[None]:
        """Make one object of everything added inside the ``with`` block.

        Raises:
            ValueError: The name is taken, or another thing is still open.
        """
        if self._label:
            raise ValueError(f"'{name}' begins inside '{self._names[self._label - 1]}'")
        if name in self._names:
            raise ValueError(f"there is a thing named '{name}' already")
        self._names.append(name)
        self._label = len(self._names)
        try:
            yield
        finally:
            self._label = 0

    def panel(
        self,
        center_m: ArrayLike,
        facing: ArrayLike,
        size_m: tuple[float, float],
        material: Material,
        placement: Placement = WORLD,
    ) -> None:
        """Add a rectangle that faces a direction.

        Args:
            center_m: (3,) local coordinates of its centre.
            facing: (3,) local normal. Textures are upright on vertical faces; on horizontal ones their right is local x.
            size_m: Width and height as seen from its front.
            material: Its look.
            placement: Place of the local frame.
        """
        normal = np.asarray(facing, np.float64) / np.linalg.norm(facing)
        right = np.array([1.0, 0.0, 0.0]) if abs(normal @ UP) > 0.999 else np.cross(-normal, UP)
        right /= np.linalg.norm(right)
        edge_u, edge_v = size_m[0] * right, size_m[1] * np.cross(-normal, right)
        self._panels.append(
            Panel(
                placement.transform(np.asarray(center_m, np.float64) - 0.5 * (edge_u + edge_v)),
                placement.rotate(edge_u),
                placement.rotate(edge_v),
                material,
                self._label,
            )
        )

    def box(
        self, low_m: ArrayLike, high_m: ArrayLike, material: Material, placement: Placement = WORLD, inward: bool = False
    ) -> None:
        """Add the six faces of a box.

        Args:
            low_m: (3,) lower corner, local.
            high_m: (3,) upper corner, local.
            material: Look of every face.
            placement: Place of the local frame.
            inward: Whether the faces look inwards, like those of a room.
        """
        low, high = np.asarray(low_m, np.float64), np.asarray(high_m, np.float64)
        center, size = 0.5 * (low + high), high - low
        for axis in range(3):
            for sign in (-1.0, 1.0):
                outward = np.zeros(3)
                outward[axis] = sign
                face = (size[0], size[1]) if axis == 2 else (size[1 - axis], size[2])
                facing = -outward if inward else outward
                self.panel(center + 0.5 * size * outward, facing, (float(face[0]), float(face[1])), material, placement)

    def build(self) -> Scene:
        """Return the scene of everything added so far.

        Raises:
            ValueError: A thing has no surface.
        """
        objects = []
        for label, name in enumerate(self._names, start=1):
            corners = [p.point_m([0, 0, 1, 1], [0, 1, 0, 1]) for p in self._panels if p.label == label]
            if not corners:
                raise ValueError(f"'{name}' has no surface")
            points = np.concatenate(corners)
            low, high = points.min(axis=0), points.max(axis=0)
            objects.append(SceneObject(name, 0.5 * (low + high), low, high))
        return Scene(list(self._panels), objects)
