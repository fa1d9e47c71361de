"""Pictures and point files of a map, without a display: voxels are ray-cast as cubes and annotated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from fus3dmaps_core.answers.colors import similarity_colors
from fus3dmaps_core.answers.query import RankedInstance
from fus3dmaps_core.errors import StorageError

_BACKGROUND = (246, 246, 248)
_UNANSWERED = (205, 205, 210)
_PATH_COLOR = (30, 90, 200)
_MARK_COLOR = (220, 20, 60)
_TEXT_COLOR = (40, 40, 48)
_ELEVATION_RAD = np.deg2rad(52.0)
_FIELD_OF_VIEW_RAD = np.deg2rad(40.0)
_HEADROOM_M = 0.35
_IN_VIEW_COS = np.cos(np.deg2rad(25.0))
_FILL = 0.92
_CUBE_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
_CUBE_TRIANGLES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]),
        *([0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]),
        *([0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    np.uint32,
)


@dataclass(frozen=True)
class _View:
    """A pinhole camera of the picture."""

    R: NDArray[np.float64]
    t: NDArray[np.float64]
    focal_px: float
    width: int
    height: int

    def project(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project points in the map frame to pixels (n, 2); NaN behind the camera."""
        camera = np.asarray(points_m, np.float64) @ self.R.T + self.t
        depth = np.where(camera[:, 2] > 1e-3, camera[:, 2], np.nan)
        return camera[:, :2] / depth[:, None] * self.focal_px + (self.width / 2, self.height / 2)


def render_answer(
    map_points_m: NDArray[np.float32],
    map_colors: NDArray[np.uint8],
    points_m: NDArray[np.float32],
    similarity: NDArray[np.float32],
    instances: Sequence[RankedInstance],
    camera_poses: NDArray[np.float64],
    voxel_size_m: float,
    title: str,
    panel_size: tuple[int, int] = (960, 640),
) -> NDArray[np.uint8]:
    """Draw a map twice from one viewpoint: in its own colours with the camera's path, and coloured by similarity.

    The viewpoint is behind and above the cameras that looked at the best answer, along their mean line of sight, so that
    what they saw faces the viewer; whatever is well above them is cut away, as the roof of a doll's house.

    Args:
        map_points_m: (n, 3) centres of all voxels, map frame.
        map_colors: (n, 3) uint8 their colours.
        points_m: (m, 3) centres of the voxels that have a similarity.
        similarity: (m,) their similarity.
        instances: Ranked answers; the first is marked boldly.
        camera_poses: (k, 4, 4) T_world_camera.
        voxel_size_m: Edge of a voxel, metres.
        title: Written above the picture.
        panel_size: Width and height of each of both panels, pixels.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    up, forward = _orientation(camera_poses, instances[0].centroid_m if instances else None)
    ceiling = camera_poses[:, :3, 3] @ up
    limit = ceiling.max() + _HEADROOM_M if len(ceiling) else np.inf
    kept, kept_similar = map_points_m @ up <= limit, points_m @ up <= limit
    width, height = panel_size
    view = _frame_view(map_points_m[kept] if kept.any() else map_points_m, up, forward, width, height)
    grey = np.tile(np.array(_UNANSWERED, np.uint8), (int(kept.sum()), 1))
    left = _cast(map_points_m[kept], map_colors[kept], voxel_size_m, view)
    right = _cast(
        np.concatenate([points_m[kept_similar], map_points_m[kept]]),
        np.concatenate([similarity_colors(similarity)[kept_similar], grey]),
        voxel_size_m,
        view,
    )
    _draw_path(left, camera_poses, view)
    for rank, instance in reversed(list(enumerate(instances))):
        for panel in (left, right) if rank == 0 else (right,):
            _draw_box(panel, instance, rank, view)
    header = np.full((56, 2 * width, 3), _BACKGROUND, np.uint8)
    cv2.putText(header, _printable(title), (20, 37), cv2.FONT_HERSHEY_SIMPLEX, 0.9, _TEXT_COLOR, 2, cv2.LINE_AA)
    _draw_scale(right, similarity)
    return np.vstack([header, np.hstack([left, right])])


def write_png(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write a picture.

    Raises:
        StorageError: The file cannot be written.
    """
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(rgb[:, :, ::-1]))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes() if encoded else b"")
    except OSError as error:
        raise StorageError(f"cannot write picture '{path}': {error}") from None


