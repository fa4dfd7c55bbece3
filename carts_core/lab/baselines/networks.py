"""The networks: a U-Net of ours, HRNet and Swin from timm below a U-Net's decoder, and Colleoni's two encoders."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...errors import SettingsError
from ...model.surface import SURFACE_CHANNELS
from ...networks.network import FeatureNetwork
from ...settings.baseline import BaselineNetwork
from .libraries import segmentation_models

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet, as timm's weights expect."""
_HEADS = (1, 2, 4, 8)
"""Heads of a Swin transformer's stages, times its width over 24."""


class Baseline(nn.Module):
    """A network that says where instruments are.

    Args:
        settings: which, and how large.

    Raises:
        CartsError: the extra is not installed.
        SettingsError: timm does not know the encoder, or it does not fit.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, settings: BaselineNetwork) -> None:
        super().__init__()
        self.settings = settings
        if settings.name == "unet":
            self.body: nn.Module = FeatureNetwork(settings.unet)
        elif settings.name == "colleoni":
            self.body = _TwoEncoders(settings)
        else:
            models = segmentation_models()
            self.body = _made(
                settings,
                lambda: models.Unet(
                    f"tu-{settings.timm_encoder}",
                    encoder_weights=None,
                    decoder_channels=settings.decoder,
                    **_swin_options(settings),
                ),
            )
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(_DEVIATION)[:, None, None], persistent=False)

    def forward(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"] | None = None
    ) -> Float[Tensor, "batch 1 h w"]:
        """Log odds that a pixel shows an instrument.

        Args:
            images: RGB in [0, 1], of the size in the settings.
            given: surface maps of the measured kinematics; only Colleoni's looks at them.
        """
        if self.settings.name == "unet":
            return self.body(images)
        images = (images - self.mean) / self.deviation
        if self.settings.looks_at_kinematics:
            return self.body(images, given)
        return self.body(images)


class _TwoEncoders(nn.Module):
    """Image and rendering in parallel, joined at every level, and one decoder: after Colleoni et al., 2007.09107.

    Their code is not public, so sizes are ours.
    """

    def __init__(self, settings: BaselineNetwork) -> None:
        super().__init__()
        models = segmentation_models()
        from segmentation_models_pytorch.base import SegmentationHead  # noqa: PLC0415
        from segmentation_models_pytorch.decoders.unet.decoder import UnetDecoder  # noqa: PLC0415

        def encoder(channels: int) -> Any:
            return models.encoders.get_encoder(f"tu-{settings.timm_encoder}", in_channels=channels, weights=None)

        self.image = _made(settings, lambda: encoder(3))
        self.rendering = _made(settings, lambda: encoder(SURFACE_CHANNELS))
        joined = [a + b for a, b in zip(self.image.out_channels, self.rendering.out_channels, strict=True)]
        self.decoder = UnetDecoder(joined, settings.decoder, len(settings.decoder))
        self.head = SegmentationHead(settings.decoder[-1], 1)

    def forward(self, images: Tensor, given: Tensor) -> Tensor:
        levels = zip(self.image(images), self.rendering(given), strict=True)
        return self.head(self.decoder([torch.cat(level, 1) for level in levels]))


def _swin_options(settings: BaselineNetwork) -> dict[str, Any]:
    if settings.name != "swin":
        return {}
    width, height = settings.size
    options: dict[str, Any] = {"img_size": (height, width)}
    if settings.width is not None:
        heads = settings.width // 24 or 1
        options |= {"embed_dim": settings.width, "num_heads": tuple(heads * factor for factor in _HEADS)}
    return options


def _made(settings: BaselineNetwork, make: Any) -> Any:
    """What `make` gives, an encoder that timm does not know said in words."""
    import timm  # noqa: PLC0415

    if not timm.is_model(settings.timm_encoder):
        raise SettingsError(
            f"timm {timm.__version__} knows no encoder {settings.timm_encoder!r}. Give a name of its list, such as "
            "hrnet_w18_small, hrnet_w48, swin_tiny_patch4_window7_224 or resnet34."
        )
    try:
        return make()
    except (ValueError, RuntimeError, TypeError, KeyError, AssertionError) as error:
        raise SettingsError(
            f"the encoder {settings.timm_encoder!r} cannot be the {settings.name} baseline of {settings.size} px "
            f"({error}). Choose one of the {settings.name} family."
        ) from error
