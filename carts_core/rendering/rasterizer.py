"""Rasterization: triangles of a scene, their visibility, and visible surface points.

Functions of `Array`s accept NumPy arrays or tensors, and return the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..arrays import Array, array_if_faster, as_array, converted, library
from ..compiled import compiled
from ..model.parts import link_parts
from ..model.robot import Robot
from ..model.scene import Light, Scene, SceneState

BACKGROUND = -1
"""Face index of a pixel without a triangle."""

NEAR = 1e-3
"""Depth of the near plane [m], at which triangles are clipped."""


_WIDE = 8
"""Minimum width of a bounding box for which the entry and exit of each row are computed [px]."""


@compiled
def _first_and_last(value, slope, first, last):
    """First and last step from 0 to `last` at which `value + slope * step` may be positive, with a margin of one
    step."""
    if slope > 0.0:
        first = max(first, int(min(-value / slope, last + 1.0)) - 1)
    elif slope < 0.0:
        last = min(last, int(max(-value / slope, -2.0)) + 1)
    elif value < 0.0:
        last = -1
    return first, last


@compiled
def _fill_triangle(face, u, v, inverse_z, a, b, c, two_sided, face_ids, inverse_depth):
    """Z-buffer a projected triangle with corners a, b, c (indices into u, v and 1/z); its back only if `two_sided`."""
    area = (u[b] - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (v[b] - v[a])
    # The image's y axis points down, so counterclockwise corners span a negative area.
    if area == 0.0 or (area > 0.0 and not two_sided):
        return
    height, width = face_ids.shape
    # Only pixel centres (x + 0.5, y + 0.5) inside the bounding box can be covered.
    first_x = max(int(np.ceil(max(min(u[a], u[b], u[c]) - 0.5, 0.0))), 0)
    last_x = min(int(np.floor(min(max(u[a], u[b], u[c]) - 0.5, width - 1.0))), width - 1)
    first_y = max(int(np.ceil(max(min(v[a], v[b], v[c]) - 0.5, 0.0))), 0)
    last_y = min(int(np.floor(min(max(v[a], v[b], v[c]) - 0.5, height - 1.0))), height - 1)
    if first_x > last_x or first_y > last_y:
        return
    scale = 1.0 / area
    # Barycentric coordinates and 1/z are affine in the image.
    w_b_dx = (v[c] - v[a]) * scale
    w_b_dy = -(u[c] - u[a]) * scale
    w_c_dx = -(v[b] - v[a]) * scale
    w_c_dy = (u[b] - u[a]) * scale
    z_dx = w_b_dx * (inverse_z[b] - inverse_z[a]) + w_c_dx * (inverse_z[c] - inverse_z[a])
    x0 = first_x + 0.5 - u[a]
    for y in range(first_y, last_y + 1):
        dy = y + 0.5 - v[a]
        w_b = w_b_dx * x0 + w_b_dy * dy
        w_c = w_c_dx * x0 + w_c_dy * dy
        z = inverse_z[a] + w_b * (inverse_z[b] - inverse_z[a]) + w_c * (inverse_z[c] - inverse_z[a])
        first, last = 0, last_x - first_x
        if last >= _WIDE:
            first, last = _first_and_last(w_b, w_b_dx, first, last)
            first, last = _first_and_last(w_c, w_c_dx, first, last)
            first, last = _first_and_last(1.0 - w_b - w_c, -w_b_dx - w_c_dx, first, last)
        for step in range(first, last + 1):
            w_b_here, w_c_here, z_here = w_b + step * w_b_dx, w_c + step * w_c_dx, z + step * z_dx
            x = first_x + step
            if w_b_here >= 0.0 and w_c_here >= 0.0 and w_b_here + w_c_here <= 1.0 and z_here > inverse_depth[y, x]:
                inverse_depth[y, x] = z_here
                face_ids[y, x] = face


@compiled
def _clip(corners, inverse_z, vertices, fx, fy, cx, cy, clipped_u, clipped_v, clipped_inverse_z):
    """Clip a triangle at the near plane (Sutherland-Hodgman); returns the number of remaining corners, 0, 3 or 4."""
    count = 0
    for k in range(3):
        here, there = corners[k], corners[(k + 1) % 3]
        p, q = vertices[here], vertices[there]
        if inverse_z[here] > 0.0:
            clipped_inverse_z[count] = inverse_z[here]
            clipped_u[count] = fx * p[0] * inverse_z[here] + cx
            clipped_v[count] = fy * p[1] * inverse_z[here] + cy
            count += 1
        if (inverse_z[here] > 0.0) != (inverse_z[there] > 0.0):
            t = (NEAR - p[2]) / (q[2] - p[2])
            clipped_inverse_z[count] = 1.0 / NEAR
            clipped_u[count] = fx * (p[0] + t * (q[0] - p[0])) / NEAR + cx
            clipped_v[count] = fy * (p[1] + t * (q[1] - p[1])) / NEAR + cy
            count += 1
    return count


@compiled
def _opened(vertices, faces, surfaces, closed, inverse_z, fx, fy, cx, cy, width, height):
    """Whether the near plane may cut open each closed surface within the image, from the bounds of the cut."""
    u, v, inverse_near = np.empty(4), np.empty(4), np.empty(4)
    low, high = np.full((closed, 2), np.inf), np.full((closed, 2), -np.inf)
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        surface = surfaces[face]
        in_front = int(inverse_z[a] > 0.0) + int(inverse_z[b] > 0.0) + int(inverse_z[c] > 0.0)
        if surface < 0 or not 0 < in_front < 3:
            continue
        corners = _clip(faces[face], inverse_z, vertices, fx, fy, cx, cy, u, v, inverse_near)
        for k in range(corners):
            if inverse_near[k] == 1.0 / NEAR:
                low[surface, 0], high[surface, 0] = min(low[surface, 0], u[k]), max(high[surface, 0], u[k])
                low[surface, 1], high[surface, 1] = min(low[surface, 1], v[k]), max(high[surface, 1], v[k])
    return (low[:, 0] <= width) & (high[:, 0] >= 0.0) & (low[:, 1] <= height) & (high[:, 1] >= 0.0)


@compiled
def _rasterize(vertices, faces, surfaces, closed, fx, fy, cx, cy, face_ids, inverse_depth):
    count = vertices.shape[0]
    u, v, inverse_z = np.zeros(count), np.zeros(count), np.zeros(count)
    for index in range(count):
        z = vertices[index, 2]
        if z >= NEAR:  # nearer vertices keep an inverse depth of 0
            inverse_z[index] = 1.0 / z
            u[index] = fx * vertices[index, 0] * inverse_z[index] + cx
            v[index] = fy * vertices[index, 1] * inverse_z[index] + cy
    height, width = face_ids.shape
    opened = _opened(vertices, faces, surfaces, closed, inverse_z, fx, fy, cx, cy, width, height)
    clipped_u, clipped_v, clipped_inverse_z = np.empty(4), np.empty(4), np.empty(4)
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        two_sided = surfaces[face] < 0 or opened[surfaces[face]]
        if inverse_z[a] > 0.0 and inverse_z[b] > 0.0 and inverse_z[c] > 0.0:
            _fill_triangle(face, u, v, inverse_z, a, b, c, two_sided, face_ids, inverse_depth)
            continue
        if inverse_z[a] <= 0.0 and inverse_z[b] <= 0.0 and inverse_z[c] <= 0.0:
            continue
        corners = _clip(faces[face], inverse_z, vertices, fx, fy, cx, cy, clipped_u, clipped_v, clipped_inverse_z)
        for last in range(2, corners):
            _fill_triangle(
                face, clipped_u, clipped_v, clipped_inverse_z, 0, last - 1, last, two_sided, face_ids, inverse_depth
            )


def rasterize(
    vertices_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intrinsics: Sequence[float],
    width: int,
    height: int,
    surfaces: Int[np.ndarray, " F"] | None = None,
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Find the nearest triangle at every pixel centre, and its inverse depth.

    Args:
        vertices_camera: vertices in the camera's frame [m].
        intrinsics: fx, fy, cx, cy [px].
        width, height: size of the image [px].
        surfaces: index of the closed surface of each triangle, -1 for none (the default). Corners are counterclockwise
            seen from outside. Unless the near plane cuts open a surface within the image, its front hides its back, and
            the back is skipped, which saves time and does not change the result.

    Returns:
        `face_ids` (int32, `BACKGROUND` without a triangle) and `inverse_depth` (float32, [1/m], 0 there).
    """
    face_ids = np.full((height, width), BACKGROUND, np.int32)
    inverse_depth = np.zeros((height, width), np.float32)
    vertices = np.ascontiguousarray(vertices_camera, np.float64)
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    if surfaces is None:
        surfaces = np.full(len(faces), -1)
    closed = int(surfaces.max(initial=-1)) + 1
    _rasterize(
        vertices, np.ascontiguousarray(faces, np.int32), surfaces, closed, fx, fy, cx, cy, face_ids, inverse_depth
    )
    return face_ids, inverse_depth


