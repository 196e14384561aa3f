"""Optional: render the TACTO scenes of the paper's figure 4: the background, and two spheres pressed into a flat gel.

TACTO 0.0.3 pins packages that conflict with torch's, so it needs an environment of its own:

    python -m venv tacto && . tacto/bin/activate
    pip install pyrender omegaconf trimesh scipy opencv-python-headless && pip install --no-deps tacto==0.0.3
    apt-get install libegl1 libgl1-mesa-dri
    python scripts/render_tacto.py --camera perspective --out data/tacto/perspective

It writes background.png, and for R 10 mm pressed 2 mm sphere_R10_d2.png and sphere_R10_d2_depth.npz (depth_px: the exact
height, in pixels of 0.0625 mm, of the surface point each pixel sees), which it checks against TACTO's own depth buffer; for
R 5 mm pressed 1 mm off the centre, the same under the name sphere_R5_d1_off.
--camera orthographic is a camera 859 mm away. --compare FOLDER prints the difference from an earlier set.
PYOPENGL_PLATFORM=osmesa works where there is no EGL: apt-get install libosmesa6, then pip install --no-deps PyOpenGL==3.1.10.
The two differ at the rim of the contact, by up to 51 counts: EGL antialiases, OSMesa does not.
"""

import math
import os
import sys
import tempfile
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lab.commands import main_of, parser_of

PITCH_MM, HEIGHT, WIDTH = 0.0625, 480, 640
SPHERES = {"sphere_R10_d2": (10.0, 2.0, 0.0, 0.0), "sphere_R5_d1_off": (5.0, 1.0, 8.0, 5.0)}  # mm: radius, press, right, down
YFOV_DEG = {"perspective": 60.0, "orthographic": 2.0}


def config(yfov: float, distance_m: float) -> dict:
    """TACTO's sensor: camera at the origin looking along +x, a flat gel across its axis, lights on a ring before the gel."""
    camera = {"position": [0, 0, 0], "orientation": [90, 0, -90], "yfov": yfov, "znear": distance_m / 2, "lightIDList": [0, 1, 2]}
    ring = {"xs": [0.0, 0.0, 0.0], "rs": [0.02, 0.02, 0.02], "thetas": [30, 150, 270]}
    lights = {"origin": [distance_m - 0.017, 0, 0], "polar": True, "xrtheta": ring}
    # Whole-number colours: pyrender takes them for 8-bit ones and divides by 255; as floats the image would be all white.
    lights |= {"colors": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "intensities": [0.8, 0.8, 0.8]}
    gel = {"origin": [distance_m, 0, 0], "width": 0.048, "height": 0.036, "curvature": False}
    noise = {"color": {"mean": 0, "std": 0}}
    return {"sensor": {"camera": [camera], "gel": gel, "lights": lights, "noise": noise, "force": {"enable": False}}}


def tacto_renderer(yfov: float, distance_mm: float) -> Any:
    """TACTO's renderer of the scene, without an object.

    Raises:
        ImportError: TACTO or what it needs is not installed.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    for name in ("pybullet", "urdfpy"):  # TACTO imports them for robots, which are not needed here
        stub = types.ModuleType(name)
        stub.URDF = object  # type: ignore[attr-defined]
        sys.modules.setdefault(name, stub)
    import numpy as np

    np.infty = np.inf  # type: ignore[attr-defined]  # noqa: NPY201 - pyrender 0.1.45 uses the name that numpy 2 dropped
    from omegaconf import OmegaConf
    from tacto.renderer import Renderer

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sensor.yaml"
        OmegaConf.save(OmegaConf.create(config(yfov, distance_mm / 1000)), path)
        return Renderer(width=WIDTH, height=HEIGHT, background=None, config_path=str(path))


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--camera", choices=sorted(YFOV_DEG), default="perspective")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--compare", type=Path, help="folder with a set of the same camera")
    arguments = parser.parse_args(argv)
    if arguments.compare and not (arguments.compare / "background.png").is_file():
        print(f"error: no background.png in {arguments.compare}", file=sys.stderr)
        return 2
    yfov = YFOV_DEG[arguments.camera]
    distance_mm = HEIGHT * PITCH_MM / 2 / math.tan(math.radians(yfov) / 2)  # the gel then has PITCH_MM per pixel
    try:
        renderer = tacto_renderer(yfov, distance_mm)
        import cv2
        import numpy as np
        import trimesh
    except ImportError as error:
        print(f"error: {error}; the first lines of this file say what to install", file=sys.stderr)
        return 1

    arguments.out.mkdir(parents=True, exist_ok=True)

    def write(name: str, image: np.ndarray) -> None:
        cv2.imwrite(str(arguments.out / name), image[..., ::-1])
        if arguments.compare and (other := cv2.imread(str(arguments.compare / name))) is not None:
            gap = np.abs(image.astype(int) - other[..., ::-1])
            print(f"{name} against {arguments.compare}, counts: mean {gap.mean():.4f}, largest {gap.max()}")

    write("background.png", renderer.render(noise=False)[0][0])
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    ray = np.stack([x - (WIDTH - 1) / 2, y - (HEIGHT - 1) / 2, np.full_like(x, distance_mm / PITCH_MM)], -1)  # right, down, forward
    ray /= ray[..., 2:]
    for name, (radius, press, right, down) in SPHERES.items():
        centre = np.array([right, down, distance_mm + radius - press])  # it stands out of the gel by press, towards the camera
        ball = trimesh.creation.icosphere(subdivisions=7, radius=radius / 1000)
        renderer.add_object(ball, name, position=[centre[2] / 1000, -right / 1000, -down / 1000])
        (image,), (buffer,) = renderer.render(noise=False)
        renderer.scene.remove_node(renderer.object_nodes[name])
        write(f"{name}.png", image)

        along, square = ray @ centre, (ray**2).sum(-1)
        inside = along**2 - square * (centre @ centre - radius**2)  # < 0: the ray misses the ball
        seen_mm = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / square, distance_mm)
        depth = (np.maximum(distance_mm - seen_mm, 0) / PITCH_MM).astype(np.float32)
        np.savez_compressed(arguments.out / f"{name}_depth.npz", depth_px=depth)
        # With 4x antialiasing (EGL) the buffer holds one of the samples, up to half a pixel off the centre; the slope is 0.75.
        error = ((distance_mm - buffer * 1000.0) / PITCH_MM - depth)[depth > 0]
        largest = np.abs(error).max()
        print(f"{name}: {depth.max():.3f} px deep, TACTO's buffer less that: mean {error.mean():.4f}, largest {largest:.4f}")
        if arguments.compare and (file := arguments.compare / f"{name}_depth.npz").is_file():
            print(f"{name}_depth.npz against {file.parent}, px: largest {np.abs(np.load(file)['depth_px'] - depth).max():.4f}")
        if abs(error.mean()) > 0.05 or largest > 0.55:
            print(f"error: TACTO drew another {name} than its depth file says", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    main_of(main)
