"""Floor 2: point clouds of contacts. Needs the extra ``pose``; nothing here is imported by ``import torchvts``."""

from .clouds import read_point_cloud, write_point_cloud

__all__ = ["read_point_cloud", "write_point_cloud"]
