"""What the messages of refusals say of the likely cause: (entry of the table, argument, bad value, words of the message)."""

import torch
from refusals_values import DEPTH, EYE, FLAT, HEIGHT, NAN, PRESS, WIDTH, frame, image

GOOD = image()
TURNED, BYTES = GOOD.permute(1, 2, 0), (255 * GOOD).to(torch.uint8)
ONE_NAN = GOOD.clone()
ONE_NAN[1, 0, 0] = NAN
UNLIT, CLIPPED, EVEN = GOOD.clone(), GOOD.clone(), GOOD.clone()
UNLIT[1], CLIPPED[2, : 3 * HEIGHT // 4], EVEN[0] = 0.001, 1.0, 0.5
OF_IMAGES = [
    (GOOD[None], r"expected \(3, 24, 32\) for sensor 'rig', got \(1, 3, 24, 32\): take one image of the batch"),
    (TURNED, r"got \(24, 32, 3\): channels stand last: permute\(2, 0, 1\)"),
    (GOOD[:1], r"got \(1, 24, 32\): one RGB image is needed"),
    (GOOD[:, :20, :30], r"got \(3, 20, 30\): resize it, or load the sensor with height=20, width=30"),
    (BYTES, "expected a floating-point image, got torch.uint8: divide by 255"),
    (255 * GOOD, r"expected values in \[0, 1\], got \[.*\]: 0-255 given for 0-1: divide by 255"),
    (GOOD - 0.9, r"expected values in \[0, 1\], got \[-0\..*\]: clamp it"),
    (ONE_NAN, "expected finite values, got 1 NaN or infinite"),
    (GOOD.numpy(), "expected a torch.Tensor, got ndarray: torch.from_numpy"),
    ("background.png", "expected a torch.Tensor, got str: read files with torchvts.read_image"),
]
OF_UNUSABLE = [
    (0 * GOOD, r"expected light in channel R, got a mean of 0\.0000: black image, .* off"),
    (UNLIT, r"expected light in channel G, got a mean of 0\.0010"),
    (CLIPPED, r"expected light below .*, got a channel B that is saturated in 75% of the image: lower the exposure"),
    (EVEN, r"expected light that varies, got a channel R that is constant at 0\.5000: not a camera image"),
]
OF_BATCHES = [
    (GOOD, r"expected \(B, 3, H, W\), got \[3, 24, 32\]: add the batch dimension with \[None\]"),
    (TURNED[None], r"got \[1, 24, 32, 3\]: channels stand last: permute\(0, 3, 1, 2\)"),
    (BYTES[None], r"got torch.uint8: images are value / 255 in \[0, 1\]"),
    (255 * GOOD[None], r"expected values in \[0, 1\], got .*: 0-255 given for 0-1: divide by 255"),
    (
        4.0 * GOOD[None] - 2.0,
        r"expected values in \[0, 1\], got .*: normalised by mean and standard deviation, .* give value / 255",
    ),
    (ONE_NAN[None], "expected finite values, got 1 NaN or infinite"),
    (GOOD[None].half(), r"expected float32 or float64, got torch\.float16: .*use \.float\(\)"),
]
MIRROR, SCALED, TRANSPOSED = (
    torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])),
    torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])),
    EYE.clone(),
)
TRANSPOSED[3, 0] = 3.0
TWO = torch.zeros(2, 1, 8, 8)
PIXELS, SLOPES, PLACES = torch.full((9, 3), 0.5), torch.zeros(9, 2), torch.full((9, 2), 99.0)
POINTS = torch.arange(50.0)[:, None]
FAINT = frame()._replace(depth_mm=0.01 * frame().depth_mm)

