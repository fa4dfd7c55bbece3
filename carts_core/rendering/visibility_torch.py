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
    cut = ((count == 1) | (count == 2)).nonzero()[:, 0]
    if not len(cut):
        return corners[whole], whole
    one = (count[cut] == 1)[:, None]
    # Turn each triangle until the corner that differs from the other two comes first.
    order = ((in_front[cut] == one).int().argmax(-1)[:, None] + torch.arange(3, device=corners.device)) % 3
    a, b, c = corners[cut].gather(1, order[..., None].expand(-1, -1, 3)).unbind(1)
    ab, ac = _crossing(a, b), _crossing(a, c)
    # With one corner in front a triangle is left, with two a quadrangle, which is two triangles.
    first = torch.where(one[:, None], torch.stack([a, ab, ac], 1), torch.stack([ab, b, c], 1))
    two = (~one[:, 0]).nonzero()[:, 0]
    second = torch.stack([ab, c, ac], 1)[two]
    return torch.cat([corners[whole], first, second]), torch.cat([whole, cut, cut[two]])


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
    device, shape = vertices_camera.device, (*vertices_camera.shape[:-2], height, width)
    corners, source = _clip_near(vertices_camera.double()[..., faces.long(), :].reshape(-1, 3, 3))
    view, face = source // max(len(faces), 1), source % max(len(faces), 1)
    K = intrinsics.double().reshape(-1, 1, 4)[view]
    inverse_z = 1.0 / corners[..., 2]
    position = K[..., :2] * corners[..., :2] * inverse_z[..., None] + K[..., 2:]
    # Only pixel centres (x + 0.5, y + 0.5) inside the bounding box can be covered.
    size = torch.tensor([width, height], device=device)
    first = torch.minimum((position.amin(1) - 0.5).ceil().clamp(min=0), size).long()
    last = torch.minimum((position.amax(1) - 0.5).floor().clamp(min=-1), size - 1).long()
    columns, rows = (last - first + 1).clamp(min=0).unbind(1)
    # Barycentric coordinates and 1/z are affine in the image.
    (bu, bv), (cu, cv) = ((position[:, corner] - position[:, 0]).T for corner in (1, 2))
    area = bu * cv - cu * bv
    to_first = (first + 0.5 - position[:, 0]).T
    slopes = torch.stack([cv, -cu, -bv, bu]) / area
    triangle = torch.cat([to_first, slopes, inverse_z[:, :1].T, (inverse_z[:, 1:] - inverse_z[:, :1]).T])
    corner = (view * height + first[:, 1]) * width + first[:, 0]
    pixels = columns * rows * (area != 0)
    keys = torch.full((math.prod(shape),), torch.iinfo(torch.int64).max, dtype=torch.int64, device=device)
    for chunk in _chunks(pixels):
        counts = pixels[chunk]
        owner = torch.repeat_interleave(chunk, counts)
        local = torch.arange(len(owner), device=device) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
        across = columns[owner]
        x, y = local % across, local // across
        u, v, b_u, b_v, c_u, c_v, z, z_b, z_c = triangle[:, owner]
        u, v = u + x, v + y
        w_b, w_c = b_u * u + b_v * v, c_u * u + c_v * v
        inside = ((w_b >= 0) & (w_c >= 0) & (w_b + w_c <= 1)).nonzero()[:, 0]
        # The bits of a positive float32 sort like the number, so depth goes above the face in one int64.
        depth = (1.0 / (z + w_b * z_b + w_c * z_c)[inside]).float()
        key = (depth.view(torch.int32).long() << 32) | face[owner[inside]]
        keys.scatter_reduce_(0, (corner[owner] + y * width + x)[inside], key, "amin")
    seen = keys != torch.iinfo(torch.int64).max
    face_ids = torch.where(seen, keys & 0xFFFFFFFF, BACKGROUND).int()
    depth = torch.where(seen, (keys >> 32).int().view(torch.float32), 0.0)
    return face_ids.view(shape), depth.view(shape)


def _chunks(pixels: Int[Tensor, " n"]) -> list[Int[Tensor, " k"]]:
    """Indices of triangles with pixels to test, in groups of bounded work."""
    index = pixels.nonzero()[:, 0]
    group = pixels[index].cumsum(0) // _CANDIDATES_AT_ONCE
    return [index[group == number] for number in group.unique().tolist()]
