"""Reads a point cloud by Open3D in a process of its own: its readers die of some damaged files, and take what memory a header says.

python read_cloud.py cloud.ply folder writes points.npy and normals.npy, if there are any, into the folder.
"""

import ctypes
import sys
from typing import Any

MOST_BYTES = 2**35
"""Address space of the process, where the system can limit it."""


def open3d() -> Any:
    """Import Open3D, with libusb of the package ``libusb-package`` where the system has none.

    Raises:
        ImportError: says what to install.
    """
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system's own libusb may do; if not, the import below says so
    try:
        import open3d as o3d
    except (ImportError, OSError) as error:
        raise ImportError(f"point clouds need Open3D and libusb: pip install 'torchvts[pose]' ({error})") from error
    return o3d


def main(path: str, folder: str) -> None:
    """Read one file; Open3D prints a warning where it could not."""
    import numpy as np

    o3d = open3d()
    if sys.platform != "win32":
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES if most == resource.RLIM_INFINITY else min(MOST_BYTES, most), most))
    cloud = o3d.io.read_point_cloud(path)
    np.save(f"{folder}/points.npy", np.asarray(cloud.points))
    if cloud.has_normals():
        np.save(f"{folder}/normals.npy", np.asarray(cloud.normals))


if __name__ == "__main__":
    main(*sys.argv[1:])
