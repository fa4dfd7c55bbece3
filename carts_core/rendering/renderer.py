"""Differentiable renderer of a scene."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..model.parts import NORMALS, SURFACE_CHANNELS
from ..model.scene import Scene, SceneState
from ..reprs import short_repr
from .image_renderer import ImageRenderer
from .jacobian import JacobianBlock, Outline, Tangents, map_jacobian, normal_motion, outline_faces, outline_position
from .rasterizer import phong, visible_points


class _CarryMotion(torch.autograd.Function):
    """Identity on the image; its backward pass also propagates the image's gradient to the moving points."""

    @staticmethod
    def forward(ctx, image: Tensor, positions: Tensor, pixels: Tensor, inverse_depth: Tensor) -> Tensor:
        ctx.save_for_backward(image, pixels, inverse_depth)
        return image.view_as(image)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        (gradient,) = gradients
        image, pixels, inverse_depth = ctx.saved_tensors
        height, width = inverse_depth.shape[1:]
        flat_image, flat_gradient = image.flatten(1), gradient.flatten(1)
        nearness = inverse_depth.flatten()
        here_image, here_gradient, here_near = flat_image[:, pixels], flat_gradient[:, pixels], nearness[pixels]
        column, row = pixels % width, pixels // width % height
        moving = image.new_zeros(2, len(pixels))
        for axis, step, position, length in ((0, 1, column, width), (1, width, row, height)):
            for sign in (1, -1):
                exists = position < length - 1 if sign > 0 else position > 0
                # A pixel at the image border is its own neighbour, with no effect.
                other = torch.where(exists, pixels + sign * step, pixels)
                # Of two equally near points, the motion of the first one is used.
                near = here_near >= nearness[other] if sign > 0 else here_near > nearness[other]
                change = (flat_image[:, other] - here_image) * (flat_gradient[:, other] + here_gradient)
                moving[axis] -= 0.5 * sign * change.sum(0) * near
        return gradient, moving, None, None


def carry_motion(
    image: Float[Tensor, "channels views height width"],
    positions: Float[Tensor, "2 K"],
    pixels: Int[Tensor, " K"],
    inverse_depth: Float[Tensor, "views height width"],
) -> Float[Tensor, "channels views height width"]:
    """Make the gradient of an image depend on the motion of its visible points, without changing its values.

    Args:
        image: rendered channels, which may carry gradients of their own (shading).
        positions: projected surface point of every visible pixel [px], with gradient.
        pixels: indices of these pixels in the flattened `views x height x width`.
        inverse_depth: 1 / depth [1/m], 0 for background.
    """
    return _CarryMotion.apply(image, positions, pixels, inverse_depth)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class SurfaceRendering:
    """Surface maps of all cameras, without autograd."""

    maps: Float[Tensor, "cameras 6 height width"]
    """Surface maps; see `carts_core.model.parts`."""
    image: Float[Tensor, "cameras 3 height width"]
    """Shaded images, linear RGB in [0, 1]."""
    jacobian: tuple[JacobianBlock, ...]
    """Derivatives of the maps with respect to the unknowns; empty if not requested."""

    __repr__ = short_repr


def surface_values(parts: Int[Tensor, " K"], normal: Float[Tensor, "3 K"]) -> Float[Tensor, "6 K"]:
    """Surface map values of points, from their parts (index into `carts_core.model.parts.PARTS`) and their normals,
    which point to the camera."""
    values = normal.new_zeros(SURFACE_CHANNELS, len(parts))
    values[parts, torch.arange(len(parts), device=parts.device)] = 1.0
    values[NORMALS] = normal
    return values


def scattered(
    values: Float[Tensor, "channels K"], pixel: Int[Tensor, " K"], shape: torch.Size
) -> Float[Tensor, "views channels height width"]:
    """Scatter values to pixels (indices into flattened images) of images of a shape [views, height, width]; 0
    elsewhere."""
    dense = values.new_zeros(len(values), shape.numel())
    dense[:, pixel] = values
    return dense.view(-1, *shape).transpose(0, 1).contiguous()


