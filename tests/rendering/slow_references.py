"""Slow references in plain torch of the compiled kernels and of analytic gradients."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from carts_core.model.parts import NORMALS
from carts_core.model.scene import Light
from carts_core.rendering.jacobian import BEHIND, BORDER, Tangents, gaussian_kernels
from carts_core.rendering.rasterizer import BACKGROUND, NEAR, SceneGeometry, VisiblePoints, unit


def visibility_ref(
    vertices_camera: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Cast a ray through each pixel centre at each triangle (Möller and Trumbore) and keep the nearest hit.

    Returns the same as `carts_core.rendering.visibility`. Depth is along the optical axis. Hits before the near plane
    do not count, which is what clipping there means.
    """
    fx, fy, cx, cy = intrinsics
    a, b, c = vertices_camera.double()[faces.long()].unbind(1)
    ab, ac = b - a, c - a
    face_ids = torch.full((height, width), BACKGROUND, dtype=torch.int32)
    depths = torch.zeros(height, width)
    for y in range(height):
        for x in range(width):
            ray = torch.tensor([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1.0], dtype=torch.float64)
            normal = torch.cross(ray.expand_as(ac), ac, dim=-1)
            determinant = (ab * normal).sum(-1)
            u = -(a * normal).sum(-1) / determinant
            other = torch.cross(-a, ab, dim=-1)
            v = (other * ray).sum(-1) / determinant
            depth = (ac * other).sum(-1) / determinant
            hit = (determinant.abs() > 1e-30) & (u >= 0) & (v >= 0) & (u + v <= 1) & (depth >= NEAR)
            if bool(hit.any()):
                index = int(torch.where(hit, depth, torch.inf).argmin())
                face_ids[y, x], depths[y, x] = index, float(depth[index])
    return face_ids, depths


def phong_ref(color: Tensor, point: Tensor, normal: Tensor, light: Light) -> Tensor:
    """One point's Phong shading, step by step; see `phong`."""
    to_light = torch.tensor(light.position, dtype=point.dtype) - point
    to_light = to_light / to_light.norm()
    to_camera = -point / point.norm()
    if float(normal @ to_camera) < 0:
        normal = -normal
    cosine = normal @ to_light
    shade = color * light.ambient
    if float(cosine) > 0:
        mirrored = 2 * cosine * normal - to_light
        shade = shade + color * light.diffuse * cosine
        shade = shade + light.specular * (mirrored @ to_camera).clamp(min=1e-4) ** light.shininess
    return shade.clamp(max=1.0)


def carry_motion_ref(
    image: Float[Tensor, "height width channels"],
    positions: Float[Tensor, "height width 2"],
    inverse_depth: Float[Tensor, "height width"],
) -> Float[Tensor, "height width channels"]:
    """Add the zero-valued term of each adjacent pair, one by one; see `carry_motion`, here for one view.

    `positions` of background pixels are not used.
    """
    values, motion = image.detach(), positions - positions.detach()
    moving = [[image[y, x] for x in range(image.shape[1])] for y in range(image.shape[0])]
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for axis, (next_y, next_x) in enumerate(((y, x + 1), (y + 1, x))):
                if next_y == image.shape[0] or next_x == image.shape[1]:
                    continue
                first_is_near = bool(inverse_depth[y, x] >= inverse_depth[next_y, next_x])
                near = (y, x) if first_is_near else (next_y, next_x)
                if inverse_depth[near] == 0:
                    continue
                term = 0.5 * (values[y, x] - values[next_y, next_x]) * motion[near][axis]
                moving[y][x] = moving[y][x] + term
                moving[next_y][next_x] = moving[next_y][next_x] + term
    return torch.stack([torch.stack(row) for row in moving])


