"""Dense features without weights: what texture and colour there is around each pixel.

They tell materials apart, not things, and are named for that. Where the same part of another object is to
have the same feature, DINOv2 is the one to ask.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Num
from scipy import ndimage
from scipy.signal import fftconvolve
from skimage.color import rgb2lab
from skimage.filters import gabor_kernel

from gsjax.perception.pictures import unit_floats


@dataclass(frozen=True)
class GaborEncoder:
    """Gabor energies of lightness, their mean and spread over orientations at each frequency, and smoothed
    CIELAB colour, reduced by PCA over all pixels given together.

    Each channel is divided by its own standard deviation before, so that colour and texture count alike, and
    the signs of the axes are fixed: the same pictures always give the same features.

    Attributes:
        num_features: D; fewer where there are no more channels.
        frequencies: of the waves, cycles a pixel.
        orientations: how many directions of each.
        smoothing: standard deviation of the blur of colours, pixels.
    """

    num_features: int = 8
    frequencies: tuple[float, ...] = (0.25, 0.125, 0.0625)
    orientations: int = 6
    smoothing: float = 1.5

    def __call__(self, images: Num[np.ndarray, "C H W 3"]) -> Float[np.ndarray, "C H W D"]:
        """Features of pictures that are to be comparable with each other: PCA is taken over all of them.

        Raises:
            ValueError: there is no picture.
        """
        if len(images) == 0:
            raise ValueError("images: got none, want at least one")
        channels = np.stack([self._channels(image) for image in images])
        flat = channels.reshape(-1, channels.shape[-1])
        flat = (flat - flat.mean(0)) / np.maximum(flat.std(0), 1e-6)
        values, axes = np.linalg.eigh(flat.T @ flat / len(flat))
        axes = axes[:, np.argsort(-values)[: self.num_features]]
        axes *= np.sign(axes[np.abs(axes).argmax(0), np.arange(axes.shape[1])])
        return (flat @ axes).reshape(*channels.shape[:-1], -1).astype(np.float32)

    def _channels(self, image: Num[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W channels"]:
        lab = rgb2lab(unit_floats(image))
        smooth = ndimage.gaussian_filter(lab, (self.smoothing, self.smoothing, 0))
        energies = []
        for frequency in self.frequencies:
            waves = []
            for i in range(self.orientations):
                kernel = gabor_kernel(frequency, np.pi * i / self.orientations)
                kernel -= kernel.mean()  # else brightness itself would count as a wave
                pad = [(size // 2, size // 2) for size in kernel.shape]
                wave = fftconvolve(np.pad(lab[..., 0], pad, mode="symmetric"), kernel, mode="valid")
                waves.append(ndimage.gaussian_filter(np.abs(wave), 0.5 / frequency))
            # Which way stripes run depends on the view; how strong and how directed they are does less.
            energies += [np.mean(waves, axis=0), np.std(waves, axis=0)]
        return np.concatenate([smooth, np.stack(energies, axis=-1)], axis=-1)
