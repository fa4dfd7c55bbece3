"""Which triangle does this pixel see? The same answer as the compiled kernel, in torch, for any device."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .visibility_numba import BACKGROUND, NEAR

_CANDIDATES_AT_ONCE = 1 << 23
"""Most (triangle, pixel) pairs tested at once, which bounds the memory."""


def _clip_near(corners: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "m 3 3"], Int[Tensor, " m"]]:
    """Triangles in front of the near plane, and the index of the triangle each came from."""
    in_front = corners[..., 2] >= NEAR
    count = in_front.sum(-1)
    whole = (count == 3).nonzero()[:, 0]
    pieces, sources = [corners[whole]], [whole]
    for kept in (1, 2):
        index = (count == kept).nonzero()[:, 0]
        # Turn each triangle until the corner that differs from the other two comes first.
        single = in_front[index] if kept == 1 else ~in_front[index]
        order = (single.int().argmax(-1)[:, None] + torch.arange(3, device=corners.device)) % 3
        a, b, c = corners[index].gather(1, order[..., None].expand(-1, -1, 3)).unbind(1)
        ab = _crossing(a, b)
        ac = _crossing(a, c)
        if kept == 1:
            pieces.append(torch.stack([a, ab, ac], 1))
            sources.append(index)
        else:
            pieces += [torch.stack([ab, b, c], 1), torch.stack([ab, c, ac], 1)]
            sources += [index, index]
    return torch.cat(pieces), torch.cat(sources)


def _crossing(p: Float[Tensor, "n 3"], q: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    t = (NEAR - p[:, 2:]) / (q[:, 2:] - p[:, 2:])
    point = p + t * (q - p)
    return torch.cat([point[:, :2], torch.full_like(t, NEAR)], -1)


def visibility_torch(
    vertices_camera: Float[Tensor, "*views V 3"],
    faces: Int[Tensor, "F 3"],
    intrinsics: Float[Tensor, "*views 4"],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "*views height width"], Float[Tensor, "*views height width"]]:
    """The nearest triangle at every pixel centre, and its depth [m], of all views at once; see `visibility_numba`.

    Every (triangle, pixel of its bounding box) pair is tested, and a scatter keeps the nearest by a key that packs
    depth and triangle into one integer.
    """
    device, batch = vertices_camera.device, vertices_camera.shape[:-2]
    count = len(faces)
    corners, source = _clip_near(vertices_camera.double()[..., faces.long(), :].reshape(-1, 3, 3))
    view = source // max(count, 1)
    fx, fy, cx, cy = intrinsics.double().reshape(-1, 4)[view].T[:, :, None]
    inverse_z = 1.0 / corners[..., 2]
    u = fx * corners[..., 0] * inverse_z + cx
    v = fy * corners[..., 1] * inverse_z + cy
    first_x = (u.amin(-1) - 0.5).ceil().clamp(0, width).long()
    last_x = (u.amax(-1) - 0.5).floor().clamp(-1, width - 1).long()
    first_y = (v.amin(-1) - 0.5).ceil().clamp(0, height).long()
    last_y = (v.amax(-1) - 0.5).floor().clamp(-1, height - 1).long()
    columns, rows = (last_x - first_x + 1).clamp(min=0), (last_y - first_y + 1).clamp(min=0)
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    pixels = columns * rows * (area != 0)
    shape = (*batch, height, width)
    keys = torch.full((math.prod(shape),), torch.iinfo(torch.int64).max, dtype=torch.int64, device=device)
    for chunk in _chunks(pixels):
        owner = torch.repeat_interleave(chunk, pixels[chunk])
        start = torch.repeat_interleave(pixels[chunk].cumsum(0) - pixels[chunk], pixels[chunk])
        local = torch.arange(len(owner), device=device) - start
        x, y = first_x[owner] + local % columns[owner], first_y[owner] + local // columns[owner]
        a_u, a_v = u[owner, 0], v[owner, 0]
        du, dv = x + 0.5 - a_u, y + 0.5 - a_v
        w_b = (du * (v[owner, 2] - a_v) - dv * (u[owner, 2] - a_u)) / area[owner]
        w_c = (dv * (u[owner, 1] - a_u) - du * (v[owner, 1] - a_v)) / area[owner]
        inside = (w_b >= 0) & (w_c >= 0) & (w_b + w_c <= 1)
        z = inverse_z[owner, 0] * (1 - w_b - w_c) + inverse_z[owner, 1] * w_b + inverse_z[owner, 2] * w_c
        # The bits of a positive float32 sort like the number, so depth goes above the face in one int64.
        depth_bits = (1.0 / z[inside]).float().view(torch.int32).long()
        key = (depth_bits << 32) | (source % count)[owner[inside]]
        keys.scatter_reduce_(0, ((view[owner] * height + y) * width + x)[inside], key, "amin")
    seen = keys != torch.iinfo(torch.int64).max
    face_ids = torch.where(seen, keys & 0xFFFFFFFF, BACKGROUND).int()
    depth = torch.where(seen, (keys >> 32).int().view(torch.float32), 0.0)
    return face_ids.view(shape), depth.view(shape)


def _chunks(pixels: Int[Tensor, " n"]) -> list[Int[Tensor, " k"]]:
    """Indices of triangles with pixels to test, in groups of bounded work."""
    index = pixels.nonzero()[:, 0]
    group = pixels[index].cumsum(0) // _CANDIDATES_AT_ONCE
    return [index[group == number] for number in group.unique().tolist()]
