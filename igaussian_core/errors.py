"""The one root of every error that iGaussian raises on bad input."""


class IGaussianError(Exception):
    """Bad input or a missing file; the message names path, cause and what is supported."""


class MapError(IGaussianError):
    """A Gaussian map or a compiled map that cannot be used."""


class CameraError(IGaussianError):
    """Camera intrinsics, distortion or image sizes that make no sense."""


class ConfigError(IGaussianError):
    """An unknown key or a value out of range in the configuration."""


class WeightsError(IGaussianError):
    """A network's weight file that is missing, altered or incomplete."""


class BagError(IGaussianError):
    """A recording that is missing, truncated or without the needed topics."""


class DatasetError(IGaussianError):
    """A file of camera poses or an image folder that cannot be used."""


class ImageError(IGaussianError):
    """An image whose encoding, sizes or bytes cannot be used."""
