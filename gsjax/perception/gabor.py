"""Dense features without weights: texture and colour around each pixel.

They distinguish materials, not objects, and are named accordingly. For features that agree between the same
parts of different objects use DINOv2.
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
    """Gabor energies of lightness (mean and standard deviation over orientations, for each frequency) and
    smoothed CIELAB colour, reduced by PCA over all pixels of the given images.

    Each channel is first divided by its standard deviation, so that colour and texture have equal weight, and
    the signs of the axes are fixed: the same images always give the same features.

    Attributes:
        num_features: D; at most the number of channels.
        frequencies: frequencies of the filters, cycles per pixel.
        orientations: number of orientations per frequency.
        smoothing: standard deviation of the blur of colours, pixels.
    """

    num_features: int = 8
    frequencies: tuple[float, ...] = (0.25, 0.125, 0.0625)
    orientations: int = 6
    smoothing: float = 1.5

    def __call__(self, images: Num[np.ndarray, "C H W 3"]) -> Float[np.ndarray, "C H W D"]:
        """Features of images that should be comparable with each other: PCA is taken over all of them.

        Raises:
            ValueError: there is no image.
        """
        if len(images) == 0:
            raise ValueError("images: expected at least one, found none")
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
                kernel -= kernel.mean()  # removes the response to constant brightness
                pad = [(size // 2, size // 2) for size in kernel.shape]
                wave = fftconvolve(np.pad(lab[..., 0], pad, mode="symmetric"), kernel, mode="valid")
                waves.append(ndimage.gaussian_filter(np.abs(wave), 0.5 / frequency))
            # The direction of stripes depends on the view; their strength and anisotropy depend on it less.
            energies += [np.mean(waves, axis=0), np.std(waves, axis=0)]
        return np.concatenate([smooth, np.stack(energies, axis=-1)], axis=-1)
