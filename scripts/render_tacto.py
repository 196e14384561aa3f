"""Optional: render the TACTO scenes of the paper's figure 4 (a sphere R 10 mm pressed 2 mm, and the background).

TACTO 0.0.3 pins packages that collide with torch's, so give it an environment of its own:

    python -m venv tacto && . tacto/bin/activate
    pip install numpy opencv-python-headless pyrender omegaconf trimesh pyyaml && pip install --no-deps tacto==0.0.3
    PYOPENGL_PLATFORM=egl python scripts/render_tacto.py --out data/tacto/perspective

It writes background.png, sphere_R10_d2.png and sphere_R10_d2_depth.npz (depth_px: exact depth in pixels of 0.0625 mm).
PYOPENGL_PLATFORM=osmesa works where there is no EGL.
"""

import argparse
import sys
import types
from pathlib import Path

PITCH_MM, HEIGHT, WIDTH = 0.0625, 480, 640
RADIUS_MM, PRESS_MM = 10.0, 2.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    for name in ("pybullet", "urdfpy"):  # TACTO imports them for robots, which are not needed here
        stub = types.ModuleType(name)
        stub.URDF = object  # type: ignore[attr-defined]
        sys.modules.setdefault(name, stub)
    try:
        import cv2
        import numpy as np
        import trimesh
        from tacto.renderer import Renderer
    except ImportError as error:
        print(f"error: {error}; the first lines of this file say what to install", file=sys.stderr)
        return 1
    import tacto

    renderer = Renderer(width=WIDTH, height=HEIGHT, background=None, config_path=tacto.get_digit_config_path())
    arguments.out.mkdir(parents=True, exist_ok=True)
    rest, _ = renderer.render()
    gel_x = float(renderer.conf.sensor.gel.origin[0])
    ball = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS_MM / 1000)
    renderer.add_object(ball, "ball")
    place = [gel_x + (PRESS_MM - RADIUS_MM) / 1000, 0.0, 0.0]  # the camera of TACTO's DIGIT looks along -x
    pressed, _ = renderer.render({"ball": (place, [0.0, 0.0, 0.0])}, {"ball": 1.0}, noise=False)
    cv2.imwrite(str(arguments.out / "background.png"), rest[0][..., ::-1])
    cv2.imwrite(str(arguments.out / "sphere_R10_d2.png"), pressed[0][..., ::-1])
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    squared = ((x - (WIDTH - 1) / 2) ** 2 + (y - (HEIGHT - 1) / 2) ** 2) * PITCH_MM**2
    depth = np.sqrt(np.maximum(RADIUS_MM**2 - squared, 0)) - (RADIUS_MM - PRESS_MM)
    np.savez_compressed(arguments.out / "sphere_R10_d2_depth.npz", depth_px=(np.maximum(depth, 0) / PITCH_MM).astype(np.float32))
    print(f"wrote {arguments.out}: the sensor's gel must be flat, {WIDTH * PITCH_MM} x {HEIGHT * PITCH_MM} mm, for depth to hold")
    return 0


if __name__ == "__main__":
    sys.exit(main())
