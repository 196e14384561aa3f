"""LeRobot's plugin for tactile sensors: the camera of type "torchvts". Without LeRobot it can be imported, but not used."""

from typing import Any

__all__ = ["TactileCamera", "TactileCameraConfig"]

try:
    from .camera import TactileCamera, TactileCameraConfig
except ModuleNotFoundError as missing:
    if (missing.name or "").partition(".")[0] != "lerobot":
        raise

    def __getattr__(name: str) -> Any:
        if name in __all__:
            raise ImportError("lerobot: expected 0.6 or newer, found none: with Python 3.12, pip install 'torchvts[lerobot]'")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