@torch.no_grad()
def visible_points_ref(
    geometry: SceneGeometry,
    face_ids: Int[Tensor, "views height width"],
    inverse_depth: Float[Tensor, "views height width"],
    Ts_camera_link: Float[Tensor, "views links 4 4"],
    intrinsics: Float[Tensor, "views 4"],
) -> VisiblePoints:
    """See its twin in `carts_core.rendering`."""
    views, height, width = face_ids.shape
    links = Ts_camera_link.shape[1]
    pixel = (face_ids.flatten() >= 0).nonzero()[:, 0]
    face = face_ids.flatten()[pixel].long()
    view = pixel // (height * width)
    key, order = (view * links + geometry.face_links[face]).int().sort(stable=True)
    pixel, face = pixel[order], face[order]
    view, link = key.long() // links, key.long() % links
    groups = tuple(
        (index // links, index % links, count)
        for index, count in enumerate(torch.bincount(key, minlength=views * links).tolist())
        if count
    )
    fx, fy, cx, cy = intrinsics[view].T
    inside = pixel % (height * width)
    depth = 1.0 / inverse_depth.flatten()[pixel]
    x, y = ((inside % width) + 0.5 - cx) / fx, ((inside // width) + 0.5 - cy) / fy
    from_link = torch.stack([x * depth, y * depth, depth], 1) - Ts_camera_link[view, link, :3, 3]
    point_link = (Ts_camera_link[view, link, :3, :3].mT @ from_link[..., None])[..., 0].T
    maps = geometry.face_barycentric.index_select(1, face).view(2, 4, -1)
    # A pixel at the rim of its triangle may leave it by a rounding error.
    weight = ((maps[:, :3] * point_link).sum(1) + maps[:, 3]).clamp(0.0, 1.0)
    a, b, c = geometry.face_normals.index_select(1, face).view(3, 3, -1)
    normal = a + weight[0] * (b - a) + weight[1] * (c - a)
    return VisiblePoints(pixel, face, groups, point_link, unit(normal))


def _owners(points: VisiblePoints) -> tuple[Int[Tensor, " K"], Int[Tensor, " K"]]:
    """View and link of each point."""
    groups = torch.tensor(points.groups, dtype=torch.long).reshape(-1, 3)
    view, link = groups[:, :2].repeat_interleave(groups[:, 2], dim=0).T
    return view, link


def jacobian_ref(
    points: VisiblePoints,
    position: Float[Tensor, "3 K"],
    facing: Float[Tensor, "3 K"],
    maps: Float[Tensor, "cameras 6 height width"],
    inverse_depth: Float[Tensor, "cameras height width"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
    unknowns: list[int],
    box,
) -> Float[Tensor, "g cameras 6 rows columns"]:
    """See its twin in `carts_core.rendering`."""
    view, link = _owners(points)
    pose, K = tangents.Ts_camera_link[unknowns][:, view, link, :3], intrinsics[view].T
    dK = tangents.intrinsics[unknowns][:, view].movedim(-1, 1)
    point, one = points.point_link, torch.ones_like(points.point_link[:1])
    both = torch.stack([torch.cat([point, one]), torch.cat([facing, torch.zeros_like(one)])])
    dX, turning = (pose @ both.permute(2, 1, 0)).permute(3, 0, 2, 1)
    depth = position[2]
    ray = position[:2] / depth
    velocity = K[:2] * (dX[:, :2] - ray * dX[:, 2:]) / depth + dK[:, :2] * ray + dK[:, 2:]
    flat = position.new_zeros(len(unknowns), 5, inverse_depth.numel())
    flat[:, :, points.pixel] = torch.cat([velocity, turning], 1)
    motion = box.of(flat.view(len(unknowns), 5, *inverse_depth.shape)).transpose(1, 2)
    values = _carried(box.of(maps), motion[:, :, :2], box.of(inverse_depth))
    values[:, :, NORMALS] += motion[:, :, 2:]
    return values


def _carried(
    maps: Float[Tensor, "cameras 6 height width"],
    velocity: Float[Tensor, "g cameras 2 height width"],
    inverse_depth: Float[Tensor, "cameras height width"],
) -> Float[Tensor, "g cameras 6 height width"]:
    """Change of the maps as adjacent pixels are carried by the nearer one's point; see `carry_motion`."""
    jacobian = maps.new_zeros(len(velocity), *maps.shape)
    size = maps.shape[2:]
    for axis, dim in ((0, 3), (1, 2)):
        length = size[dim - 2] - 1
        first, second = maps.narrow(dim, 0, length), maps.narrow(dim, 1, length)
        half = 0.5 * (first - second)
        first_nearer = inverse_depth.narrow(dim - 1, 0, length) >= inverse_depth.narrow(dim - 1, 1, length)
        along = velocity[:, :, axis]
        speed = torch.where(first_nearer, along.narrow(dim, 0, length), along.narrow(dim, 1, length))
        moved = speed[:, :, None] * half
        jacobian.narrow(dim + 1, 0, length).add_(moved)
        jacobian.narrow(dim + 1, 1, length).add_(moved)
    return jacobian


def outline_pixels_ref(inverse_depth: Float[Tensor, "cameras height width"]) -> Bool[Tensor, "cameras height width"]:
    """Pixels with something much further away beside, above or below them, but for those at the border.

    Args:
        inverse_depth: 1 / depth [1/m], 0 for background.
    """
    least = (1.0 - BEHIND) * inverse_depth[:, 1:-1, 1:-1]
    around = (
        inverse_depth[:, :-2, 1:-1],
        inverse_depth[:, 2:, 1:-1],
        inverse_depth[:, 1:-1, :-2],
        inverse_depth[:, 1:-1, 2:],
    )
    rim = torch.zeros_like(least, dtype=torch.bool)
    for neighbour in around:
        rim |= neighbour < least
    rim = functional.pad(rim, (1, 1, 1, 1))
    rim[:, :BORDER] = rim[:, -BORDER:] = False
    rim[:, :, :BORDER] = rim[:, :, -BORDER:] = False
    return rim


def outline_position_ref(
    inverse_depth: Float[Tensor, "cameras height width"], pixel: Int[Tensor, " K"]
) -> tuple[Float[Tensor, "2 K"], Float[Tensor, "2 K"]]:
    """See its twin in `carts_core.rendering`."""
    height, width = inverse_depth.shape[1:]
    kernels = torch.from_numpy(gaussian_kernels())
    radius = kernels.shape[-1] // 2
    reach = torch.arange(-radius, radius + 1, device=pixel.device)
    around = (reach[:, None] * width + reach).flatten()
    near = inverse_depth.flatten()
    nearer = (near[pixel + around[:, None]] >= (1.0 - BEHIND) * near[pixel]).float()
    soft, right, down = kernels.flatten(1) @ nearer
    slope = torch.stack([-right, -down])
    steepness = torch.linalg.vector_norm(slope, dim=0).clamp(min=1e-6)
    normal = slope / steepness
    # The outline is where the blurred silhouette is one half; near a thin tip that is nowhere.
    centre = torch.stack([pixel % width, pixel // width % height])
    return centre + ((soft - 0.5) / steepness).clamp(-1.0, 1.0) * normal, normal


def normal_motion_ref(
    points: VisiblePoints,
    normal: Float[Tensor, "2 K"],
    Ts_camera_link: Float[Tensor, "cameras links 4 4"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
) -> Float[Tensor, "unknowns K"]:
    """See its twin in `carts_core.rendering`."""
    view, link = _owners(points)
    T, K = Ts_camera_link[view, link], intrinsics[view].T
    point = points.point_link
    X, Y, Z = (T[:, :3, :3] @ point.T[..., None])[..., 0].T + T[:, :3, 3].T
    ray = torch.stack([X / Z, Y / Z])
    # By the position in the camera's frame, and from it by the link's pose, row by row.
    slope = normal * K[:2] / Z
    slope = torch.cat([slope, -(slope * ray).sum(0, keepdim=True)])
    by_pose = slope[:, None] * torch.cat([point, torch.ones_like(point[:1])])
    by_intrinsics = torch.cat([normal * ray, normal])
    pose = tangents.Ts_camera_link[:, view, link, :3].flatten(2)
    return (pose * by_pose.flatten(0, 1).T).sum(-1) + (tangents.intrinsics[:, view] * by_intrinsics.T).sum(-1)