@dataclass(frozen=True)
class Rendering:
    """Images of all cameras and hypotheses."""

    image: Float[Tensor, "*batch cameras 3 height width"]
    """Linear RGB in [0, 1], black in the background (Î of the paper)."""
    silhouette: Float[Tensor, "*batch cameras height width"]
    """1 for robots, 0 for background (Ŝ of the paper); its gradient is that of the boundary."""
    face_ids: Int[Tensor, "*batch cameras height width"]
    """Index of the visible triangle in the scene's geometry, -1 for background."""
    inverse_depth: Float[Tensor, "*batch cameras height width"]
    """1 / depth of the visible surface [1/m], 0 for background; without gradient."""
    face_arms: Int[Tensor, " F"]
    """Arm of each triangle."""

    __repr__ = short_repr

    @property
    def arm_ids(self) -> Int[Tensor, "*batch cameras height width"]:
        """Index of the visible arm, -1 for background."""
        return torch.where(self.face_ids >= 0, self.face_arms[self.face_ids.long()], -1)

    @property
    def depth(self) -> Float[Tensor, "*batch cameras height width"]:
        """Depth of the visible surface [m], 0 for background; without gradient."""
        return torch.where(self.face_ids >= 0, 1.0 / self.inverse_depth, 0.0)


class Renderer(ImageRenderer):
    """Differentiable renderer of the arms in a scene's cameras.

    Args:
        options: options of `ImageRenderer`.
        device: device of the images and of differentiable computations; visibility is always computed on the CPU.
    """

    def __init__(self, scene: Scene, *, device: str | torch.device = "cpu", **options: Any) -> None:
        self.device = torch.device(device)
        super().__init__(scene, **options)
        self._scale, self._shift = (torch.from_numpy(values).to(device) for values in (self._scale, self._shift))

    def __call__(self, state: SceneState) -> Rendering:
        """Render a state, with gradients for every tensor of the state."""
        Ts, intrinsics = self._views(state)
        batch = Ts.shape[:-4]
        views_T, views_K = Ts.flatten(0, -4), intrinsics.flatten(0, -2)
        face_ids, inverse_depth = self._visibility(views_T.detach(), views_K.detach())
        points = visible_points(self.geometry, face_ids, inverse_depth, views_T.detach(), views_K.detach())
        point, normal = points.transformed(views_T)
        color = phong(self.geometry.face_colors.index_select(1, points.face), point, normal, self.scene.light)
        values = torch.cat([color, torch.ones_like(color[:1])])
        dense = values.new_zeros(4, face_ids.numel()).index_copy_(1, points.pixel, values).view(4, *face_ids.shape)
        if torch.is_grad_enabled() and (point.requires_grad or views_K.requires_grad):
            K = points.intrinsics(views_K)
            position = K[:2] * point[:2] / point[2:] + K[2:]
            dense = carry_motion(dense, position, points.pixel, inverse_depth)
        shape = (*batch, len(self._indices), self.height, self.width)
        image = dense.movedim(0, 1).view(*shape[:-2], 4, *shape[-2:])
        return Rendering(
            image[..., :3, :, :],
            image[..., 3, :, :],
            face_ids.view(shape),
            inverse_depth.view(shape),
            self.geometry.face_arms,
        )

    @torch.no_grad()
    def visibility(
        self, state: SceneState
    ) -> tuple[Int[Tensor, "*batch cameras h w"], Float[Tensor, "*batch cameras h w"]]:
        """Compute only `face_ids` and `inverse_depth` of a `Rendering`."""
        return super().visibility(state)

    @torch.no_grad()
    def surface_maps(self, state: SceneState) -> Float[Tensor, "*batch cameras 6 height width"]:
        """Compute only the surface maps of all hypotheses; see `carts_core.model.parts`."""
        Ts, intrinsics = self._views(state)
        views_T, views_K = Ts.flatten(0, -4), intrinsics.flatten(0, -2)
        face_ids, inverse_depth = self._visibility(views_T, views_K)
        points = visible_points(self.geometry, face_ids, inverse_depth, views_T, views_K)
        position, normal = points.transformed(views_T)
        values = surface_values(self.geometry.face_parts[points.face], normal * _side(position, normal))
        maps = scattered(values, points.pixel, face_ids.shape)
        return maps.view(*Ts.shape[:-3], *maps.shape[1:])

    @torch.no_grad()
    def surface(self, state: SceneState, distance: float | None = None, margin: int = 1) -> SurfaceRendering:
        """Surface maps and shaded images of one state, with derivatives.

        Args:
            state: one state (no batch); with `distance`, a batch as for `tangents`.
            distance: distance between the states on both sides; None omits the Jacobian.
            margin: margin of the Jacobian's blocks around the moved pixels [px].
        """
        assert state.intrinsics.ndim == (2 if distance is None else 3), "one state, or those around it"
        Ts, intrinsics = self._views(state)
        tangents = None
        if distance is not None:
            tangents = _tangents(Ts, intrinsics, distance)
            Ts, intrinsics = Ts[0], intrinsics[0]
        face_ids, inverse_depth = self._visibility(Ts, intrinsics)
        points = visible_points(self.geometry, face_ids, inverse_depth, Ts, intrinsics)
        position, normal = points.transformed(Ts)
        colors = self.geometry.face_colors.index_select(1, points.face)
        color = phong(colors, position, normal, self.scene.light)
        side = _side(position, normal)
        values = torch.cat([surface_values(self.geometry.face_parts[points.face], normal * side), color])
        dense = scattered(values, points.pixel, face_ids.shape)
        maps, image = dense[:, :SURFACE_CHANNELS].contiguous(), dense[:, SURFACE_CHANNELS:]
        if tangents is None:
            return SurfaceRendering(maps, image, ())
        facing = points.normal_link * side
        jacobian = map_jacobian(points, position, facing, maps, inverse_depth, intrinsics, tangents, margin)
        return SurfaceRendering(maps, image, jacobian)

    @torch.no_grad()
    def outline(self, state: SceneState, tangents: Tangents, *, share: float = 1.0) -> Outline:
        """Outlines of one state (no batch), and their motion with the unknowns.

        Args:
            share: share of the outline pixels, scattered evenly [1].
        """
        Ts, intrinsics = self._views(state)
        face_ids, inverse_depth = self._visibility(Ts, intrinsics)
        rim = outline_faces(face_ids, inverse_depth, share)
        points = visible_points(self.geometry, rim, inverse_depth, Ts, intrinsics)
        position, normal = outline_position(inverse_depth, points.pixel)
        return Outline(
            points.pixel // (self.height * self.width),
            position,
            normal,
            self.geometry.face_parts[points.face],
            self.geometry.face_arms[points.face],
            normal_motion(points, normal, Ts, intrinsics, tangents),
        )

    @torch.no_grad()
    def tangents(self, states: SceneState, distance: float) -> Tangents:
        """Central-difference derivatives at a state.

        Args:
            states: batch of the state, then the state with each unknown decreased, then with each unknown increased.
            distance: difference between the two values of an unknown.
        """
        return _tangents(*self._views(states), distance)

    def _own(self, state: SceneState) -> SceneState:
        return state.to(self.device)

    @torch.no_grad()
    def _visibility(self, views_T: Tensor, views_K: Tensor) -> tuple[Tensor, Tensor]:
        face_ids, inverse_depth = super()._visibility(views_T, views_K.cpu())
        return torch.from_numpy(face_ids).to(self.device), torch.from_numpy(inverse_depth).to(self.device)


def _tangents(Ts: Float[Tensor, "states cameras links 4 4"], intrinsics: Tensor, distance: float) -> Tangents:
    (Ts_low, Ts_high), (low, high) = Ts[1:].chunk(2), intrinsics[1:].chunk(2)
    return Tangents((Ts_high - Ts_low) / distance, (high - low) / distance)


def _side(position: Float[Tensor, "3 K"], normal: Float[Tensor, "3 K"]) -> Float[Tensor, " K"]:
    """1 where a normal points to the camera, -1 where it points away."""
    return torch.where((position * normal).sum(0) > 0, -1.0, 1.0)
