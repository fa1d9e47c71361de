"""Statistics by which the simulated encoders err."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fus3dmaps_core.errors import ConfigError

REFERENCE_WIDTH_PX = 640
"""Image width for which statistics in pixels are stated; they scale with the width of the actual image."""

DENSE_SAMPLES, INSTANCE_SAMPLES = 5, 9
"""Pixels of a patch that the dense and the instance layer count, with the map's default sampling."""


@dataclass(frozen=True)
class EncoderStatistics:
    """The errors of the simulated encoders. Both mix in neighbouring things, and both are noisy.

    An embedding is normalise(s + n). The signal s is a mean of unit vectors, one per instance, weighted by shares that sum
    to 1. Its length is 1 if one instance is seen alone and less if several mix. The noise n is isotropic,
    Gaussian and independent between patches, crops and frames. The part of a real encoder's error that persists from view
    to view is modelled only by mixing and by an offset per instance. ``patch_variance`` is R^D and
    ``crop_variance`` is R^I: the expected squared length of n *before* the normalisation, over all d dimensions together,
    for one embedding of one patch or one crop. A dimension of n has the variance R / d.
    No error is shared by neighbouring frames alone.

    This holds with ``noise_per`` "embedding". The fusion formula makes another assumption [sec: 3D Cross-Layer Semantic
    Fusion]: every *counted* observation of a voxel is independent, with variance R^D in the dense layer and R^I in the
    instance layer. With "observation", R^D and R^I are the variances of one counted observation. A patch is counted 5 times,
    so its embedding has R^D / 5; a crop is counted N = 9 times for each patch that its mask covers, so it has R^I / N.

    With the defaults, also of the class texts, about 4 of 10 single patches that show one thing get the right name among 30
    common indoor classes, and about 8 of 10 single crops. These numbers were chosen before anything was mapped; they are not
    measured on any model.

    Attributes:
        dimension: Width d of the embeddings.
        patch_px: Edge of a patch, pixels of an image 640 wide: 16 gives a grid of 40 x 30 for a 4:3 image of any size.
        patch_variance: R^D.
        crop_variance: R^I. Both variances are positive, or both are 0.
        receptive_field_patches: Sigma of the Gaussian receptive field of a patch, in patches; it makes embeddings bleed over
            the boundaries of objects. 0 mixes within the patch alone.
        crop_padding: Padding around a mask's box on each side, as a share of its size.
        crop_mask_weight: Weight of a pixel inside the mask; other pixels of the crop have 1. It is greater than 1 because
            models attend to the middle of an image. At 1, object and background count by their share of the crop.
        appearance_variance: Expected squared length of the offset between an instance and its class text, before the
            instance's vector is normalised. All views of an instance, of either encoder, share its offset.
        noise_per: What R^D and R^I are the variances of, see above.
        seed: Seed of all random numbers.
    """

    dimension: int = 128
    patch_px: float = 16.0
    patch_variance: float = 12.0
    crop_variance: float = 4.0
    receptive_field_patches: float = 0.75
    crop_padding: float = 0.05
    crop_mask_weight: float = 3.0
    appearance_variance: float = 0.2
    noise_per: Literal["embedding", "observation"] = "embedding"
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise ConfigError, which names the field, if a number is out of range."""
        for name, least in (
            ("dimension", 4),
            ("patch_variance", 0),
            ("crop_variance", 0),
            ("receptive_field_patches", 0),
            ("crop_padding", 0),
            ("crop_mask_weight", 1),
            ("appearance_variance", 0),
            ("seed", 0),
        ):
            value = getattr(self, name)
            if not least <= value < float("inf"):
                raise ConfigError(f"encoder statistics: {name} must be finite and at least {least}, got {value}")
        if not 1 <= self.patch_px <= REFERENCE_WIDTH_PX:
            raise ConfigError(f"encoder statistics: patch_px must lie in [1, {REFERENCE_WIDTH_PX}], got {self.patch_px}")
        if self.noise_per not in ("embedding", "observation"):
            raise ConfigError(f"encoder statistics: noise_per must be embedding or observation, got {self.noise_per!r}")
        if (self.patch_variance > 0) != (self.crop_variance > 0):
            raise ConfigError(
                "encoder statistics: patch_variance and crop_variance must both be positive or both 0, "
                f"got {self.patch_variance} and {self.crop_variance}"
            )

    @property
    def patch_noise_variance(self) -> float:
        """Expected squared length of the noise of a patch's embedding."""
        return self.patch_variance / (DENSE_SAMPLES if self.noise_per == "observation" else 1)

    def crop_noise_variance(self, patches: float) -> float:
        """Compute the expected squared length of the noise of a crop's embedding.

        Args:
            patches: Number of patches that its mask covers.
        """
        counted = max(1.0, INSTANCE_SAMPLES * patches)
        return self.crop_variance / (counted if self.noise_per == "observation" else 1)

    @property
    def variance_ratio(self) -> float:
        """R^D / R^I, the method's lambda; 1 without noise."""
        return self.patch_variance / self.crop_variance if self.crop_variance > 0 else 1.0
