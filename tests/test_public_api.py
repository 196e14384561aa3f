"""The public names, their arguments, and what an import costs."""

import subprocess
import sys

import torchvts as vts
from torchvts.calibration import LightFit
from torchvts.pipeline import ConfidentOutput

NAMES = [
    "AdaptiveIntegration", "Calibration", "CalibrationWarning", "Compensate", "ConfidentPipeline", "ContactFromDepth",
    "ContactMask", "ContactSettings", "DepthOutput", "DepthPipeline", "FrozenPipeline", "GradientFromNormal", "Integrator",
    "NormalFromIntensity", "NormalFromLookup", "NormalFromMLP", "NormalFromResponse", "NormalModel", "PointLights",
    "PoissonBackground", "PoissonDCT", "PoissonDST", "PoseTracker", "Press", "Rectify", "Result", "Sensor", "SkinMotion",
    "calibrate", "depth_to_points",
    "diagnose", "fit_lights", "frames", "gs_sdk", "near_field_shading", "poisson_background", "poisson_dct", "poisson_dst",
    "read_image", "read_presses", "read_result", "register_depth", "register_points", "scenes", "shipped_sensors", "stream",
    "write_image",
]  # fmt: skip


def test_public_names_are_frozen():
    assert vts.__all__ == NAMES
    assert all(hasattr(vts, name) for name in NAMES)


def test_results_have_their_fields_in_order():
    assert vts.DepthOutput._fields == ("depth_mm", "gradient", "normal", "contact", "deformed")
    assert ConfidentOutput._fields[:5] == vts.DepthOutput._fields
    assert ConfidentOutput._fields[5:] == ("normal_95_deg", "depth_95_mm", "confidence", "frame_confidence", "factors_deg")
    assert {"lights", "converged", "loss_history", "direction_std_deg", "message"} <= set(LightFit.__dataclass_fields__)


PROGRAM = """
import runpy, sys, torch
before = set(sys.modules)
import torchvts as vts
print(*sorted(set(sys.modules) - before))
sys.argv = ["torchvts", "--version"]
try:
    runpy.run_module("torchvts", run_name="__main__")
except SystemExit as stop:
    print(stop.code, *({"cv2", "matplotlib", "open3d", "onnx"} & set(sys.modules)))
from torchvts.model.lights import flat_image
lights = vts.PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
print(vts.calibrate(flat_image(lights, 24, 32, 1.2).detach(), vts.Sensor("rig", 24, 32, 1.2)).report["model"])
print([name for name in sys.modules if name.startswith(("torch._dynamo", "torch._inductor"))])
"""


def test_import_command_and_calibration_load_no_more_than_they_need():
    """The import, beyond torch, three small packages, and neither Kornia nor torch's compilers: 0.2 s where nothing else runs."""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", PROGRAM], capture_output=True, text=True, check=True)
    by_import, *said = done.stdout.splitlines()
    packages = {name.split(".")[0] for name in by_import.split()} - set(sys.stdlib_module_names)
    ours = {"torchvts", "safetensors", "yaml", "numpy", "cython_runtime"}
    assert {name for name in packages - ours if not name.startswith("_")} == set()
    assert not [name for name in by_import.split() if name.startswith(("torch._dynamo", "torch._inductor", "torch.onnx"))]
    assert said == [f"torchvts {vts.__version__}", "0", "point_lights", "[]"]