CAUSES = [
    *(("calibrate", "background", *row) for row in OF_IMAGES + OF_UNUSABLE),
    *(("fit_lights", "background", *row) for row in OF_IMAGES + OF_UNUSABLE),
    *(("Calibration.from_lights", "background", *row) for row in OF_IMAGES),
    *(("DepthPipeline.forward", "images", *row) for row in OF_BATCHES),
    ("Compensate.forward", "image", GOOD[None, :, :20, :30], "expected 24 x 32 like the calibration, got 20 x 30"),
    ("DepthPipeline.from_calibration", "mode", "slow", "expected one of fast, precise, got 'slow'"),
    ("DepthPipeline.from_calibration", "calibration", "unit.safetensors", "got str: Calibration.load reads a file"),
    ("Calibration.from_lights", "lights", [[0, 0, 1]], "expected PointLights, got list"),
    ("calibrate", "presses", [PRESS, image()], r"^presses\[1\]: expected a Press, got Tensor: Press\(image, ball_diameter_mm\)"),
    ("Press", "ball_diameter_mm", 6310, r"expected a number in \(0, 1000\], got 6310"),
    ("PointLights", "position_mm", [[20, 0, 30], [9, 9, 30], [0, 0, 0]], r"lights above the skin \(z > 0\), got z = .*z points to"),
    ("depth_to_points", "depth_mm", TWO, "expected one frame, .*: loop over the batch"),
    ("depth_to_points", "contact", torch.ones(4, 5) > 0, r"expected 24 x 32 like depth_mm, got 4 x 5"),
    ("near_field_shading", "normal", torch.zeros(1, 3, 8, 9), f"expected {HEIGHT} x {WIDTH} like depth_mm, got 8 x 9"),
    ("poisson_dst", "gradient", torch.zeros(1, 2, 2, 5), "expected H and W of at least 3, got 2 x 5"),
    ("poisson_dct", "gradient", torch.zeros(1, 2, 1, 5), "expected H and W of at least 2, got 1 x 5"),
    ("find_markers", "image", torch.zeros(1, 3, 4, 32), "expected more than 5 .* got 4 x 32"),
    ("scenes.sphere_press", "press_mm", 99.0, r"expected a number in \(0, 10\], got 99"),
    ("scenes.letters_depth", "text", "abc", "expected capital letters A-Z and spaces, got "),
    ("Compensate", "defects", torch.ones(HEIGHT, WIDTH) > 0, "expected valid pixels"),
    ("NormalFromLookup.fit", "slope", torch.full((50, 2), torch.inf), "expected finite values.*3 pixels inside the rim"),
    ("NormalFromLookup.fit", "change", torch.zeros(50, 3), "expected colours that vary"),
    ("NormalFromMLP.set_flat", "flat", 255 * FLAT, "expected values in .*divide by 255"),
    ("fit_mlp", "intensity", 255 * PIXELS, "expected values in .*divide by 255"),
    ("fit_mlp", "xy", PLACES, r"expected columns in \[0, 31\] and rows in \[0, 23\] like flat, got .*x stands first"),
    ("fit_mlp", "slope", SLOPES / 0, "expected finite slopes up to 10.0, got nan: keep 3 pixels inside"),
    ("fit_mlp", "groups", torch.zeros(9).long(), "expected two presses or more, got 1"),
    ("gs_sdk.image_from_bgr", "pixels", TWO[0].expand(3, 8, 8).numpy().astype("uint8"), "channels stand first"),
    ("gs_sdk.image_to_bgr", "image", GOOD[None], "take one image of the batch"),
    ("bound_at", "level", 95.0, r"expected a probability between 0 and 1, got .*: 0\.95, not 95"),
    ("ContactSettings", "sigmas", 0.1, r"expected a number in \[1, 1000\], got 0.1"),
    ("register_depth", "initial", SCALED, "expected a rigid motion .*a scale, or another unit"),
    ("register_depth", "initial", MIRROR, "expected a rigid motion .*a mirror image"),
    ("register_depth", "initial", TRANSPOSED, "expected a rigid motion .*the last row .* transposed"),
    ("register_depth", "target", FAINT, "target: .*pressed too faintly"),
    ("register_points", "source", torch.zeros(0, 3), r"expected points, got none: no contact\?"),
    ("register_points", "source", torch.ones(50, 3), "expected at least 12 distinct points, got 1 of 50"),
    ("register_points", "source", POINTS.expand(50, 3), "expected a surface, got points on one line"),
    ("diagnose", "image", 255 * GOOD, "divide by 255"),
    ("ContactFromDepth.forward", "depth_mm", DEPTH[0], "add the batch dimension"),
]
