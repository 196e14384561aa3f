"""A network of one's own in place of the calibrated model, trained by a loss on depth: it never sees a normal (docs/training.md).

python examples/own_network.py
"""

import kornia
import torch

import torchvts as vts
from torchvts import scenes

torch.manual_seed(1)
lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", height=64, width=96, mm_per_pixel=0.2))
presses = [scenes.sphere_press(4.0, 0.5, at, 64, 96, 0.2) for at in ((-3, -2), (3, 2))]
images = torch.cat([scenes.render(scene, lights) for scene in presses]).detach()
truth_mm = torch.cat([scene.depth_mm for scene in presses])


class Normals(torch.nn.Module):
    """Compensated images (B, 3, H, W) to unit normals (B, 3, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.slope = torch.nn.Sequential(torch.nn.Conv2d(3, 16, 1), torch.nn.ReLU(), torch.nn.Conv2d(16, 2, 1))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        slope = self.slope(10.0 * (image - calibration.flat))
        return torch.nn.functional.normalize(torch.cat((slope, torch.ones_like(slope[:, :1])), dim=1), dim=1)


pipe = vts.DepthPipeline.from_calibration(calibration, normals=(network := Normals()))
optimiser, losses = torch.optim.Adam(network.parameters(), lr=3e-2), []
for _ in range(50):
    loss = (pipe(kornia.augmentation.RandomGaussianNoise(std=0.01, p=1.0)(images)).depth_mm - truth_mm).abs().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    losses.append(loss.item())
print(f"mean error of depth: {losses[0]:.3f} mm, after {len(losses)} steps {losses[-1]:.3f} mm")
