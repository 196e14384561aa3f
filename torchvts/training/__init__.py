"""Training of modules that pipelines use: so far the network :class:`torchvts.NormalFromMLP`."""

from .network import MlpFit, fit_mlp

__all__ = ["MlpFit", "fit_mlp"]
