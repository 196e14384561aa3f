"""The public names, their arguments, and what an import costs."""

import inspect
import subprocess
import sys

import pytest

import torchvts as vts
from torchvts.calibration import LightFit, fit_prior
from torchvts.diagnose import Finding
from torchvts.pipeline import Confidence, ConfidentOutput, bound_at
from torchvts.pose import contact_cloud

NAMES = [
    "AdaptiveIntegration", "Calibration", "CalibrationWarning", "Compensate", "ConfidentPipeline", "ContactFromDepth",
    "ContactMask", "ContactSettings", "DepthOutput", "DepthPipeline", "FrozenPipeline", "GradientFromNormal", "Integrator",
    "NormalFromIntensity", "NormalFromLookup", "NormalFromMLP", "NormalFromResponse", "NormalModel", "PointLights",
    "PoissonBackground", "PoissonDCT", "PoissonDST", "PoseTracker", "Press", "Result", "Sensor", "Touch", "calibrate",
    "depth_to_points",
    "diagnose", "fit_lights", "gs_sdk", "near_field_shading", "poisson_background", "poisson_dct", "poisson_dst",
    "read_image", "read_presses", "read_result", "register_depth", "register_points", "scenes", "shipped_sensors", "stream",
    "write_image",
]  # fmt: skip
ARGUMENTS = {
    vts.Sensor: ["name", "height", "width", "mm_per_pixel"],
    vts.Sensor.load: ["source", "height", "width"],
    vts.PointLights: ["position_mm", "albedo", "gloss"],
    vts.near_field_shading: ["depth_mm", "normal", "lights", "mm_per_pixel"],
    vts.fit_lights: ["background", "sensor"],
    vts.calibrate: ["background", "sensor", "presses", "touches"],
    vts.Press: ["image", "ball_diameter_mm", "name"],
    fit_prior: ["background", "sensor", "presses", "source", "others"],
    vts.NormalFromLookup.fit: ["flat", "change", "slope"],
    vts.NormalFromMLP: ["height", "width", "flat", "hidden"],
    vts.NormalFromMLP.load: ["path", "flat"],
    vts.NormalFromResponse: ["field", "by_depth", "height", "width", "mm_per_pixel"],
    vts.Calibration.from_lights: ["lights", "sensor", "background", "report"],
    vts.Calibration.load: ["path"],
    vts.Calibration.save: ["self", "path"],
    vts.DepthPipeline.from_calibration: ["calibration", "mode"],
    vts.DepthPipeline.from_gs_sdk: ["weights", "background", "sensor", "mode"],
    vts.diagnose: ["background", "image", "calibration"],
    Finding: ["name", "message", "severity", "value"],
    Confidence.from_calibration: ["calibration", "normals"],
    bound_at: ["bound_95", "level", "spread"],
    vts.poisson_dst: ["gradient", "mm_per_pixel"],
    vts.poisson_dct: ["gradient", "mm_per_pixel"],
    vts.PoissonDST: ["mm_per_pixel"],
    vts.PoissonDCT: ["mm_per_pixel"],
    vts.depth_to_points: ["depth_mm", "mm_per_pixel", "contact"],
    vts.register_points: ["source", "target"],
    vts.register_depth: ["source", "target", "mm_per_pixel"],
    vts.PoseTracker: ["reference", "mm_per_pixel"],
    contact_cloud: ["frame", "mm_per_pixel", "most"],
    vts.Compensate: ["gain", "offset", "gamma", "defects"],
    vts.ContactMask: ["flat", "light", "noise_std", "sigmas"],
    vts.ContactFromDepth: ["mm_per_pixel", "share"],
    vts.ContactSettings: ["sigmas", "share"],
    vts.NormalFromIntensity: ["lights", "height", "width", "mm_per_pixel", "noise_std", "inverse"],
}


def test_public_names_are_frozen():
    assert vts.__all__ == NAMES
    assert all(hasattr(vts, name) for name in NAMES)


@pytest.mark.parametrize("call", ARGUMENTS, ids=lambda call: call.__qualname__)
def test_arguments_keep_their_names_and_order(call):
    positional = [p.name for p in inspect.signature(call).parameters.values() if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional[: len(ARGUMENTS[call])] == ARGUMENTS[call]


def test_results_have_their_fields_in_order():
    assert vts.DepthOutput._fields == ("depth_mm", "gradient", "normal", "contact", "deformed")
    assert ConfidentOutput._fields[:5] == vts.DepthOutput._fields
    assert ConfidentOutput._fields[5:] == vts.pipeline.confidence.Bounds._fields
    assert {"lights", "converged", "loss_history", "direction_std_deg", "message"} <= set(LightFit.__dataclass_fields__)


@pytest.mark.parametrize("name", [name for name in NAMES if callable(getattr(vts, name))])
def test_every_public_name_is_documented(name):
    assert inspect.getdoc(getattr(vts, name))


def test_the_import_is_light():
    """Beyond torch it loads three small packages, and neither Kornia nor torch's own compilers: 0.2 s where nothing else runs."""
    program = "import sys, torch; before = set(sys.modules); import torchvts; print(*sorted(set(sys.modules) - before))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    packages = {name.split(".")[0] for name in loaded} - set(sys.stdlib_module_names)
    ours = {"torchvts", "safetensors", "yaml", "numpy", "cython_runtime"}
    assert {name for name in packages - ours if not name.startswith("_")} == set()
    assert not [name for name in loaded if name.startswith(("torch._dynamo", "torch._inductor", "torch.onnx"))]


def test_a_first_calibration_does_not_load_torchs_compilers():
    program = (
        "import sys; import torchvts as vts; from torchvts.model.lights import flat_image\n"
        "lights = vts.PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])\n"
        "found = vts.calibrate(flat_image(lights, 24, 32, 1.2).detach(), vts.Sensor('rig', 24, 32, 1.2))\n"
        "print(found.lights is not None, [name for name in sys.modules if name.startswith(('torch._dynamo', 'torch._inductor'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "[]"]