def visibility(
    vertices_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intrinsics: Sequence[float],
    width: int,
    height: int,
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Find the nearest triangle at every pixel centre, and its depth [m], 0 without a triangle; see `rasterize`."""
    face_ids, inverse_depth = rasterize(vertices_camera, faces, intrinsics, width, height)
    depth = np.zeros_like(inverse_depth)
    np.divide(1.0, inverse_depth, out=depth, where=face_ids >= 0)
    return face_ids, depth


@dataclass(frozen=True)
class SceneGeometry:
    """Triangles of all arms. Links are numbered across all arms, and vertices are in the order of their links.

    Vectors are columns (`3 V`, not `V 3`), because products along a short last dimension are slow.
    """

    vertices: Float[Array, "3 V"]
    """Vertex positions in link frames [m]."""
    vertex_counts: tuple[int, ...]
    """Number of vertices per link."""
    vertex_links: Int[Array, " V"]
    faces: Int[Array, "F 3"]
    face_links: Int[Array, " F"]
    face_arms: Int[Array, " F"]
    face_parts: Int[Array, " F"]
    """Index of each face into `carts_core.model.parts.PARTS`."""
    face_surfaces: Int[Array, " F"]
    """Index of the closed surface of each triangle, -1 for none; its back is not visible from outside."""
    face_colors: Float[Array, "3 F"]
    face_barycentric: Float[Array, "8 F"]
    """Affine maps from a point on a triangle to its second and third barycentric coordinates, concatenated."""
    face_normals: Float[Array, "9 F"]
    """Unit vertex normals at each triangle's corners in its link's frame, concatenated."""

    @staticmethod
    def of(scene: Scene, device: Any = "cpu") -> "SceneGeometry":
        """The link meshes of a scene as tensors on a PyTorch device, or as NumPy arrays for the device None."""
        robots = tuple(arm.robot for arm in scene.arms)
        return SceneGeometry._arrays(robots) if device is None else SceneGeometry._tensors(robots, device)

    @staticmethod
    @lru_cache(maxsize=4)
    def _tensors(robots: tuple[Robot, ...], device: Any) -> "SceneGeometry":
        import torch  # noqa: PLC0415

        arrays = SceneGeometry._arrays(robots)
        fields = {name: value for name, value in vars(arrays).items() if name != "vertex_counts"}
        tensors = {name: torch.as_tensor(value, device=device) for name, value in fields.items()}
        return SceneGeometry(vertex_counts=arrays.vertex_counts, **tensors)

    @staticmethod
    @lru_cache(maxsize=4)
    def _arrays(robots: tuple[Robot, ...]) -> "SceneGeometry":
        vertices, normals, faces, face_links, arms, face_parts, surfaces, colors, counts = ([] for _ in range(9))
        first_link, first_vertex = 0, 0
        for arm_index, robot in enumerate(robots):
            counts += [0] * len(robot.link_names)
            parts = link_parts(robot)
            for mesh in sorted(robot.meshes, key=lambda mesh: mesh.link):
                link, count = first_link + mesh.link, len(mesh.faces)
                vertices.append(mesh.vertices)
                normals.append(mesh.normals)
                counts[link] += len(mesh.vertices)
                faces.append(mesh.faces + first_vertex)
                face_links.append(np.full(count, link))
                arms.append(np.full(count, arm_index))
                face_parts.append(np.full(count, parts[mesh.link]))
                surfaces.append(np.full(count, len(surfaces) if mesh.closed else -1))
                colors.append(np.broadcast_to(mesh.color, (count, 3)))
                first_vertex += len(mesh.vertices)
            first_link += len(robot.link_names)
        vertex, face = np.concatenate(vertices).astype(np.float64), np.concatenate(faces)

        def array(values: np.ndarray, dtype: type = np.float32) -> np.ndarray:
            return np.ascontiguousarray(values, dtype)

        return SceneGeometry(
            array(vertex.T),
            tuple(counts),
            array(np.repeat(np.arange(len(counts)), counts), np.int64),
            array(face, np.int32),
            array(np.concatenate(face_links), np.int64),
            array(np.concatenate(arms), np.int64),
            array(np.concatenate(face_parts), np.int64),
            array(np.concatenate(surfaces), np.int64),
            array(np.concatenate(colors).T),
            array(_barycentric_maps(vertex[face]).reshape(-1, 8).T),
            array(np.concatenate(normals)[face].reshape(-1, 9).T),
        )


def _barycentric_maps(corners: np.ndarray) -> np.ndarray:
    """Affine maps [F, 2, 4] from a point on a triangle [F, 3, 3] to two of its barycentric coordinates."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(ab, ac)
    squared = np.maximum((cross**2).sum(-1, keepdims=True), 1e-30)
    # The gradient of a coordinate is normal to the edge opposite to its corner, in the plane of the triangle.
    maps = np.stack([np.cross(ac, cross) / squared, np.cross(cross, ab) / squared], 1)
    offsets = -np.einsum("fki,fi->fk", maps, a)
    return np.concatenate([maps, offsets[..., None]], -1)


def link_transforms(scene: Scene, state: SceneState) -> Float[Array, "*batch cameras links 4 4"]:
    """Ts_camera_link of every link in every camera, differentiable (f_FK of the paper, then F_B and C)."""
    of, Ts_base_link = library(state.T_world_base), {}
    for robot in {id(arm.robot): arm.robot for arm in scene.arms}.values():
        # Forward kinematics of equal robots is batched, which takes as long as for a single robot.
        same = [index for index, arm in enumerate(scene.arms) if arm.robot is robot]
        Ts = robot.forward_kinematics(of.stack([state.joint_positions[index] for index in same]))
        Ts_base_link.update(zip(same, Ts, strict=True))
    bases = of.moveaxis(state.T_world_base, -3, 0)
    Ts_world_link = of.concatenate([T[..., None, :, :] @ Ts_base_link[arm] for arm, T in enumerate(bases)], -3)
    return state.T_view_world[..., :, None, :, :] @ Ts_world_link[..., None, :, :, :]


def vertices_in_camera(
    geometry: SceneGeometry, Ts_camera_link: Float[Array, "*batch links 4 4"]
) -> Float[Array, "*batch 3 V"]:
    """Positions of all vertices in the frame of a camera [m]."""
    ends, Ts = accumulate(geometry.vertex_counts), array_if_faster(Ts_camera_link)
    vertices = as_array(geometry.vertices) if library(Ts) is np else geometry.vertices
    parts = [vertices[:, end - count : end] for count, end in zip(geometry.vertex_counts, ends, strict=True)]
    moved = [Ts[..., link, :3, :3] @ part + Ts[..., link, :3, 3:] for link, part in enumerate(parts)]
    return converted(library(Ts).concatenate(moved, -1), Ts_camera_link)


def unit(vectors: Float[Array, "3 K"]) -> Float[Array, "3 K"]:
    """Normalize columns to unit length."""
    of = library(vectors)
    return vectors / of.sqrt(of.clip((vectors * vectors).sum(0), 1e-24, None))


def phong(
    color: Float[Array, "3 K"], points: Float[Array, "3 K"], normals: Float[Array, "3 K"], light: Light
) -> Float[Array, "3 K"]:
    """Phong shading with one point light, two-sided.

    Args:
        points: surface points in the camera's frame [m].

    Returns:
        Linear RGB in [0, 1].
    """
    of = library(points)
    to_light = unit(of.stack([place - values for place, values in zip(light.position, points, strict=True)]))
    to_camera = -unit(points)
    towards_camera = (normals * to_camera).sum(0)
    # A surface seen from its back is also lit from its back.
    side = of.copysign(of.ones_like(towards_camera), towards_camera)
    cosine = (normals * to_light).sum(0) * side
    # The reflected light direction is 2 (n . l) n - l; only its cosine to the camera is needed.
    mirrored = 2.0 * cosine * towards_camera * side - (to_light * to_camera).sum(0)
    highlight = light.specular * of.clip(mirrored, 1e-4, None) ** light.shininess * (cosine > 0)
    lit = light.ambient + light.diffuse * of.clip(cosine, 0.0, None)
    return of.clip(color * lit + highlight, None, 1.0)


@compiled
def _gather(
    face_ids, inverse_depth, Ts_camera_link, intrinsics, face_links, barycentric, normals, starts, pixels, faces, out
):
    """Fill pixels, faces and `out` (points, then normals), in runs of a view and link that begin at `starts`."""
    views, height, width = face_ids.shape
    links = Ts_camera_link.shape[1]
    for view in range(views):
        fx, fy, cx, cy = intrinsics[view]
        for row in range(height):
            for column in range(width):
                face = face_ids[view, row, column]
                if face < 0:
                    continue
                link = face_links[face]
                k = starts[view * links + link]
                starts[view * links + link] += 1
                pixels[k] = (view * height + row) * width + column
                faces[k] = face
                T = Ts_camera_link[view, link]
                depth = 1.0 / inverse_depth[view, row, column]
                x = (column + 0.5 - cx) / fx * depth - T[0, 3]
                y = (row + 0.5 - cy) / fy * depth - T[1, 3]
                z = depth - T[2, 3]
                for axis in range(3):
                    out[axis, k] = T[0, axis] * x + T[1, axis] * y + T[2, axis] * z
                # Because of rounding, a pixel at the edge of its triangle may be outside.
                b = _affine(barycentric[:4, face], out[:3, k])
                c = _affine(barycentric[4:, face], out[:3, k])
                n = normals[:, face]
                squared = 0.0
                for axis in range(3):
                    value = n[axis] + b * (n[3 + axis] - n[axis]) + c * (n[6 + axis] - n[axis])
                    out[3 + axis, k] = value
                    squared += value * value
                for axis in range(3, 6):
                    out[axis, k] /= np.sqrt(max(squared, 1e-24))


@compiled
def _affine(coefficients, point):
    """Barycentric coordinate of a point, clamped to [0, 1]."""
    value = coefficients[0] * point[0] + coefficients[1] * point[1] + coefficients[2] * point[2] + coefficients[3]
    return min(max(value, 0.0), 1.0)


@compiled
def _count(face_ids, face_links, links, counts):
    views, height, width = face_ids.shape
    for view in range(views):
        for row in range(height):
            for column in range(width):
                face = face_ids[view, row, column]
                if face >= 0:
                    counts[view * links + face_links[face]] += 1


def gather_points(
    face_ids: Int[np.ndarray, "views height width"],
    inverse_depth: Float[np.ndarray, "views height width"],
    Ts_camera_link: Float[np.ndarray, "views links 4 4"],
    intrinsics: Float[np.ndarray, "views 4"],
    face_links: Int[np.ndarray, " F"],
    face_barycentric: Float[np.ndarray, "8 F"],
    face_normals: Float[np.ndarray, "9 F"],
) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"], Float[np.ndarray, "3 K"], Float[np.ndarray, "3 K"], list[int]]:
    """Surface points of visible pixels, in the order of views, links and pixels; see `VisiblePoints`.

    Returns:
        `pixel`, `face`, `point_link`, `normal_link`, and the number of points of each link in each view.
    """
    links = Ts_camera_link.shape[1]
    counts = np.zeros(len(face_ids) * links, np.int64)
    _count(face_ids, face_links, links, counts)
    starts, total = np.cumsum(counts) - counts, int(counts.sum())
    pixels, faces = np.empty(total, np.int64), np.empty(total, np.int64)
    out = np.empty((6, total), np.float32)
    seen = face_ids, inverse_depth, Ts_camera_link, intrinsics, face_links, face_barycentric, face_normals
    _gather(*seen, starts, pixels, faces, out)
    return pixels, faces, out[:3], out[3:], counts.tolist()


@dataclass(frozen=True)
class VisiblePoints:
    """Surface points of visible pixels, without gradients. `K` is the number of visible pixels in all views."""

    pixel: Int[Array, " K"]
    """Index into the flattened `views x height x width`."""
    face: Int[Array, " K"]
    groups: tuple[tuple[int, int, int], ...]
    """View, link and number of points of each run of points on the same link in the same view."""
    point_link: Float[Array, "3 K"]
    """Surface point, in the frame of its link [m]."""
    normal_link: Float[Array, "3 K"]
    """Interpolated normal at the point, in the frame of its link."""

    def runs(self) -> list[tuple[int, int, slice]]:
        """View, link and range of each run of points on the same link in the same view."""
        ends = list(accumulate(count for _, _, count in self.groups))
        return [
            (view, link, slice(end - count, end)) for (view, link, count), end in zip(self.groups, ends, strict=True)
        ]

    def transformed(self, Ts_camera_link: Float[Array, "views links 4 4"]) -> tuple[Array, Array]:
        """Points and normals in the frames of their cameras, each [3, K], differentiable in the transforms."""
        if not self.groups:
            return self.point_link, self.normal_link
        Ts, points, normals = array_if_faster(Ts_camera_link), self.point_link, self.normal_link
        of, moved, turned = library(Ts), [], []
        if of is np:
            points, normals = as_array(points), as_array(normals)
        for view, link, run in self.runs():
            T = Ts[view, link]
            moved.append(T[:3, :3] @ points[:, run] + T[:3, 3:])
            turned.append(T[:3, :3] @ normals[:, run])
        return converted(of.concatenate(moved, 1), Ts_camera_link), converted(of.concatenate(turned, 1), Ts_camera_link)

    def intrinsics(self, intrinsics: Float[Array, "views 4"]) -> Float[Array, "4 K"]:
        """fx, fy, cx, cy of each point's view."""
        if len(intrinsics) == 1:
            return intrinsics[0][:, None]
        of = library(intrinsics)
        views = [of.broadcast_to(intrinsics[view][:, None], (4, count)) for view, _, count in self.groups]
        return of.concatenate(views, 1) if views else intrinsics[:0].T


def visible_points(
    geometry: SceneGeometry,
    face_ids: Int[Array, "views height width"],
    inverse_depth: Float[Array, "views height width"],
    Ts_camera_link: Float[Array, "views links 4 4"],
    intrinsics: Float[Array, "views 4"],
) -> VisiblePoints:
    """Surface point and normal at each visible pixel."""
    faces = geometry.face_links, geometry.face_barycentric, geometry.face_normals
    *found, counts = gather_points(*map(as_array, (face_ids, inverse_depth, Ts_camera_link, intrinsics, *faces)))
    links = Ts_camera_link.shape[1]
    groups = tuple((index // links, index % links, count) for index, count in enumerate(counts) if count)
    if library(face_ids) is not np:
        found = [library(face_ids).from_numpy(values).to(face_ids.device) for values in found]
    pixel, face, point, normal = found
    return VisiblePoints(pixel, face, groups, point, normal)