def write_ply(path: Path, points_m: NDArray[np.float32], similarity: NDArray[np.float32]) -> None:
    """Write points with the attributes ``similarity`` and colour as a binary PLY file.

    Raises:
        StorageError: The file cannot be written.
    """
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points_m)))
    cloud.point["similarity"] = o3d.core.Tensor(similarity.reshape(-1, 1).astype(np.float32))
    cloud.point["colors"] = o3d.core.Tensor(similarity_colors(similarity))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            written = o3d.t.io.write_point_cloud(str(path), cloud)
    except OSError as error:
        raise StorageError(f"cannot write points '{path}': {error}") from None
    if not written:
        raise StorageError(f"cannot write points '{path}': the name must end in .ply and the directory be writable")


def _orientation(
    camera_poses: NDArray[np.float64], target_m: NDArray[np.float32] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Find up and the mean horizontal line of sight. Cameras are carried upright, whatever axis the map frame calls up."""
    up = -camera_poses[:, :3, 1].sum(axis=0) if len(camera_poses) else np.zeros(3)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, 0.0, 1.0])
    sights = camera_poses[:, :3, 2]
    candidates = [sights.sum(axis=0), *np.eye(3)]
    if target_m is not None:
        towards = np.asarray(target_m, np.float64) - camera_poses[:, :3, 3]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        candidates.insert(0, sights[np.einsum("nc,nc->n", sights, towards) > _IN_VIEW_COS].sum(axis=0))
    for candidate in candidates:
        forward = candidate - up * (candidate @ up)
        if np.linalg.norm(forward) > 0.1:
            break
    return up, forward / np.linalg.norm(forward)


def _frame_view(
    points_m: NDArray[np.float32], up: NDArray[np.float64], forward: NDArray[np.float64], width: int, height: int
) -> _View:
    """Place a camera that looks down on the points, as near as it can be with nearly all of them in the picture."""
    sight = np.cos(_ELEVATION_RAD) * forward - np.sin(_ELEVATION_RAD) * up
    right = np.cross(sight, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(sight, right), sight])
    local = points_m.astype(np.float64) @ R.T
    low, high = np.percentile(local, [0.5, 99.5], axis=0)
    local = local[np.all((local >= low) & (local <= high), axis=1)]
    local = local if len(local) else (low + high)[None] / 2
    focal_px = float(0.5 * height / np.tan(_FIELD_OF_VIEW_RAD / 2))
    center = (local.min(axis=0) + local.max(axis=0)) / 2
    near, far = 0.1 - (local[:, 2] - center[2]).min(), 1.0 + 20.0 * float(np.ptp(local, axis=0).max())
    for _ in range(30):
        distance = (near + far) / 2
        x, y = ((local - center)[:, :2] * focal_px / (local[:, 2:] - center[2] + distance)).T
        # Perspective shifts the middle of what is seen: the camera moves sideways with it.
        center[:2] += [(x.min() + x.max()) / 2 * distance / focal_px, (y.min() + y.max()) / 2 * distance / focal_px]
        fits = np.ptp(x) <= _FILL * width and np.ptp(y) <= _FILL * height
        near, far = (near, distance) if fits else (distance, far)
    return _View(R, np.array([0.0, 0.0, far]) - center, focal_px, width, height)


def _cast(points_m: NDArray[np.float32], colors: NDArray[np.uint8], voxel_size_m: float, view: _View) -> NDArray[np.uint8]:
    """Draw coloured cubes, shaded by the direction of their faces and averaged over 2x2 rays a pixel."""
    image = np.full((view.height, view.width, 3), _BACKGROUND, np.uint8)
    if not len(points_m):
        return image
    n = len(points_m)
    vertices = (points_m[:, None] + _CUBE_CORNERS * voxel_size_m).reshape(-1, 3).astype(np.float32)
    triangles = (_CUBE_TRIANGLES[None] + 8 * np.arange(n, dtype=np.uint32)[:, None, None]).reshape(-1, 3)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    K = np.array([[2 * view.focal_px, 0, view.width], [0, 2 * view.focal_px, view.height], [0, 0, 1]], dtype=np.float64)
    extrinsic = np.eye(4)
    extrinsic[:3, :3], extrinsic[:3, 3] = view.R, view.t
    rays = scene.create_rays_pinhole(o3d.core.Tensor(K), o3d.core.Tensor(extrinsic), 2 * view.width, 2 * view.height)
    hits = scene.cast_rays(rays)
    primitive = hits["primitive_ids"].numpy()
    seen = primitive != scene.INVALID_ID
    facing = np.abs(np.einsum("hwc,c->hw", hits["primitive_normals"].numpy(), view.R[2]))
    large = np.full((2 * view.height, 2 * view.width, 3), _BACKGROUND, np.float32)
    large[seen] = colors[primitive[seen] // len(_CUBE_TRIANGLES)] * (0.72 + 0.28 * facing[seen, None])
    return np.asarray(cv2.resize(large, (view.width, view.height), interpolation=cv2.INTER_AREA)).astype(np.uint8)


def _draw_path(image: NDArray[np.uint8], camera_poses: NDArray[np.float64], view: _View) -> None:
    pixels = view.project(camera_poses[:, :3, 3])
    pixels = np.rint(pixels[np.isfinite(pixels).all(axis=1)]).astype(np.int32)
    if not len(pixels):
        return
    cv2.polylines(image, [pixels.reshape(-1, 1, 2)], False, _PATH_COLOR, 2, cv2.LINE_AA)
    cv2.circle(image, tuple(map(int, pixels[0])), 6, _PATH_COLOR, -1, cv2.LINE_AA)
    place = (int(pixels[0, 0]) + 9, int(pixels[0, 1]) + 5)
    cv2.putText(image, "start", place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _PATH_COLOR, 1, cv2.LINE_AA)


def _draw_box(image: NDArray[np.uint8], instance: RankedInstance, rank: int, view: _View) -> None:
    corners = np.array([instance.box_min_m, instance.box_max_m], np.float64)
    vertices = np.array([[corners[x, 0], corners[y, 1], corners[z, 2]] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    pixels = view.project(vertices)
    if not np.isfinite(pixels).all():
        return
    points = np.rint(pixels).astype(int)
    color, thickness = (_MARK_COLOR, 2) if rank == 0 else (_TEXT_COLOR, 1)
    for a in range(8):
        for b in range(a + 1, 8):
            if bin(a ^ b).count("1") == 1:
                cv2.line(image, tuple(map(int, points[a])), tuple(map(int, points[b])), color, thickness, cv2.LINE_AA)
    label = f"{rank + 1}  {instance.score:.2f}"
    place = (int(points[:, 0].min()), int(points[:, 1].min()) - 6)
    cv2.putText(image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 + 0.1 * (rank == 0), (255, 255, 255), 4, cv2.LINE_AA)
    cv2.putText(image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 + 0.1 * (rank == 0), color, 1, cv2.LINE_AA)


def _draw_scale(image: NDArray[np.uint8], similarity: NDArray[np.float32]) -> None:
    """Draw a colour bar into the lower right corner."""
    if not len(similarity):
        return
    height, width = image.shape[:2]
    left, top, length = width - 260, height - 44, 160
    image[top : top + 14, left : left + length] = similarity_colors(np.linspace(0, 1, length))[None]
    for value, x in ((similarity.min(), left - 4), (similarity.max(), left + length - 30)):
        place = (int(x), top + 32)
        cv2.putText(image, f"{value:.2f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT_COLOR, 1, cv2.LINE_AA)
    cv2.putText(image, "score", (left, top - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT_COLOR, 1, cv2.LINE_AA)


def _printable(text: str) -> str:
    """Replace what OpenCV's fonts, which have ASCII only, cannot draw."""
    return text.encode("ascii", "replace").decode()
